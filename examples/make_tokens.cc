// SPDX-License-Identifier: Apache-2.0
// A scene's frames through the frozen geometry encoder, once: the tokens that training reads.
#include <cstdio>
#include <filesystem>
#include <optional>
#include <set>
#include <string>

#include "examples/make_tokens_options.h"
#include "examples/make_tokens_plan.h"
#include "lvggt/cli/bundled_model.h"
#include "lvggt/cli/freed_memory.h"
#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/output_folder.h"
#include "lvggt/cli/progress.h"
#include "lvggt/cli/run_record.h"
#include "lvggt/io/hash.h"
#include "lvggt/lvggt.h"
#include "lvggt/model/parameters.h"
#include "lvggt/model/token_stream.h"

namespace {

using namespace lvggt;
using namespace make_tokens_plan;

constexpr int kPartial = 5;  // exit status of a run whose input ended early

void say(const std::string& line) { std::fprintf(stderr, "make_tokens: %s\n", line.c_str()); }

// What all inputs of a list share: the weights are read once, when the first input needs them.
class Encoder {
 public:
  explicit Encoder(const MakeTokensOptions& options)
      : options_(options),
        threads_(cli::choose_threads(options.threads)),
        checkpoint_(options.weights),
        ctx_(threads_.threads) {}

  const Checkpoint& checkpoint() const { return checkpoint_; }
  const cli::ThreadChoice& threads() const { return threads_; }
  Context& ctx() { return ctx_; }

  const std::string& sha256() {
    if (sha256_.empty()) {
      if (!options_.sha256.empty()) check_sha256(options_.weights.weights, options_.sha256);
      sha256_ = encoder_sha256(checkpoint_, ctx_);
    }
    return sha256_;
  }
  const Aggregator& aggregator() {
    if (!aggregator_) {
      if (!checkpoint_.all_f32()) say(checkpoint_.storage_summary());
      aggregator_.emplace(load_aggregator(checkpoint_, ctx_));
      for (const std::string& warning : cli::load_warnings(checkpoint_, options_.weights.weights))
        say("warning: " + warning);
    }
    return *aggregator_;
  }

 private:
  const MakeTokensOptions& options_;
  cli::ThreadChoice threads_;
  Checkpoint checkpoint_;
  Context ctx_;
  std::string sha256_;
  std::optional<Aggregator> aggregator_;
};

TokenManifest make_manifest(const MakeTokensOptions& options, const Input& input,
                            Encoder& encoder) {
  TokenManifest manifest;
  manifest.tool_version = LVGGT_VERSION;
  manifest.weights = std::filesystem::path(options.weights.weights).filename().string();
  manifest.settings = {encoder.sha256(),
                       encoder_config(encoder.checkpoint().config()),
                       options.preprocess,
                       options.stream.max_past_frames,
                       options.stream.window,
                       encoder_storage(encoder.checkpoint()),
                       options.stream.cache_storage,
                       options.dtype()};
  manifest.transform = input.transform;
  manifest.source = input.path;
  if (input.folder.empty()) manifest.source_sha256 = sha256_file(input.path);
  manifest.start = options.frames.start;
  manifest.stride = options.frames.stride;
  return manifest;
}

// Refuses to continue tokens of other settings.
void check_same(const TokenManifest& earlier, const TokenManifest& wanted,
                const std::string& file) {
  std::string difference = token_difference(earlier.settings, wanted.settings);
  const auto compare = [&](const char* name, std::int64_t before, std::int64_t now) {
    if (before != now)
      difference += concat(difference.empty() ? "" : "; ", name, " is ", before, ", not ", now);
  };
  compare("start", earlier.start, wanted.start);
  compare("stride", earlier.stride, wanted.stride);
  if (!difference.empty())
    fail(ErrorKind::kUsage, file, ": cannot be resumed with other settings: ", difference);
}

// One input from its first frame to its manifest; `record` is kept up to date whatever ends it.
class Run {
 public:
  Run(const MakeTokensOptions& options, std::string out, Input& input, TokenManifest manifest,
      Encoder& encoder, cli::RunRecord& record, const cli::InterruptGuard& interrupt)
      : out_(std::move(out)),
        input_(input),
        manifest_(std::move(manifest)),
        preprocess_(options.preprocess),
        record_(record),
        interrupt_(interrupt),
        stream_(encoder.aggregator(), encoder.ctx(), options.stream),
        progress_(input.source->expected_frames()) {}

