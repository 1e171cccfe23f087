// SPDX-License-Identifier: Apache-2.0
// What must not grow while a stream runs on. bench_long_stream does the same for thousands of
// frames.
#include <doctest/doctest.h>

#include <filesystem>
#include <iterator>

#include "lvggt/cli/memory.h"
#include "tests/support/sanitizer.h"
#include "tests/support/tiny_model.h"

using namespace lvggt;
using namespace lvggt::test;

TEST_CASE("D49: once the window is full, memory and handles stay flat, and results repeat") {
  ModelConfig config = tiny_config();
  config.dino_depth = config.agg_depth = config.cam_trunk_depth = 1;
  config.taps = {0, 0, 0, 0};
  TinyModel tiny(config);
  StreamOptions options;
  options.max_past_frames = 4;
  const Tensor<float, 4> images = deterministic_images(1, 5, 28, 42);
  const auto handles = [] {
    return std::distance(std::filesystem::directory_iterator("/proc/self/fd"), {});
  };
  Stream stream(tiny.model, tiny.ctx, options);
  Tensor<float, 2> depth(Shape{std::int64_t{28}, std::int64_t{42}});
  std::size_t memory = 0;
  std::ptrdiff_t open = 0;
  // With one layer a cached frame does not depend on what came before it, so that the outputs
  // repeat with the pictures once the window is full.
  for (std::int64_t f = 0; f < 400; ++f) {
    const Frame frame = stream.push(images[f % 5]);
    if (f == 100) {
      memory = cli::resident_bytes();
      open = handles();
      depth = copy_of(frame.depth);
    }
    if (f == 395) CHECK_SAME_BITS(frame.depth, depth);
  }
  CHECK(handles() == open);
  if (!kSanitized) CHECK(cli::resident_bytes() < memory + (1 << 20));
}
