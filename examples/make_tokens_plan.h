// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdio>
#include <filesystem>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "examples/make_tokens_options.h"
#include "lvggt/cli/memory_check.h"
#include "lvggt/cli/run_record.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/video.h"
#include "lvggt/lvggt.h"
#include "lvggt/model/checkpoint.h"

// What make_tokens knows of an input before it starts: its frames, their size, the memory needed.
namespace make_tokens_plan {

using namespace lvggt;

struct Input {
  std::string path;    // as given
  std::string folder;  // of the pictures; empty for a video
  std::unique_ptr<FrameSource> source;
  std::optional<InputFrame> next;  // the first one tells the size of all
  ImageTransform transform;
  std::vector<std::string> warnings;
};

inline Input open_input(const std::string& path, const MakeTokensOptions& options) {
  Input input;
  input.path = path;
  std::string frames = path;
  std::error_code ignored;
  if (Scene::is_scene(path)) {
    const Scene scene = Scene::open(path);
    input.warnings = scene.warnings();
    frames = input.folder = scene.image_folder();
  } else if (std::filesystem::is_directory(path, ignored)) {
    input.folder = cli::without_trailing_slashes(path);
  }
  input.source = open_frames(frames, options.frames, open_video);
  input.next = input.source->next();
  if (!input.next) fail(ErrorKind::kFormat, path, ": holds no frames");
  input.transform =
      plan_frame(input.next->image.width(), input.next->image.height(), options.preprocess);
  return input;
}

// The frame's entry in the manifest, after the frames before it.
inline TokenFrame token_frame(const Input& input, const InputFrame& frame,
                              const TokenManifest& manifest) {
  TokenFrame entry;
  entry.source_index = frame.source_index;
  if (input.folder.empty()) {
    const std::string number = std::to_string(frame.source_index);
    entry.name = std::string(number.size() < 6 ? 6 - number.size() : 0, '0') + number;
    const auto& pixels = frame.image.pixels;
    entry.image_sha256 =
        sha256(std::as_bytes(std::span(pixels.data(), static_cast<std::size_t>(pixels.size()))));
  } else {
    entry.image = frame.name;
    entry.name = std::filesystem::path(frame.name).stem().string();
    entry.image_sha256 = sha256_file(input.folder + "/" + frame.name);
  }
  entry.stream_sha256 =
      next_stream_sha256(manifest.frames.empty() ? "" : manifest.frames.back().stream_sha256,
                         manifest.settings, entry.name, entry.image_sha256);
  return entry;
}

struct Plan {
  MemoryPlan model;
  std::size_t total = 0;
};

inline Plan plan_run(const Checkpoint& checkpoint, const StreamOptions& stream,
                     const ImageTransform& t, std::int64_t past_frames) {
  StreamOptions options = stream;
  options.max_past_frames = past_frames;
  Plan plan;
  plan.model =
      plan_token_memory(checkpoint.config(), t.height, t.width, options,
                        [&](const std::string& weight) { return checkpoint.storage_of(weight); });
  // The program and its libraries, and the decoding and preparing of a picture.
  const auto pixels = static_cast<std::size_t>(t.width) * static_cast<std::size_t>(t.height);
  const auto original =
      static_cast<std::size_t>(t.original_width) * static_cast<std::size_t>(t.original_height);
  plan.total = plan.model.total + (std::size_t{48} << 20) + pixels * 24 + original * 24;
  return plan;
}

// Frames the cache can hold at most in this run.
inline std::int64_t reachable_past_frames(const MakeTokensOptions& options, const Input& input) {
  const std::int64_t expected = input.source->expected_frames();
  const std::int64_t past = options.stream.max_past_frames;
  return expected > 0 ? std::min(past, expected) : past;
}

inline std::string breakdown(const Plan& plan) {
  return "weights " + cli::bytes_text(plan.model.weights) + ", cache of past frames " +
         cli::bytes_text(plan.model.cache) + ", work " +
         cli::bytes_text(plan.total - plan.model.weights - plan.model.cache);
}

// Refuses the run when it needs more memory than it may have, and says which options would fit.
inline void check_plan(const Plan& plan, const Checkpoint& checkpoint,
                       const MakeTokensOptions& options, const Input& input) {
  const cli::MemoryLimit limit = cli::memory_limit(options.memory_limit);
  const std::int64_t past = reachable_past_frames(options, input);
  std::vector<cli::MemoryKnob> knobs;
  knobs.push_back({"--max-past-frames", 1, past, 1, [&](std::int64_t frames) {
                     return plan_run(checkpoint, options.stream, input.transform, frames).total;
                   }});
  if (options.preprocess.mode != FrameMode::kOriginal)
    knobs.push_back(
        {"--size", 4 * kPatchSize, options.preprocess.size, kPatchSize, [&](std::int64_t size) {
           PreprocessOptions smaller = options.preprocess;
           smaller.size = static_cast<int>(size);
           const Image& image = input.next->image;
           return plan_run(checkpoint, options.stream,
                           plan_frame(image.width(), image.height(), smaller), past)
               .total;
         }});
  cli::check_memory(plan.total, limit, breakdown(plan), knobs);
}

// Bytes of a frame's tokens on disk.
inline std::size_t frame_bytes(const ModelConfig& c, const ImageTransform& t, Dtype storage) {
  const std::int64_t patches = (t.height / c.patch_size) * (t.width / c.patch_size);
  return static_cast<std::size_t>(4 * patches * 2 * c.embed_dim * dtype_size(storage));
}

inline void print_plan(const MakeTokensOptions& options, const Input& input, const Plan& plan,
                       const Checkpoint& checkpoint, const cli::ThreadChoice& threads) {
  const ImageTransform& t = input.transform;
  const std::int64_t frames = input.source->expected_frames();
  const std::size_t bytes = frame_bytes(checkpoint.config(), t, options.dtype());
  std::printf("input         %s: %s frames of %d x %d\n", input.path.c_str(),
              frames < 0 ? "an unknown number of" : std::to_string(frames).c_str(),
              t.original_width, t.original_height);
  std::printf("model frames  %d x %d (mode %s)\n", t.width, t.height, options.mode.c_str());
  std::printf("past frames   %lld at most\n",
              static_cast<long long>(options.stream.max_past_frames));
  std::printf("threads       %d (%s)\n", threads.threads, threads.reason.c_str());
  std::printf("memory        about %s (%s)\n", cli::bytes_text(plan.total).c_str(),
              breakdown(plan).c_str());
  std::printf("available     %s\n", cli::bytes_text(cli::available_memory().bytes).c_str());
  std::printf("disk          %s a frame%s\n", cli::bytes_text(bytes).c_str(),
              frames < 0 ? ""
                         : concat(", ", cli::bytes_text(bytes * static_cast<std::size_t>(frames)),
                                  " in all")
                               .c_str());
}

// Whether all that the manifest of a complete run tells of is there and still made from the same
// pictures, so that nothing is left to do.
inline bool is_complete(const std::string& out, const TokenManifest& earlier,
                        const TokenManifest& wanted, const Input& input) {
  if (!earlier.complete || earlier.source_sha256 != wanted.source_sha256) return false;
  const std::int64_t expected = input.source->expected_frames();
  if (!input.folder.empty() && expected != static_cast<std::int64_t>(earlier.frames.size()))
    return false;
  for (const TokenFrame& frame : earlier.frames) {
    if (!has_tokens(out, frame, earlier)) return false;
    std::error_code ignored;
    const std::string picture = input.folder + "/" + frame.image;
    if (!input.folder.empty() &&
        (!std::filesystem::exists(picture, ignored) || sha256_file(picture) != frame.image_sha256))
      return false;
  }
  return true;
}

// Removes the tokens of an earlier run; other files stay.
inline void remove_tokens(const std::string& out) {
  std::vector<std::filesystem::path> ours;
  std::error_code error;
  for (const auto& entry : std::filesystem::directory_iterator(out, error)) {
    if (entry.path().extension() != ".safetensors" || !is_token_file(entry.path().string()))
      continue;
    ours.push_back(entry.path());
  }
  for (const auto& file : ours) {
    std::filesystem::remove(file, error);
    if (error) fail(ErrorKind::kWrite, file.string(), ": cannot be removed: ", error.message());
  }
  cli::remove_earlier_run(out, {kTokenManifest, cli::kRunFile}, {});
}

}  // namespace make_tokens_plan
