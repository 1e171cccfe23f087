// SPDX-License-Identifier: Apache-2.0
// The whole model against dumps of the authors' implementation
// (tests/golden/*_tiny_seed1.safetensors).
#include <doctest/doctest.h>

#include <cmath>

#include "lvggt/kernels/elementwise.h"
#include "tests/support/tiny_model.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// Float runs of the reference are off by up to 1e-5 of a tensor's rms (9e-6 for the language
// features) from its double runs, and so are we; a wrong constant in any module is 2 times that and
// more.
constexpr double kOfRms = 2e-5;

template <int R>
double rms(const Tensor<float, R>& x) {
  double sum = 0;
  for (std::int64_t i = 0; i < x.size(); ++i) sum += double{x.data()[i]} * x.data()[i];
  return std::sqrt(sum / static_cast<double>(x.size()));
}

template <int R>
void check_close(const char* what, View<const float, R> y, const Tensor<float, R>& expected,
                 double of_rms = kOfRms) {
  CAPTURE(what);
  CHECK_CLOSE(y, expected, of_rms * rms(expected));
}

template <int R>
Tensor<float, R - 1> slice(const Tensor<float, R>& x, std::int64_t i) {
  return copy_of(x.view()[i]);
}

Tensor<float, 4> images_of(const Safetensors& file) {
  return channels_last(file.read<4>("images"));
}

// [C, H, W] as [H, W, C]
Tensor<float, 3> pixels_of(View<const float, 3> planes, Context& ctx) {
  Tensor<float, 3> pixels(Shape{planes.extent(1), planes.extent(2), planes.extent(0)});
  from_planes(pixels, planes, ctx);
  return pixels;
}

// Joins the tokens after the frame and the global block of one layer.
class LayerObserver : public Observer {
 public:
  LayerObserver(std::int64_t layer, std::int64_t N, std::int64_t C)
      : layer_(layer), tokens(Shape{N, 2 * C}) {}
  void observe(std::string_view name, std::int64_t idx, View<const float, 2> rows) override {
    if (idx != layer_ || (name != "agg.frame_block" && name != "agg.global_block")) return;
    const std::int64_t C = rows.extent(1), begin = name == "agg.global_block" ? C : 0;
    for (std::int64_t n = 0; n < rows.extent(0); ++n)
      std::copy_n(rows[n].data(), C, tokens[n].data() + begin);
  }

 private:
  std::int64_t layer_;

 public:
  Tensor<float, 2> tokens;
};

void check_layers(View<const float, 4> images, const StreamVggt& model, BatchMode mode,
                  const Safetensors& golden, const std::vector<std::int64_t>& layers,
                  Context& ctx) {
  for (const std::int64_t layer : layers) {
    const Tensor<float, 3> expected = golden.read<3>("agg.layer" + std::to_string(layer));
    const auto [S, P, C2] = expected.shape();
    LayerObserver observer(layer, S * P, C2 / 2);
    StageTimes times;
    forward_clip(images, model, mode, times, &observer, ctx);
    check_close("layer", View<const float, 3>(observer.tokens.data(), expected.shape()), expected);
  }
}

}  // namespace

TEST_CASE("Stream: cameras, depth, points, colours and semantics agree with the reference") {
  const Safetensors golden = open_golden("stream_tiny_seed1.safetensors");
  TinyModel tiny;
  const Tensor<float, 4> images = images_of(golden);
  const Tensor<float, 3> poses = golden.read<3>("cam.cached.pose_enc");
  const Tensor<float, 3> depth = golden.read<3>("depth"), depth_conf = golden.read<3>("depth_conf");
  const Tensor<float, 4> points = golden.read<4>("world_points"),
                         rgb = golden.read<4>("sbd.pred_image");
  const Tensor<float, 3> points_conf = golden.read<3>("world_points_conf");
  const Tensor<float, 5> language = golden.read<5>("sbd.lang_feature");
  StreamOptions options;
  options.points = true;
  Stream stream(tiny.model, tiny.ctx, options);
  for (std::int64_t f = 0; f < 4; ++f) {
    CAPTURE(f);
    const Frame frame = stream.push(images[f]);
    CHECK(frame.index == f);
    CHECK(frame.frames_attended == f + 1);
    check_close("pose", frame.pose_encoding, slice(slice(poses, f), 3));
    check_close("depth", frame.depth, slice(depth, f));
    check_close("depth_conf", frame.depth_confidence, slice(depth_conf, f));
    check_close("points", frame.points, slice(points, f));
    check_close("points_conf", frame.points_confidence, slice(points_conf, f));
    check_close("rgb", frame.rgb, pixels_of(rgb[f], tiny.ctx));
    for (std::int64_t level = 0; level < 3; ++level)
      check_close("language", frame.language[level], pixels_of(language[f][level], tiny.ctx));
  }
  CHECK(stream.camera_cache_length() == golden.read_int64("cam.cache_length").at(0));
}

TEST_CASE("Stream: the decoder's outputs are resized when another size is wanted") {
  const Safetensors golden = open_golden("stream_tiny_seed1.safetensors");
  TinyModel tiny;
  StreamOptions options;
  options.decoder_height = 60;
  options.decoder_width = 90;
  Stream stream(tiny.model, tiny.ctx, options);
  const Tensor<float, 4> language = golden.read<4>("sbd.lang_feature_resized.f0");
  const Tensor<float, 4> images = images_of(golden);
  const Frame frame = stream.push(images[0]);
  check_close("rgb", frame.rgb, pixels_of(golden.read<3>("sbd.pred_image_resized.f0"), tiny.ctx));
  for (std::int64_t level = 0; level < 3; ++level)
    check_close("language", frame.language[level], pixels_of(language[level], tiny.ctx));
}

