// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/stream.h"

#include <doctest/doctest.h>

#include <cmath>

#include "tests/support/allocations.h"
#include "tests/support/tiny_model.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// The stages of one model that are quick to run: a single layer of everything.
ModelConfig small_config() {
  ModelConfig config = tiny_config();
  config.dino_depth = 1;
  config.agg_depth = 1;
  config.taps = {0, 0, 0, 0};
  config.cam_trunk_depth = 1;
  return config;
}

std::string error_of(const std::function<void()>& body, ErrorKind kind) {
  try {
    body();
  } catch (const Error& e) {
    CHECK(e.kind() == kind);
    return e.what();
  }
  FAIL("no error");
  return {};
}

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

template <int R>
bool all_finite(View<const float, R> x) {
  for (std::int64_t i = 0; i < x.size(); ++i)
    if (!std::isfinite(x.data()[i])) return false;
  return true;
}

}  // namespace

TEST_CASE("Stream: from the second frame on, push does not touch the heap") {
  TinyModel tiny;
  StreamOptions options;
  options.points = true;
  options.max_past_frames = 3;
  const Tensor<float, 4> images = deterministic_images(1, 8, 56, 84);
  for (const int threads : {1, 3}) {
    CAPTURE(threads);
    Context ctx(threads);
    Stream stream(tiny.model, ctx, options);
    stream.push(images[0]);
    int frames_that_allocate = 0;
    for (std::int64_t f = 1; f < 8; ++f) {
      const std::int64_t before = num_allocations();
      stream.push(images[f]);
      if (num_allocations() != before) ++frames_that_allocate;
    }
    CHECK(frames_that_allocate == 0);
  }
}

TEST_CASE("D36: 1 and 4 threads give the same bits") {
  TinyModel tiny;
  const Tensor<float, 4> images = deterministic_images(1, 3, 56, 84);
  Context one(1), four(4);
  StreamOptions options;
  options.points = true;
  Stream a(tiny.model, one, options), b(tiny.model, four, options);
  for (std::int64_t f = 0; f < 3; ++f) {
    const Frame x = a.push(images[f]), y = b.push(images[f]);
    CHECK_SAME_BITS(x.pose_encoding, y.pose_encoding);
    CHECK_SAME_BITS(x.depth, y.depth);
    CHECK_SAME_BITS(x.depth_confidence, y.depth_confidence);
    CHECK_SAME_BITS(x.points, y.points);
    CHECK_SAME_BITS(x.rgb, y.rgb);
    CHECK_SAME_BITS(x.language, y.language);
  }
}

TEST_CASE("Stream: an evicted frame has no influence left") {
  TinyModel tiny(small_config());
  const Tensor<float, 4> images = deterministic_images(1, 5, 56, 84);
  StreamOptions options;
  options.max_past_frames = 1;
  options.decoder = false;
  // Two streams that differ in their first frame agree again once it and what saw it are evicted:
  // frame 3 sees the keys of frame 2, which were made from frame 1, which saw frame 0.
  Stream a(tiny.model, tiny.ctx, options), b(tiny.model, tiny.ctx, options);
  a.push(images[0]);
  b.push(images[4]);
  const Tensor<float, 2> depth = copy_of(a.push(images[1]).depth);
  CHECK_FALSE(compare_bits(b.push(images[1]).depth, as_view(depth)).ok);
  // With one layer the cached keys of a frame do not depend on what it attended to.
  const Tensor<float, 2> later = copy_of(a.push(images[2]).depth);
  CHECK_SAME_BITS(b.push(images[2]).depth, later);
}

