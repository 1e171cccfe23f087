// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/token_stream.h"

#include <doctest/doctest.h>

#include <cstring>

#include "lvggt/model/memory_plan.h"
#include "tests/support/safetensors_bytes.h"
#include "tests/support/tiny_model.h"

using namespace lvggt;

TEST_CASE("token_stream: its tokens are those that the heads of a stream read, to the bit") {
  const test::TinyModel tiny;
  Context ctx(2);
  const Tensor<float, 4> images = deterministic_images(3, 5, 56, 84);
  StreamOptions options;
  options.max_past_frames = 2;  // frames are evicted
  options.decoder = false;
  options.allow_degenerate_camera = true;
  Stream stream(tiny.model, ctx, options);
  const StreamVggt& geometry = tiny.model.geometry();
  TokenStream tokens(geometry.aggregator, ctx, options);
  const FrameGeometry sizes = make_frame_geometry(geometry.aggregator, 56, 84, ctx);
  const auto embeddings = make_dpt_embeddings(geometry.depth_head, 4, 6, 56, 84);
  Tensor<float, 2> depth(Shape{56, 84}), confidence(Shape{56, 84});
  for (std::int64_t s = 0; s < 5; ++s) {
    const Frame frame = stream.push(images[s]);
    const auto taps = tokens.push(images[s]);
    CHECK(taps[0].shape() == (Shape{24, 2 * tiny.model.config().embed_dim}));
    predict_depth(depth, confidence, taps, sizes, geometry.depth_head, embeddings, ctx);
    CHECK(std::memcmp(depth.data(), frame.depth.data(), depth.num_bytes()) == 0);
  }
}

TEST_CASE("token_stream: wrong sizes, pixels and options are refused, and the stream goes on") {
  const test::TinyModel tiny;
  Context ctx(1);
  const Aggregator& aggregator = tiny.model.geometry().aggregator;
  StreamOptions options;
  options.max_past_frames = 0;
  CHECK(test::outcome_of([&] { TokenStream(aggregator, ctx, options); }).kind == ErrorKind::kUsage);
  options.max_past_frames = 4;
  options.cache_storage = Storage::kF16;
  CHECK(test::outcome_of([&] { TokenStream(aggregator, ctx, options); }).kind == ErrorKind::kUsage);
  options.cache_storage = Storage::kF32;
  TokenStream stream(aggregator, ctx, options), undisturbed(aggregator, ctx, options);
  Tensor<float, 4> images = deterministic_images(3, 3, 28, 42);
  stream.push(images[0]);
  undisturbed.push(images[0]);
  const Tensor<float, 4> other = deterministic_images(3, 1, 42, 42);
  CHECK(test::outcome_of([&] { stream.push(other[0]); }).says("frame 1 has 42 x 42"));
  images(2, 5, 6, 1) = std::nanf("");
  CHECK(test::outcome_of([&] { stream.push(images[2]); }).kind == ErrorKind::kNumeric);
  const auto a = stream.push(images[1]), b = undisturbed.push(images[1]);
  CHECK(std::memcmp(a[3].data(), b[3].data(), static_cast<std::size_t>(a[3].size()) * 4) == 0);
}

TEST_CASE("plan_token_memory: less than a whole stream, and grows with the window") {
  const ModelConfig published;
  const auto f32 = [](const std::string&) { return Storage::kF32; };
  StreamOptions options;
  options.max_past_frames = 8;
  const MemoryPlan tokens = plan_token_memory(published, 294, 518, options, f32);
  const MemoryPlan whole = plan_memory(published, 294, 518, options);
  CHECK(tokens.weights < whole.weights);
  CHECK(tokens.weights > std::size_t{3'600'000'000});  // 909 M values
  CHECK(tokens.cache < whole.cache);
  CHECK(tokens.arenas < whole.arenas);
  CHECK(tokens.total == tokens.weights + tokens.cache + tokens.arenas);
  options.max_past_frames = 16;
  CHECK(plan_token_memory(published, 294, 518, options, f32).cache > tokens.cache * 18 / 10);
  CHECK_THROWS_AS(plan_token_memory(published, 0, 518, options, f32), Error);
}
