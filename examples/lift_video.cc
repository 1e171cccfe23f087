// SPDX-License-Identifier: Apache-2.0
// From a video or a folder of images to cameras, depth, pictures and point clouds, frame by frame.
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <optional>
#include <string>

#include "examples/lift_options.h"
#include "examples/lift_plan.h"
#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/output_folder.h"
#include "lvggt/cli/progress.h"
#include "lvggt/cli/run_record.h"
#include "lvggt/io/hash.h"
#include "lvggt/lvggt.h"
#include "lvggt/model/stream.h"

namespace {

using namespace lvggt;
using namespace lift_plan;

constexpr int kPartial = 5;  // exit status of a run whose input ended early

void say(const std::string& line) { std::fprintf(stderr, "lift_video: %s\n", line.c_str()); }

// Seconds by stage, over the whole run.
struct Times {
  double load = 0, input = 0, prepare = 0, write = 0;
  StageTimes model;

  void add(const StageTimes& t) {
    for (const auto stage : {&StageTimes::dino, &StageTimes::frame_blocks,
                             &StageTimes::global_blocks, &StageTimes::camera, &StageTimes::depth,
                             &StageTimes::points, &StageTimes::decoder, &StageTimes::total})
      model.*stage += t.*stage;
  }

  std::vector<std::pair<std::string, double>> named() const {
    return {{"load_weights", load},
            {"read_input", input},
            {"prepare_input", prepare},
            {"dino", model.dino},
            {"frame_blocks", model.frame_blocks},
            {"global_blocks", model.global_blocks},
            {"camera_head", model.camera},
            {"depth_head", model.depth},
            {"decoder", model.decoder},
            {"model_total", model.total},
            {"write_output", write}};
  }
};

RunFormat run_format(const LiftOptions& options, const Input& input, const ModelConfig& config,
                     bool decoder) {
  RunFormat format;
  format.transform = input.transform;
  format.levels = decoder ? config.sbd_levels : 0;
  format.lang_dim = decoder ? config.lang_dim : 0;
  format.has_rgb = decoder && config.sbd_rgb;
  format.names_are_files = input.next->name != concat("frame ", input.next->source_index);
  format.expected_frames = input.source->expected_frames();
  const std::filesystem::path path(cli::without_trailing_slashes(options.video));
  format.title = concat(path.filename().string(), "   ", input.transform.width, " x ",
                        input.transform.height, " pixels");
  format.footer =
      "depth and confidence: blue low, red high; semantics: one basis for the whole video";
  return format;
}

// The loop over the frames; `record` is kept up to date whatever ends it.
class Lift {
 public:
  Lift(const LiftOptions& options, Input& input, const LangVggt& model, cli::RunRecord& record,
       Times& times, const cli::InterruptGuard& interrupt, Context& ctx)
      : options_(options),
        input_(input),
        record_(record),
        times_(times),
        interrupt_(interrupt),
        ctx_(ctx),
        format_(run_format(options, input, model.config(),
                           options.stream.decoder && model.has_decoder())),
        stream_(model, ctx, options.stream),
        progress_(format_.expected_frames) {}

  // Runs to the end of the input or to the interrupt, and leaves complete files behind in either
  // case.
  void run() {
    try {
      while (input_.next && !interrupt_.requested()) {
        if (!lift_frame()) break;
        const StageTimer timer(times_.input);
        input_.next = input_.source->next();
      }
    } catch (...) {
      // What went wrong first is what the user has to know.
      try {
        if (writer_) finish();
      } catch (const Error& error) {
        say(error.what());
      }
      throw;
    }
    if (writer_) finish();
  }

  // Whether there is a folder to put the record of the run into.
  bool has_folder() const { return writer_.has_value(); }

 private:
  // One frame from picture to files; false when interrupted before its files are complete.
  bool lift_frame() {
    PreparedFrame prepared;
    {
      const StageTimer timer(times_.prepare);
      prepared = prepare_frame(input_.next->image, options_.preprocess);
    }
    const Frame frame = stream_.push(prepared.pixels);
    times_.add(frame.times);
    const StageTimer timer(times_.write);
    // The folder is made when there is something to put into it.
    if (!writer_) open_folder();
    const RunFrame results{
        {frame.index, input_.next->source_index, input_.next->name, input_.next->timestamp,
         frame.camera},
        input_.next->image.pixels,
        {prepared.pixels, frame.depth, frame.depth_confidence, frame.rgb, frame.language}};
    const bool complete = writer_->write(
        results, [this] { return interrupt_.requested(); }, ctx_);
    record_.frames = writer_->num_frames();
    progress_.show(record_.frames);
    return complete;
  }

  void open_folder() {
    if (options_.force) {
      cli::remove_earlier_run(options_.out, run_files(), run_folders());
      cli::remove_earlier_run(options_.out, {cli::kRunFile}, {});
    }
    cli::create_output_folder(options_.out);
    write_file(options_.out + "/" + cli::kRunFile, run_json(record_));
    writer_.emplace(options_.out, options_.outputs, format_, options_.resume);
  }

  void finish() {
    progress_.clear();
    writer_->finish();
    if (writer_->num_files_kept() > 0)
      say(concat(writer_->num_files_kept(), " files were there already and stayed as they are"));
  }