TEST_CASE("Stream: the paper's ablations run and give what they should") {
  const Tensor<float, 4> images = deterministic_images(1, 1, 42, 56);
  const auto check = [&](const ModelConfig& config) {
    TinyModel tiny(config);
    Stream stream(tiny.model, tiny.ctx);
    const Frame frame = stream.push(images[0]);
    CHECK(frame.language.shape() == (Shape<4>{config.sbd_levels, 42, 56, config.lang_dim}));
    CHECK(all_finite(frame.language));
    CHECK(frame.rgb.empty() == !config.sbd_rgb);
    if (config.sbd_rgb) CHECK(frame.rgb.shape() == (Shape<3>{42, 56, 3}));
    CHECK(frame.points.empty());
  };
  ModelConfig config = small_config();
  SUBCASE("without the RGB head") { config.sbd_rgb = false; }
  SUBCASE("MLP heads") { config.sbd_head = DecoderHead::kMlp; }
  SUBCASE("without the DPT") { config.sbd_dpt = false; }
  SUBCASE("one level of six channels") {
    config.sbd_levels = 1;
    config.lang_dim = 6;
  }
  SUBCASE("all of them") {
    config.sbd_rgb = false;
    config.sbd_head = DecoderHead::kMlp;
    config.sbd_dpt = false;
    config.sbd_levels = 1;
  }
  check(config);
}

TEST_CASE("Stream: configurations unlike the published one run, and streams agree with batches") {
  ModelConfig config = tiny_config();
  SUBCASE("other widths, heads and patches") {
    config.embed_dim = 48;
    config.dino_heads = 3;
    config.agg_heads = 2;
    config.cam_heads = 6;
    config.patch_size = 16;
    config.img_size = 48;
    config.mlp_ratio = 2.5;
  }
  SUBCASE("qk-norm elsewhere, none in the aggregator") {
    config.dino_qk_norm = config.cam_qk_norm = true;
    config.agg_qk_norm = false;
  }
  SUBCASE("no registers, no trunk, taps that repeat") {
    config.num_register_tokens = 0;
    config.cam_trunk_depth = 0;
    config.agg_depth = 3;
    config.taps = {0, 1, 1, 1};
  }
  SUBCASE("many refinements") { config.cam_iterations = 19; }
  SUBCASE("no position embedding in the heads, odd channels") {
    config.dpt_pos_embed_ratio = 0;
    config.dpt_features = 40;
    config.sbd_features = 7;
    config.sbd_hidden_dim = 3;
    config.sbd_out_channels = {5, 6, 7, 9};
  }
  TinyModel tiny(config);
  const std::int64_t H = 2 * config.patch_size, W = 3 * config.patch_size;
  const Tensor<float, 4> images = deterministic_images(1, 3, H, W);
  StageTimes times;
  const ClipGeometry clip =
      forward_clip(images, tiny.model.geometry(), BatchMode::kCausal, times, nullptr, tiny.ctx);
  StreamOptions options;
  options.points = true;
  options.allow_degenerate_camera = true;
  Stream stream(tiny.model, tiny.ctx, options);
  const FrameGeometry& geometry = clip.geometry;
  const std::int64_t P = geometry.num_tokens(tiny.model.geometry().aggregator);
  Tensor<float, 2> depth(Shape{H, W}), confidence(Shape{H, W});
  const DptHead& head = tiny.model.geometry().depth_head;
  for (std::int64_t f = 0; f < 3; ++f) {
    const Frame frame = stream.push(images[f]);
    CHECK(all_finite(frame.language));
    CHECK(all_finite(frame.points));
    std::array<View<const float, 2>, 4> taps;
    for (std::size_t i = 0; i < 4; ++i)
      taps[i] = clip.taps[i].view().narrow(0, f * P + config.patch_start_idx(), (f + 1) * P);
    predict_depth(depth, confidence, taps, geometry, head,
                  make_dpt_embeddings(head, geometry.h, geometry.w, H, W), tiny.ctx);
    CHECK_CLOSE(frame.depth, depth, 0, 1e-4);
  }
  CHECK(stream.camera_cache_length() == 3 * config.cam_iterations);
}

TEST_CASE("Stream: parts that are not asked for are not computed") {
  TinyModel tiny(small_config());
  const Tensor<float, 4> images = deterministic_images(1, 1, 28, 28);
  StreamOptions options;
  options.rgb = false;
  Stream stream(tiny.model, tiny.ctx, options);
  const Frame frame = stream.push(images[0]);
  CHECK(frame.rgb.empty());
  CHECK_FALSE(frame.language.empty());
  CHECK(frame.times.points == 0);
  CHECK(frame.times.total >= frame.times.dino);
}

