// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <cstdio>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "examples/lift_options.h"
#include "lvggt/cli/memory_check.h"
#include "lvggt/cli/threads.h"
#include "lvggt/io/video.h"
#include "lvggt/lvggt.h"
#include "lvggt/model/checkpoint.h"

// What lift_video knows before it starts: the input, its size, the memory the run will need.
namespace lift_plan {

using namespace lvggt;

// The input with its first frame, which tells the size of all.
struct Input {
  std::unique_ptr<FrameSource> source;
  std::optional<InputFrame> next;
  ImageTransform transform;
};

inline Input open_input(const LiftOptions& options) {
  Input input;
  input.source = open_frames(options.video, options.frames, open_video);
  input.next = input.source->next();
  if (!input.next) fail(ErrorKind::kFormat, options.video, ": holds no frames");
  input.transform =
      plan_frame(input.next->image.width(), input.next->image.height(), options.preprocess);
  return input;
}

// Memory beside the model's: the program itself and its libraries, the point cloud, the pictures of
// a frame and of the contact sheet, and the decoding of the original.
inline std::size_t program_bytes(const ImageTransform& transform, std::int64_t levels,
                                 std::int64_t lang_dim) {
  const auto pixels =
      static_cast<std::size_t>(transform.width) * static_cast<std::size_t>(transform.height);
  const auto original = static_cast<std::size_t>(transform.original_width) *
                        static_cast<std::size_t>(transform.original_height);
  const auto semantics = static_cast<std::size_t>(levels * (4 * lang_dim + 3));
  return (std::size_t{64} << 20) + pixels * (80 + semantics) + original * 24;
}

struct Plan {
  MemoryPlan model;
  std::size_t total = 0;
};

inline Plan plan_run(const Checkpoint& checkpoint, const LiftOptions& options,
                     const ImageTransform& transform, std::int64_t past_frames) {
  StreamOptions stream = options.stream;
  stream.max_past_frames = past_frames;
  stream.decoder = stream.decoder && checkpoint.has_decoder();
  Plan plan;
  plan.model =
      plan_memory(checkpoint.config(), transform.height, transform.width, stream,
                  [&](const std::string& weight) { return checkpoint.storage_of(weight); });
  plan.total = plan.model.total + program_bytes(transform, checkpoint.config().sbd_levels,
                                                checkpoint.config().lang_dim);
  return plan;
}

// Frames the caches can hold at most in this run.
inline std::int64_t reachable_past_frames(const LiftOptions& options, const Input& input) {
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
inline void check_plan(const Plan& plan, const Checkpoint& checkpoint, const LiftOptions& options,
                       const Input& input) {
  cli::MemoryLimit limit = cli::available_memory();
  if (options.memory_limit > 0 && options.memory_limit < limit.bytes)
    limit = {options.memory_limit, "--memory-limit"};
  const std::int64_t past = reachable_past_frames(options, input);
  std::vector<cli::MemoryKnob> knobs;
  knobs.push_back({"--max-past-frames", 1, past, 1, [&](std::int64_t frames) {
                     return plan_run(checkpoint, options, input.transform, frames).total;
                   }});
  if (options.preprocess.mode != FrameMode::kOriginal)
    knobs.push_back(
        {"--size", 4 * kPatchSize, options.preprocess.size, kPatchSize, [&](std::int64_t size) {
           PreprocessOptions smaller = options.preprocess;
           smaller.size = static_cast<int>(size);
           const Image& image = input.next->image;
           return plan_run(checkpoint, options, plan_frame(image.width(), image.height(), smaller),
                           past)
               .total;
         }});
  cli::check_memory(plan.total, limit, breakdown(plan), knobs);
}

inline void print_plan(const LiftOptions& options, const Input& input, const Plan& plan,
                       const Checkpoint& checkpoint, const cli::ThreadChoice& threads) {
  const ImageTransform& t = input.transform;
  const std::int64_t frames = input.source->expected_frames();
  std::printf("input         %s: %s frames of %d x %d\n", options.video.c_str(),
              frames < 0 ? "an unknown number of" : std::to_string(frames).c_str(),
              t.original_width, t.original_height);
  std::printf("model frames  %d x %d (mode %s)\n", t.width, t.height, options.mode.c_str());
  std::printf(
      "model         %lld aggregator layers of width %lld, %s\n",
      static_cast<long long>(checkpoint.config().agg_depth),
      static_cast<long long>(checkpoint.config().embed_dim),
      options.stream.decoder && checkpoint.has_decoder() ? "with the decoder" : "geometry only");
  std::printf("past frames   %lld at most\n",
              static_cast<long long>(options.stream.max_past_frames));
  std::printf("threads       %d (%s)\n", threads.threads, threads.reason.c_str());
  std::printf("memory        about %s (%s)\n", cli::bytes_text(plan.total).c_str(),
              breakdown(plan).c_str());
  std::printf("available     %s\n", cli::bytes_text(cli::available_memory().bytes).c_str());
}

}  // namespace lift_plan