  const LiftOptions& options_;
  Input& input_;
  cli::RunRecord& record_;
  Times& times_;
  const cli::InterruptGuard& interrupt_;
  Context& ctx_;
  RunFormat format_;
  Stream stream_;
  cli::Progress progress_;
  std::optional<RunWriter> writer_;
};

// Says how the run ended, in run.json, on stderr and in the exit status. A run is interrupted when
// frames are left: one asked to stop after the last is complete.
int conclude(const LiftOptions& options, const Input& input, const Times& times, bool has_folder,
             cli::RunRecord& record) {
  const bool interrupted = input.next.has_value();
  for (const std::string& warning : input.source->warnings()) {
    record.warnings.push_back(warning);
    say("warning: " + warning);
  }
  record.seconds = times.named();
  record.status = interrupted                      ? "interrupted"
                  : input.source->report().partial ? "partial"
                                                   : "complete";
  const std::string text = run_json(record);
  if (has_folder) write_file(options.out + "/" + cli::kRunFile, text);
  if (options.summary == "-")
    std::fputs(text.c_str(), stdout);
  else if (!options.summary.empty())
    write_file(options.summary, text);

  const std::string of =
      record.expected_frames >= record.frames ? concat(" of ", record.expected_frames) : "";
  if (interrupted) {
    say(concat("interrupted: ", record.frames, of, " frames are complete in ", options.out,
               "; --resume continues"));
    return exit_code(ErrorKind::kInterrupted);
  }
  const double per_frame = times.model.total / static_cast<double>(record.frames);
  say(concat(record.frames, record.status == "partial" ? of : "", " frames in ", options.out, ", ",
             cli::fixed(per_frame, per_frame < 1 ? 3 : 1), " s of model time a frame, ",
             cli::bytes_text(cli::peak_resident_bytes()), " at most; scale is relative"));
  return record.status == "partial" ? kPartial : 0;
}

// Whether an earlier run with the same settings is complete, so that nothing is left to do.
bool already_complete(const LiftOptions& options, const cli::RunRecord& record) {
  if (!options.resume || !cli::check_output_folder(options.out, cli::Existing::kResume))
    return false;
  const std::string file = options.out + "/" + cli::kRunFile;
  if (cli::check_same_settings(file, record) != "complete") return false;
  say(options.out + ": the run is complete already");
  return true;
}

cli::RunRecord make_record(const LiftOptions& options, const Input& input,
                           const cli::ThreadChoice& threads, int argc, char** argv) {
  cli::RunRecord record;
  record.tool = "lift_video";
  record.version = LVGGT_VERSION;
  record.arguments.assign(argv + 1, argv + argc);
  record.settings = options.settings();
  record.transform = input.transform;
  record.expected_frames = input.source->expected_frames();
  record.threads = threads.threads;
  for (const auto& [role, path] : {std::pair{"video", options.video},
                                   {"weights", options.weights.weights},
                                   {"decoder", options.weights.decoder},
                                   {"config", options.weights.config}}) {
    if (path.empty()) continue;
    record.inputs.push_back(cli::describe_input(role, path, options.hash));
    record.settings.emplace_back(role + std::string("_file"),
                                 concat(path, " (", record.inputs.back().bytes, " bytes)"));
  }
  return record;
}

int lift(LiftOptions& options, int argc, char** argv) {
  options.settle();
  options.out = cli::without_trailing_slashes(options.out);
  if (!options.dry_run)
    cli::check_output_folder(options.out, options.resume  ? cli::Existing::kResume
                                          : options.force ? cli::Existing::kReplace
                                                          : cli::Existing::kRefuse);
  if (!options.summary.empty() && options.summary != "-") check_output_file(options.summary, true);
  const cli::ThreadChoice threads = cli::choose_threads(options.threads);
  const cli::InterruptGuard interrupt;

  // Names and shapes only: what the run needs is known before anything large is read.
  const Checkpoint checkpoint(options.weights);
  options.preprocess.size =
      options.size > 0 ? options.size : static_cast<int>(checkpoint.config().img_size);
  Input input = open_input(options);
  const Plan plan =
      plan_run(checkpoint, options, input.transform, reachable_past_frames(options, input));
  if (options.dry_run) print_plan(options, input, plan, checkpoint, threads);
  check_plan(plan, checkpoint, options, input);
  if (options.dry_run) return 0;

  cli::RunRecord record = make_record(options, input, threads, argc, argv);
  record.planned_bytes = plan.total;
  if (already_complete(options, record)) return 0;
  say(concat(threads.threads, threads.threads == 1 ? " thread (" : " threads (", threads.reason,
             "), about ", cli::bytes_text(plan.total), " of memory"));
  if (!checkpoint.all_f32()) say(checkpoint.storage_summary());

  Context ctx(threads.threads);
  Times times;
  std::optional<LangVggt> model;
  {
    const StageTimer timer(times.load);
    if (!options.sha256.empty()) check_sha256(options.weights.weights, options.sha256);
    model.emplace(LangVggt::load(options.weights, ctx));
  }
  record.warnings = model->warnings();
  for (const std::string& warning : record.warnings) say("warning: " + warning);
  if (!model->has_decoder()) say("no decoder: geometry only, without semantics and RGB");

  Lift run(options, input, *model, record, times, interrupt, ctx);
  try {
    run.run();
  } catch (const std::exception& error) {
    record.status = "failed";
    record.error = error.what();
    record.seconds = times.named();
    try {
      if (run.has_folder()) write_file(options.out + "/" + cli::kRunFile, run_json(record));
    } catch (const Error& also) {
      say(also.what());
    }
    throw;
  }
  return conclude(options, input, times, run.has_folder(), record);
}

}  // namespace

int main(int argc, char** argv) {
  cli::Program program(
      "lift_video",
      "Lifts a video to a coloured, language-featured 4D point cloud: cameras, depth, RGB, "
      "semantic maps and points for every frame.",
      LVGGT_VERSION);
  LiftOptions options;
  add_lift_options(program, options);
  return program.run(argc, argv, [&] { return lift(options, argc, argv); });
}