  // Leaves a manifest of what is complete, however the loop over the frames ends.
  void run() {
    try {
      while (input_.next && !interrupt_.requested()) {
        add_frame();
        const StageTimer timer(input_seconds_);
        input_.next = input_.source->next();
      }
    } catch (...) {
      try {
        finish();
      } catch (const Error& error) {
        say(error.what());
      }
      throw;
    }
    manifest_.complete = !input_.next;
    finish();
  }

  std::int64_t num_kept() const { return num_kept_; }

 private:
  void add_frame() {
    const InputFrame& frame = *input_.next;
    TokenFrame entry = token_frame(input_, frame, manifest_);
    if (!names_.insert(entry.name).second)
      fail(ErrorKind::kMismatch, input_.folder, ": ", entry.image,
           " and another picture would both be ", entry.name, ".safetensors");
    const PreparedFrame prepared = prepare_frame(frame.image, preprocess_);
    std::array<View<const float, 2>, 4> taps;
    {
      const StageTimer timer(model_seconds_);
      taps = stream_.push(prepared.pixels);
    }
    const StageTimer timer(write_seconds_);
    if (has_tokens(out_, entry, manifest_))
      ++num_kept_;
    else
      write_tokens(out_, entry, taps, manifest_.settings.storage);
    manifest_.frames.push_back(std::move(entry));
    ++record_.frames;
    progress_.show(record_.frames);
  }

  void finish() {
    progress_.clear();
    write_file(out_ + "/" + kTokenManifest, to_json(manifest_));
    record_.seconds = {{"read_input", input_seconds_},
                       {"model", model_seconds_},
                       {"write_output", write_seconds_}};
  }

