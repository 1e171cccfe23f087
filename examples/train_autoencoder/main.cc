// SPDX-License-Identifier: Apache-2.0
// Trains a language autoencoder on the features of labelled scenes and writes their compact codes,
// which train_decoder reads.
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <optional>

#include "examples/compact_codes.h"
#include "examples/train_autoencoder/features.h"
#include "examples/train_autoencoder/options.h"
#include "examples/train_autoencoder/session.h"
#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/memory_check.h"
#include "lvggt/cli/output_folder.h"
#include "lvggt/cli/program.h"
#include "lvggt/cli/progress.h"
#include "lvggt/cli/threads.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/json.h"
#include "lvggt/io/json_writer.h"

namespace train_autoencoder {
namespace {

using namespace lvggt;

void say(const std::string& line) { std::fprintf(stderr, "train_autoencoder: %s\n", line.c_str()); }

std::string rounded(double value) {
  char text[32];
  std::snprintf(text, sizeof text, "%.3g", value);
  return text;
}

// run.json of a training.
struct Record {
  std::vector<std::string> arguments;
  std::string status = "running", error;
  AutoencoderShape shape;
  std::int64_t features = 0, held_out_features = 0;
  std::string data_sha256;
  const Session* session = nullptr;
  double seconds = 0;

  std::string json(const Options& options) const {
    JsonWriter json;
    json.begin_object();
    json.field("format_version", 1);
    json.field("tool", "train_autoencoder");
    json.field("version", LVGGT_VERSION);
    json.field("status", status);
    if (!error.empty()) json.field("error", error);
    json.key("arguments");
    json.begin_array();
    for (const std::string& argument : arguments) json.value(argument);
    json.end_array();
    json.field("widths", to_text(shape));
    json.field("features", features);
    json.field("held_out_features", held_out_features);
    json.field("data_sha256", data_sha256);
    json.key("settings");
    json.begin_object();
    for (const auto& [name, value] : options.settings()) json.field(name, value);
    json.end_object();
    if (session != nullptr) {
      json.field("epochs", session->epochs());
      if (session->best_epoch() >= 0) {
        json.field("best_epoch", session->best_epoch());
        json.field("best_score", session->best_score());
      }
      if (session->held_out()) {
        json.field("held_out_l2", session->held_out()->l2);
        json.field("held_out_cos", session->held_out()->cos);
      }
    }
    json.field("seconds", seconds);
    json.field("peak_memory_bytes", cli::peak_resident_bytes());
    json.end_object();
    return json.take();
  }
};

// Whether an earlier run in the folder came to its end.
bool is_complete(const std::string& output) {
  const std::string file = output + "/" + cli::kRunFile;
  std::error_code ignored;
  if (!std::filesystem::exists(file, ignored) ||
      !std::filesystem::exists(output + "/" + kAutoencoderFile, ignored))
    return false;
  const Json record = Json::read(file);
  const Json* status = record.find("status");
  return status != nullptr && status->is_string() && status->as_string(file) == "complete";
}

// The output folder, made ready; false when a complete training is in it already (--resume).
bool open_output(const Options& options) {
  const bool earlier =
      cli::check_output_folder(options.output, options.resume  ? cli::Existing::kResume
                                               : options.force ? cli::Existing::kReplace
                                                               : cli::Existing::kRefuse);
  cli::create_output_folder(options.output);
  if (!earlier) return true;
  cli::remove_unfinished_files(options.output);
  if (options.resume) return !is_complete(options.output);
  TrainingCheckpoints({options.output + "/checkpoints", 1, LVGGT_VERSION}).remove_all();
  cli::remove_earlier_run(options.output,
                          {cli::kRunFile, "log.jsonl", "loss.png", kAutoencoderFile}, {});
  return true;
}

void check_plan(const Options& options, std::size_t rows, const AutoencoderShape& shape) {
  cli::MemoryLimit limit = cli::available_memory();
  if (options.memory_limit > 0) limit = {options.memory_limit, "--memory-limit"};
  const std::size_t model = plan_autoencoder(shape, options.batch);
  cli::check_memory(rows + model, limit,
                    concat(cli::bytes_text(rows), " for the features, ", cli::bytes_text(model),
                           " for the autoencoder"),
                    {});
}

// Trains; false when it was interrupted.
bool train(const Options& options, const std::vector<Scene>& scenes,
           const cli::InterruptGuard& interrupt, Context& ctx,
           const std::vector<std::string>& arguments) {
  const auto start = std::chrono::steady_clock::now();
  const std::int64_t width = feature_width(scenes.front(), options.kind());
  const AutoencoderShape shape = options.shape(width);
  const FeatureSet set = read_features(scenes, options.kind(), width, options.split());
  check_plan(options, set.train.num_bytes() + set.held_out.num_bytes(), shape);
  say(concat(to_text(shape), "; ", set.train.extent(0), " features of ", set.frames, " frames",
             set.held_out_frames > 0
                 ? concat(", ", set.held_out.extent(0), " of ", set.held_out_frames, " held out")
                 : "",
             set.empty_rows > 0 ? concat("; ", set.empty_rows, " rows of zeros left out") : "",
             "; about ",
             cli::bytes_text(plan_autoencoder(shape, options.batch) + set.train.num_bytes()),
             " of memory"));
  if (options.dry_run) return true;
  if (!open_output(options)) {
    say(options.output + ": the training is complete already");
    return true;
  }
  Record record{arguments,  "running", "", shape, set.train.extent(0), set.held_out.extent(0),
                set.sha256, nullptr,   0};
  const std::string file = options.output + "/" + cli::kRunFile;
  write_file(file, record.json(options));
  try {
    Session session(options, set, shape, interrupt, ctx);
    const bool done = session.run();
    record.status = done ? "complete" : "interrupted";
    record.session = &session;
    record.seconds =
        std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    write_file(file, record.json(options));
    if (!done) {
      say(concat("interrupted after ", session.epochs(), " epochs; --resume continues"));
      return false;
    }
    say(concat(options.output, "/", kAutoencoderFile, ": epoch ", session.best_epoch(),
               ", mean squared error + 1 - cosine ", rounded(session.best_score()),
               session.held_out() ? concat("; held out: ", rounded(session.held_out()->l2), " + ",
                                           rounded(session.held_out()->cos))
                                  : "",
               "; ", cli::duration_text(record.seconds)));
  } catch (const std::exception& error) {
    record.session = nullptr;  // it is gone
    record.status = "failed";
    record.error = error.what();
    write_file(file, record.json(options));
    throw;
  }
  return true;
}

// Writes the codes of all scenes; false when it was interrupted.
bool encode(const Options& options, const std::vector<Scene>& scenes,
            const cli::InterruptGuard& interrupt, Context& ctx) {
  const std::string file = options.output + "/" + kAutoencoderFile;
  const Autoencoder autoencoder = Autoencoder::load(file);
  const ExistingCodes existing = options.force    ? ExistingCodes::kReplace
                                 : options.resume ? ExistingCodes::kKeep
                                                  : ExistingCodes::kRefuse;
  std::int64_t frames = 0, done = 0, written = 0;
  for (const Scene& scene : scenes) frames += std::ssize(scene.frames());
  cli::Progress progress(frames);
  for (const Scene& scene : scenes) {
    std::string root = options.encode_root;
    if (!root.empty() && scenes.size() > 1) root += "/" + scene.name();
    std::vector<FeatureFiles> files;
    for (const SceneFrame& frame : scene.frames())
      files.push_back(feature_files(scene, frame, options.kind(), autoencoder.code_width(), root));
    written += write_compact_codes(
        files, autoencoder, file, existing,
        [&] {
          progress.show(++done);
          return !interrupt.requested();
        },
        ctx);
    if (interrupt.requested() && done < frames) {
      progress.clear();
      say(concat("interrupted: codes of ", done, " frames are there; --resume continues"));
      return false;
    }
  }
  progress.clear();
  say(concat("codes of ", frames, " frames, ", written, " of them written now, ",
             SupervisionSpec{options.kind(), autoencoder.code_width()}.folder()));
  return true;
}

int run(Options& options, int argc, char** argv) {
  options.settle();
  options.output = cli::without_trailing_slashes(options.output);
  options.encode_root = cli::without_trailing_slashes(options.encode_root);
  const cli::InterruptGuard interrupt;
  std::vector<Scene> scenes;
  for (const std::string& path : options.scenes)
    scenes.push_back(Scene::open(cli::without_trailing_slashes(path)));
  for (const Scene& scene : scenes)
    for (const std::string& warning : scene.warnings()) say("warning: " + warning);
  const cli::ThreadChoice threads = cli::choose_threads(options.threads);
  Context ctx(threads.threads);
  const std::vector<std::string> arguments(argv + 1, argv + argc);
  if (!train(options, scenes, interrupt, ctx, arguments)) return exit_code(ErrorKind::kInterrupted);
  if (options.dry_run || !options.encode) return 0;
  return encode(options, scenes, interrupt, ctx) ? 0 : exit_code(ErrorKind::kInterrupted);
}

}  // namespace
}  // namespace train_autoencoder

int main(int argc, char** argv) {
  lvggt::cli::Program program(
      "train_autoencoder",
      "Trains the autoencoder between language features (CLIP's 512 numbers, a sentence encoder's "
      "4096) and the compact\ncodes that the decoder learns (3 or 6), on one scene or several, and "
      "encodes their features with it.",
      LVGGT_VERSION);
  train_autoencoder::Options options;
  train_autoencoder::add_options(program, options);
  return program.run(argc, argv, [&] { return train_autoencoder::run(options, argc, argv); });
}