TEST_CASE("C17: a frame of another size is refused, and the stream goes on") {
  TinyModel tiny(small_config());
  const Tensor<float, 4> images = deterministic_images(1, 2, 28, 42),
                         other = deterministic_images(1, 1, 42, 28);
  Stream stream(tiny.model, tiny.ctx);
  stream.push(images[0]);
  const std::string message = error_of([&] { stream.push(other[0]); }, ErrorKind::kMismatch);
  CHECK(contains(message, "28 x 42"));
  CHECK(contains(message, "42 x 28"));
  CHECK(stream.push(images[1]).index == 1);
}

TEST_CASE("C08: frames that are not made of whole patches are refused") {
  TinyModel tiny(small_config());
  for (const auto& [H, W] : {std::pair{13, 14}, std::pair{28, 30}, std::pair{0, 0}}) {
    Stream stream(tiny.model, tiny.ctx);
    const Tensor<float, 3> pixels(Shape<3>{H, W, 3});
    error_of([&] { stream.push(pixels); }, ErrorKind::kMismatch);
  }
  Stream stream(tiny.model, tiny.ctx);
  const Tensor<float, 3> smallest(Shape<3>{14, 14, 3});
  CHECK(stream.push(smallest).depth.shape() == (Shape<2>{14, 14}));
}

TEST_CASE("C18: black, white and repeated frames give finite numbers") {
  TinyModel tiny;
  Stream stream(tiny.model, tiny.ctx);
  Tensor<float, 3> pixels(Shape<3>{28, 42, 3});
  for (const float value : {0.0f, 1.0f, 1.0f, 1.0f}) {
    std::fill_n(pixels.data(), pixels.size(), value);
    CHECK(all_finite(stream.push(pixels).language));
  }
}

TEST_CASE("D25: a pixel that is not finite is named with its frame and leaves no trace") {
  TinyModel tiny(small_config());
  const Tensor<float, 4> images = deterministic_images(1, 2, 28, 42);
  Stream stream(tiny.model, tiny.ctx), undisturbed(tiny.model, tiny.ctx);
  stream.push(images[0]);
  undisturbed.push(images[0]);
  Tensor<float, 3> damaged = copy_of(images[1]);
  damaged(3, 5, 1) = NAN;
  const std::string message = error_of([&] { stream.push(damaged); }, ErrorKind::kNumeric);
  CHECK(contains(message, "frame 1"));
  CHECK(contains(message, "input pixels"));
  CHECK_SAME_BITS(stream.push(images[1]).depth, undisturbed.push(images[1]).depth);
}

TEST_CASE("D28: a value that is not finite is named with the stage that made it") {
  const Tensor<float, 4> images = deterministic_images(1, 1, 28, 42);
  const auto message_for = [&](const std::string& tensor) {
    TinyModel tiny(
        small_config(),
        [&](WeightTensor& t) {
          if (t.name == tensor) t.values[0] = INFINITY;
        },
        true);
    CHECK(tiny.model.warnings().size() == 1);
    Stream stream(tiny.model, tiny.ctx);
    const std::string message = error_of([&] { stream.push(images[0]); }, ErrorKind::kNumeric);
    CHECK(contains(message, "frame 0"));
    return message;
  };
  CHECK(contains(message_for("aggregator.patch_embed.norm.bias"), "DINOv2"));
  CHECK(contains(message_for("aggregator.global_blocks.0.mlp.fc2.bias"), "aggregator"));
  CHECK(contains(message_for("camera_head.pose_branch.fc2.bias"), "camera head"));
  CHECK(contains(message_for("depth_head.scratch.output_conv2.2.bias"), "depth head"));
  CHECK(contains(message_for("lang_decoder_middle.final_conv.bias"), "decoder"));
}

