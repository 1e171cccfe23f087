// SPDX-License-Identifier: Apache-2.0
// From a video or a folder of images to cameras, depth, pictures and point clouds, frame by frame.
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <optional>
#include <string>

#include "examples/lift_options.h"
#include "examples/lift_plan.h"
#include "lvggt/cli/bundled_model.h"
#include "lvggt/cli/freed_memory.h"
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

// The loop over the frames; `record` is kept up to date whatever ends it.
class Lift {
 public:
  Lift(const LiftOptions& options, Input& input, const ModelFiles& files, const LangVggt& model,
       cli::RunRecord& record, Times& times, const cli::InterruptGuard& interrupt, Context& ctx)
      : options_(options),
        input_(input),
        record_(record),
        times_(times),
        interrupt_(interrupt),
        ctx_(ctx),
        format_(run_format(options, input, files, ctx)),
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
    const RunFrame results{{frame.index, input_.next->source_index, input_.next->name,
                            input_.next->timestamp, frame.camera},
                           input_.next->image.pixels,
                           {prepared.pixels, frame.depth, frame.depth_confidence, frame.rgb,
                            frame.language, frame.states}};
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
    if (options_.force || options_.resume) cli::remove_unfinished_files(options_.out);
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

// How an earlier run with the same settings ended, if it may be continued; else empty.
std::string earlier_status(const LiftOptions& options, const cli::RunRecord& record) {
  if (!options.resume || !cli::check_output_folder(options.out, cli::Existing::kResume)) return {};
  return cli::check_same_settings(options.out + "/" + cli::kRunFile, record);
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
                                   {"state_decoder", options.weights.state_decoder},
                                   {"config", options.weights.config}}) {
    if (path.empty()) continue;
    record.inputs.push_back(cli::describe_input(role, path, options.hash));
    record.settings.emplace_back(role + std::string("_file"),
                                 concat(path, " (", record.inputs.back().bytes, " bytes)"));
  }
  return record;
}

// What all videos of a list share: the weights are read once, when the first video needs them.
class SharedModel {
 public:
  explicit SharedModel(const LiftOptions& options)
      : options_(options),
        threads_(cli::choose_threads(options.threads)),
        files_(options.weights) {}

  const cli::ThreadChoice& threads() const { return threads_; }
  const ModelFiles& files() const { return files_; }

  Context& ctx() {
    if (!ctx_) ctx_.emplace(threads_.threads);
    return *ctx_;
  }

  // Adds the seconds that it took this time.
  const LangVggt& get(double& seconds) {
    if (model_) return *model_;
    const StageTimer timer(seconds);
    if (!files_.checkpoint().all_f32()) say(files_.checkpoint().storage_summary());
    if (!options_.sha256.empty()) check_sha256(options_.weights.weights, options_.sha256);
    model_.emplace(LangVggt::load(options_.weights, ctx()));
    for (const std::string& warning : cli::load_warnings(*model_, options_.weights.weights))
      say("warning: " + warning);
    if (!model_->has_decoder() && !model_->has_state_decoder())
      say("no decoder: geometry only, without semantics and RGB");
    return *model_;
  }

 private:
  const LiftOptions& options_;
  cli::ThreadChoice threads_;
  ModelFiles files_;
  std::optional<Context> ctx_;
  std::optional<LangVggt> model_;
};

void check_folder(const LiftOptions& options) {
  if (options.dry_run) return;
  cli::check_output_folder(options.out, options.resume  ? cli::Existing::kResume
                                        : options.force ? cli::Existing::kReplace
                                                        : cli::Existing::kRefuse);
}

// One video; returns the exit status. `done_before` is set when an earlier run left nothing to do.
int lift_one(const LiftOptions& options, SharedModel& shared, const cli::InterruptGuard& interrupt,
             bool& done_before, int argc, char** argv) {
  check_folder(options);
  const ModelFiles& files = shared.files();
  const cli::ThreadChoice& threads = shared.threads();
  Input input = open_input(options);
  const Plan plan = plan_run(files, options, input.transform, reachable_past_frames(options, input),
                             num_frames(input));
  if (options.dry_run) print_plan(options, input, plan, files, threads);
  check_plan(plan, files, options, input);
  if (options.dry_run) {
    print_times(options, input, files, threads.threads);
    return 0;
  }

  cli::RunRecord record = make_record(options, input, threads, argc, argv);
  record.planned_bytes = plan.total;
  const std::string earlier = earlier_status(options, record);
  // A list is not run again for a video that ends early: it would end there again.
  if (earlier == "complete" || (earlier == "partial" && !options.list.empty())) {
    say(options.out + ": the run is " + earlier + " already");
    done_before = true;
    return earlier == "partial" ? kPartial : 0;
  }
  say(concat(threads.threads, threads.threads == 1 ? " thread (" : " threads (", threads.reason,
             "), about ", cli::bytes_text(plan.total), " of memory (", breakdown(plan), ")"));

  Times times;
  const LangVggt& model = shared.get(times.load);
  record.warnings = cli::load_warnings(model, options.weights.weights);
  Lift run(options, input, files, model, record, times, interrupt, shared.ctx());
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

// All videos of a list, or those that other processes leave to this one.
int lift_list(const LiftOptions& options, SharedModel& shared, const cli::InterruptGuard& interrupt,
              int argc, char** argv) {
  const auto items = cli::read_work_list(
      options.list,
      [&](const std::string&, const std::string& name) { return options.out + "/" + name; });
  std::error_code ignored;
  if (!std::filesystem::is_directory(options.out, ignored)) cli::create_output_folder(options.out);
  const auto work = [&](const cli::WorkItem& item) {
    LiftOptions one = options;
    one.video = item.input;
    one.out = item.out;
    one.resume = true;
    bool done_before = false;
    const int status = lift_one(one, shared, interrupt, done_before, argc, argv);
    if (status == exit_code(ErrorKind::kInterrupted)) return cli::WorkResult::kInterrupted;
    if (status == kPartial) return cli::WorkResult::kPartial;
    return done_before ? cli::WorkResult::kAlreadyDone : cli::WorkResult::kDone;
  };
  return cli::WorkOff(items, options.list_options,
                      {[&] { return interrupt.requested(); }, work, say})
      .run();
}

int lift(LiftOptions& options, int argc, char** argv) {
  options.settle();
  options.out = cli::without_trailing_slashes(options.out);
  if (!options.summary.empty() && options.summary != "-") check_output_file(options.summary, true);
  // The output folder is looked at before the weights: it is the cheaper of the two.
  if (options.list.empty()) check_folder(options);
  cli::default_to_small_model(options.weights.weights, say);
  const cli::InterruptGuard interrupt;
  SharedModel shared(options);
  options.preprocess.size = options.size > 0
                                ? options.size
                                : static_cast<int>(shared.files().checkpoint().config().img_size);
  if (!options.list.empty()) return lift_list(options, shared, interrupt, argc, argv);
  bool done_before = false;
  return lift_one(options, shared, interrupt, done_before, argc, argv);
}

}  // namespace

int main(int argc, char** argv) {
  cli::return_freed_memory();
  cli::Program program(
      "lift_video",
      "Lifts a video to a coloured, language-featured 4D point cloud: cameras, depth, RGB, "
      "semantic maps and points for every frame.",
      LVGGT_VERSION);
  LiftOptions options;
  add_lift_options(program, options);
  return program.run(argc, argv, [&] { return lift(options, argc, argv); });
}