  std::string out_;
  Input& input_;
  TokenManifest manifest_;
  PreprocessOptions preprocess_;
  cli::RunRecord& record_;
  const cli::InterruptGuard& interrupt_;
  TokenStream stream_;
  cli::Progress progress_;
  std::set<std::string> names_;
  double input_seconds_ = 0, model_seconds_ = 0, write_seconds_ = 0;
  std::int64_t num_kept_ = 0;
};

cli::RunRecord make_record(const MakeTokensOptions& options, const Input& input, Encoder& encoder,
                           const Plan& plan, int argc, char** argv) {
  cli::RunRecord record;
  record.tool = "make_tokens";
  record.version = LVGGT_VERSION;
  record.arguments.assign(argv + 1, argv + argc);
  record.transform = input.transform;
  record.expected_frames = input.source->expected_frames();
  record.threads = encoder.threads().threads;
  record.planned_bytes = plan.total;
  record.inputs = {cli::describe_input("source", input.path, false),
                   cli::describe_input("weights", options.weights.weights, false)};
  record.warnings = input.warnings;
  return record;
}

// Says how the run ended, in run.json, on stderr and in the exit status.
int conclude(const Input& input, const std::string& out, std::int64_t num_kept,
             cli::RunRecord& record) {
  const bool interrupted = input.next.has_value();
  for (const std::string& warning : input.source->warnings()) record.warnings.push_back(warning);
  for (const std::string& warning : record.warnings) say("warning: " + warning);
  record.status = interrupted                      ? "interrupted"
                  : input.source->report().partial ? "partial"
                                                   : "complete";
  write_file(out + "/" + cli::kRunFile, run_json(record));
  if (num_kept > 0) say(concat(num_kept, " files were there already and stayed as they are"));
  if (interrupted) {
    say(concat("interrupted: the tokens of ", record.frames, " frames are in ", out,
               "; --resume continues"));
    return exit_code(ErrorKind::kInterrupted);
  }
  say(concat("tokens of ", record.frames, " frames in ", out, ", ",
             cli::bytes_text(cli::peak_resident_bytes()), " at most"));
  return record.status == "partial" ? kPartial : 0;
}

// Whether the record of a complete run says that its video ends before its announced end.
bool ended_early(const std::string& out) {
  const std::string file = out + "/" + cli::kRunFile;
  std::error_code ignored;
  if (!std::filesystem::exists(file, ignored)) return false;
  const Json record = Json::read(file);
  const Json* status = record.find("status");
  return status != nullptr && status->is_string() && status->as_string(file) == "partial";
}

// What the folder may hold already.
enum class Earlier { kRefuse, kReplace, kResume };

// One input; returns the exit status. `done_before` is set when nothing was left to do.
int make_tokens(const MakeTokensOptions& options, const std::string& path, const std::string& out,
                Earlier earlier, Encoder& encoder, const cli::InterruptGuard& interrupt,
                bool& done_before, int argc, char** argv) {
  const bool existed =
      !options.dry_run &&
      cli::check_output_folder(out, earlier == Earlier::kResume    ? cli::Existing::kResume
                                    : earlier == Earlier::kReplace ? cli::Existing::kReplace
                                                                   : cli::Existing::kRefuse);
  Input input = open_input(path, options);
  const Plan plan = plan_run(encoder.checkpoint(), options.stream, input.transform,
                             reachable_past_frames(options, input));
  if (options.dry_run) print_plan(options, input, plan, encoder.checkpoint(), encoder.threads());
  check_plan(plan, encoder.checkpoint(), options, input);
  if (options.dry_run) return 0;

  TokenManifest manifest = make_manifest(options, input, encoder);
  const std::string manifest_file = out + "/" + kTokenManifest;
  if (existed && earlier == Earlier::kResume && std::filesystem::exists(manifest_file)) {
    const TokenManifest before = read_token_manifest(manifest_file);
    check_same(before, manifest, manifest_file);
    if (is_complete(out, before, manifest, input)) {
      say(out + ": the tokens are complete already");
      done_before = true;
      return ended_early(out) ? kPartial : 0;
    }
  }
  cli::RunRecord record = make_record(options, input, encoder, plan, argc, argv);
  say(concat(encoder.threads().threads, " threads (", encoder.threads().reason, "), about ",
             cli::bytes_text(plan.total), " of memory"));
  Run run(options, out, input, manifest, encoder, record, interrupt);
  if (existed && earlier == Earlier::kReplace) remove_tokens(out);
  cli::create_output_folder(out);
  if (earlier != Earlier::kRefuse) cli::remove_unfinished_files(out);
  write_file(out + "/" + cli::kRunFile, run_json(record));
  write_file(manifest_file, to_json(manifest));
  try {
    run.run();
  } catch (const std::exception& error) {
    record.status = "failed";
    record.error = error.what();
    try {
      write_file(out + "/" + cli::kRunFile, run_json(record));
    } catch (const Error& also) {
      say(also.what());
    }
    throw;
  }
  return conclude(input, out, run.num_kept(), record);
}

int make_list(const MakeTokensOptions& options, Encoder& encoder,
              const cli::InterruptGuard& interrupt, int argc, char** argv) {
  const auto items =
      cli::read_work_list(options.list, [&](const std::string& input, const std::string& name) {
        return options.folder_for(input, name);
      });
  std::error_code ignored;
  if (!options.out.empty() && !std::filesystem::is_directory(options.out, ignored))
    cli::create_output_folder(options.out);
  const auto work = [&](const cli::WorkItem& item) {
    bool done_before = false;
    const int status = make_tokens(options, item.input, item.out, Earlier::kResume, encoder,
                                   interrupt, done_before, argc, argv);
    if (status == exit_code(ErrorKind::kInterrupted)) return cli::WorkResult::kInterrupted;
    if (status == kPartial) return cli::WorkResult::kPartial;
    return done_before ? cli::WorkResult::kAlreadyDone : cli::WorkResult::kDone;
  };
  return cli::WorkOff(items, options.list_options,
                      {[&] { return interrupt.requested(); }, work, say})
      .run();
}

int run(MakeTokensOptions& options, int argc, char** argv) {
  options.settle();
  options.out = cli::without_trailing_slashes(options.out);
  cli::default_to_small_model(options.weights.weights, say);
  const cli::InterruptGuard interrupt;
  Encoder encoder(options);
  options.preprocess.size =
      options.size > 0 ? options.size : static_cast<int>(encoder.checkpoint().config().img_size);
  if (!options.list.empty()) return make_list(options, encoder, interrupt, argc, argv);
  const std::string out = options.out.empty() ? options.folder_for(options.input, "") : options.out;
  bool done_before = false;
  return make_tokens(options, options.input, out,
                     options.resume  ? Earlier::kResume
                     : options.force ? Earlier::kReplace
                                     : Earlier::kRefuse,
                     encoder, interrupt, done_before, argc, argv);
}

}  // namespace

int main(int argc, char** argv) {
  cli::return_freed_memory();
  cli::Program program(
      "make_tokens",
      "Runs the frames of a scene through the frozen geometry encoder, once, and keeps the tokens "
      "that training the\ndecoder reads.",
      LVGGT_VERSION);
  MakeTokensOptions options;
  add_make_tokens_options(program, options);
  return program.run(argc, argv, [&] { return run(options, argc, argv); });
}