TEST_CASE("D31: a depth that overflows is named") {
  TinyModel tiny(small_config(), [](WeightTensor& t) {
    if (t.name == "depth_head.scratch.output_conv2.2.bias") t.values[0] = 1000;
  });
  Stream stream(tiny.model, tiny.ctx);
  const Tensor<float, 4> images = deterministic_images(1, 1, 28, 28);
  CHECK(contains(error_of([&] { stream.push(images[0]); }, ErrorKind::kNumeric), "depth"));
}

TEST_CASE(
    "D32: a field of view of 0 is named with its frame, or given as NaN when that is allowed") {
  TinyModel tiny(small_config(), [](WeightTensor& t) {
    if (t.name == "camera_head.pose_branch.fc2.bias") t.values[8] = -100;
  });
  const Tensor<float, 4> images = deterministic_images(1, 1, 28, 28);
  Stream stream(tiny.model, tiny.ctx);
  const std::string message = error_of([&] { stream.push(images[0]); }, ErrorKind::kNumeric);
  CHECK(contains(message, "frame 0"));
  CHECK(contains(message, "camera"));
  StreamOptions options;
  options.allow_degenerate_camera = true;
  Stream lenient(tiny.model, tiny.ctx, options);
  CHECK(std::isnan(lenient.push(images[0]).camera.fx));
}

TEST_CASE("Stream: options out of range are usage errors") {
  TinyModel tiny(small_config());
  StreamOptions options;
  SUBCASE("no past frame") { options.max_past_frames = 0; }
  SUBCASE("negative past frames") { options.max_past_frames = -1; }
  SUBCASE("too many past frames") { options.max_past_frames = kMaxPastFrames + 1; }
  SUBCASE("half a size") { options.decoder_height = 10; }
  SUBCASE("negative size") { options.decoder_height = options.decoder_width = -1; }
  error_of([&] { Stream(tiny.model, tiny.ctx, options); }, ErrorKind::kUsage);
}

TEST_CASE("plan_memory: the published weights and the cache of four frames") {
  const ModelConfig config;  // published
  StreamOptions options;
  options.max_past_frames = 3;
  options.points = true;
  const MemoryPlan plan = plan_memory(config, 294, 518, options);
  const double unpacked = 4.0 * 1219050724;
  CHECK(static_cast<double>(plan.weights) > 0.999 * unpacked);
  CHECK(static_cast<double>(plan.weights) < 1.002 * unpacked);
  // 24 layers of keys and values of 782 tokens, padded to 784, and the camera's entries, for 4
  // frames.
  CHECK(plan.cache == 4u * (24u * 2u * 784u * 1024u + 4u * 16u * 2u * 16u * 128u) * 4u);
  CHECK(plan.total == plan.weights + plan.cache + plan.arenas);
}

TEST_CASE("plan_memory: 128 past frames of 294 x 518 in an int8 cache take at most 5.2 GiB") {
  StreamOptions options;
  options.cache_storage = Storage::kI8;
  const MemoryPlan plan = plan_memory(ModelConfig{}, 294, 518, options);
  CHECK(plan.cache == std::size_t{129} * (24u * (2u * 784u * 1024u + 2u * 16u * 784u * 4u) +
                                          4u * 2u * 16u * 16u * 128u * 4u));
  CHECK(static_cast<double>(plan.cache) <= 5.2 * 0x1p30);
}

TEST_CASE("D39: the planned scratch is within a tenth of what a stream uses") {
  TinyModel tiny;
  const Tensor<float, 4> images = deterministic_images(1, 1, 294, 518);
  Context ctx(1);
  Stream stream(tiny.model, ctx);
  stream.push(images[0]);
  const MemoryPlan plan = plan_memory(tiny.model.config(), 294, 518);
  const double outputs = 4.0 * 294 * 518 * (2 + 9 + 3);
  const double used = static_cast<double>(ctx.arena().peak_bytes()) + outputs;
  CHECK(static_cast<double>(plan.arenas) > 0.9 * used);
  CHECK(static_cast<double>(plan.arenas) < 1.1 * used);
}