TEST_CASE(
    "Stream: with a limit of 3 past frames, frames see 1, 2, 3, 4, 4, 4 and agree with the "
    "reference") {
  const Safetensors golden = open_golden("evict_tiny_seed1.safetensors");
  TinyModel tiny;
  const Tensor<float, 4> images = images_of(golden);
  const Tensor<float, 3> poses = golden.read<3>("cam.nocache.pose_enc");
  StreamOptions options;
  options.max_past_frames = golden.read_int64("max_num").at(0);
  options.camera_cache = CameraCache::kPerFrame;
  options.decoder = false;
  Stream stream(tiny.model, tiny.ctx, options);
  const std::vector<std::int64_t> attended = golden.read_int64("frames_attended");
  for (std::int64_t f = 0; f < 6; ++f) {
    const Frame frame = stream.push(images[f]);
    CHECK(frame.frames_attended == attended[static_cast<std::size_t>(f)]);
    CHECK(frame.language.empty());
    check_close("pose", frame.pose_encoding, slice(slice(poses, f), 3));
  }
}

TEST_CASE("forward_clip: causal tokens and cameras agree with the reference") {
  const Safetensors golden = open_golden("batch_tiny_seed1.safetensors");
  TinyModel tiny;
  const Tensor<float, 4> images = images_of(golden);
  check_layers(images, tiny.model.geometry(), BatchMode::kCausal, golden, {0, 1, 2, 3}, tiny.ctx);
  StageTimes times;
  const ClipGeometry clip =
      forward_clip(images, tiny.model.geometry(), BatchMode::kCausal, times, nullptr, tiny.ctx);
  const Tensor<float, 3> poses = permuted<3>(golden.read<3>("cam.pose_enc"), {1, 0, 2});
  check_close("pose", clip.pose_encodings.view(), poses);
}

TEST_CASE("forward_clip: causal tokens equal streamed ones while nothing is evicted") {
  const Safetensors golden = open_golden("stream_tiny_seed1.safetensors");
  TinyModel tiny;
  check_layers(images_of(golden), tiny.model.geometry(), BatchMode::kCausal, golden, {0, 3},
               tiny.ctx);
}

TEST_CASE("forward_clip: bidirectional tokens, cameras and depth agree with the reference") {
  const Safetensors golden = open_golden("vggt_tiny_seed1.safetensors");
  TinyModel tiny;
  const StreamVggt& model = tiny.model.geometry();
  const Tensor<float, 4> images = images_of(golden);
  check_layers(images, model, BatchMode::kBidirectional, golden, {0, 3}, tiny.ctx);
  StageTimes times;
  const ClipGeometry clip =
      forward_clip(images, model, BatchMode::kBidirectional, times, nullptr, tiny.ctx);
  check_close("pose", clip.pose_encodings.view(),
              permuted<3>(golden.read<3>("cam.pose_enc"), {1, 0, 2}));

  const std::int64_t P = clip.geometry.num_tokens(model.aggregator);
  std::array<View<const float, 2>, 4> taps;
  for (std::size_t i = 0; i < 4; ++i) taps[i] = clip.taps[i].view().narrow(0, 2 * P + 5, 3 * P);
  Tensor<float, 2> depth(Shape{56, 84}), confidence(Shape{56, 84});
  predict_depth(depth, confidence, taps, clip.geometry, model.depth_head,
                make_dpt_embeddings(model.depth_head, 4, 6, 56, 84), tiny.ctx);
  check_close("depth", as_view(depth), slice(golden.read<3>("depth"), 0));
  check_close("depth_conf", as_view(confidence), slice(golden.read<3>("depth_conf"), 0));
}

TEST_CASE(
    "make_frame_geometry: a square frame of the table's size uses the position table as it is") {
  const Safetensors golden = open_golden("square56_tiny_seed1.safetensors");
  TinyModel tiny;
  const Aggregator& aggregator = tiny.model.geometry().aggregator;
  CHECK_SAME_BITS(make_frame_geometry(aggregator, 56, 56, tiny.ctx).pos_embed,
                  aggregator.patch_embed.pos_embed);
  check_layers(images_of(golden), tiny.model.geometry(), BatchMode::kCausal, golden, {0, 3},
               tiny.ctx);
}

TEST_CASE("LangVggt::load: overriding tensors may change the number of language channels") {
  const Safetensors golden = open_golden("stream_lang6_tiny_seed1.safetensors");
  const TempDir dir;
  write_tensors(dir / "model.safetensors", all_tensors(tiny_config()), nullptr);
  Context ctx(2);
  LoadOptions load;
  load.weights = dir / "model.safetensors";
  load.overrides = golden.path();
  const LangVggt model = LangVggt::load(load, ctx);
  CHECK(model.config().lang_dim == 6);
  Stream stream(model, ctx);
  const Tensor<float, 4> images = deterministic_images(1, 1, 56, 84);
  const Frame frame = stream.push(images[0]);
  const Tensor<float, 5> language = golden.read<5>("sbd.lang_feature");
  for (std::int64_t level = 0; level < 3; ++level)
    check_close("language", frame.language[level], pixels_of(language[0][level], ctx));
}
