// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <charconv>
#include <cmath>

#include "examples/check_reference/cases.h"
#include "examples/check_reference/recorder.h"

namespace check_reference {
namespace {

using namespace lvggt;

std::int64_t metadata_number(const Safetensors& file, const std::string& key) {
  const auto found = file.metadata().find(key);
  std::int64_t value = 0;
  if (found != file.metadata().end()) {
    const std::string& text = found->second;
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
    if (error == std::errc() && end == text.data() + text.size() && value >= 0) return value;
  }
  fail(ErrorKind::kFormat, file.path(), ": metadata \"", key, "\" is needed and must be a number");
}

// [S, C, H, W] as [S, H, W, C]
Tensor<float, 4> channels_last(const Tensor<float, 4>& planes, Context& ctx) {
  const auto [S, C, H, W] = planes.shape();
  Tensor<float, 4> pixels(Shape{S, H, W, C});
  for (std::int64_t s = 0; s < S; ++s) from_planes(pixels[s], planes[s], ctx);
  return pixels;
}

// The input frames, [S, H, W, 3]: the file's, or, where it has none or samples only, those of the
// deterministic rule for the seed and size that the file states.
Tensor<float, 4> input_frames(Comparison& comparison, Context& ctx) {
  const Safetensors& file = comparison.file();
  const TensorEntry* images = file.find("images");
  if (images != nullptr && images->shape.size() == 4) {
    comparison.accept("images");
    return channels_last(file.read<4>("images"), ctx);
  }
  const auto seed = static_cast<std::uint64_t>(metadata_number(file, "seed"));
  if (file.metadata().contains("height"))
    return deterministic_images(seed, metadata_number(file, "frames"),
                                metadata_number(file, "height"), metadata_number(file, "width"));
  const TensorEntry* predicted = file.find("sbd.pred_image");
  LVGGT_CHECK(predicted != nullptr && predicted->shape.size() == 4, file.path(),
              ": neither \"images\" nor \"sbd.pred_image\" tells the size of the frames");
  return deterministic_images(seed, predicted->shape[0], predicted->shape[2], predicted->shape[3]);
}

// Extrinsics [3,4] and intrinsics [3,3] of a pose encoding.
Camera add_camera(Recorder& recorder, const std::string& prefix, View<const float, 1> encoding,
                  const FrameGeometry& geometry) {
  const Camera camera = camera_as_encoded(encoding, geometry.H, geometry.W);
  std::vector<float> extrinsics;
  for (int row = 0; row < 3; ++row)
    for (int column = 0; column < 4; ++column)
      extrinsics.push_back(camera.cam_from_world(row, column));
  recorder.add(prefix + ".extrinsics", extrinsics);
  recorder.add(prefix + ".intrinsics",
               std::vector<float>{camera.fx, 0, camera.cx, 0, camera.fy, camera.cy, 0, 0, 1});
  return camera;
}

// The camera head on one frame alone, and what follows from its camera.
void add_uncached_camera(Recorder& recorder, const LangVggt& model,
                         View<const float, 2> camera_token, const FrameGeometry& geometry,
                         View<const float, 2> depth, Context& ctx) {
  const CameraHead& head = model.geometry().camera_head;
  Tensor<float, 3> encodings(Shape{head.num_iterations, std::int64_t{1}, kPoseEncodingSize});
  camera_head_alone(encodings, camera_token, head, ctx);
  recorder.add("cam.nocache.pose_enc", std::as_const(encodings).view());
  const Camera camera =
      add_camera(recorder, "cam.nocache", encodings[head.num_iterations - 1][0], geometry);
  Tensor<float, 3> points(Shape{geometry.H, geometry.W, std::int64_t{3}});
  unproject(points, depth, camera, ctx);
  recorder.add("unprojected", std::as_const(points).view());
}

void add_frame(Recorder& recorder, const Frame& frame) {
  recorder.add("depth", frame.depth);
  recorder.add("depth_conf", frame.depth_confidence);
  if (frame.points) {
    recorder.add("world_points", frame.points);
    recorder.add("world_points_conf", frame.points_confidence);
  }
  if (frame.rgb) recorder.add_planes("sbd.pred_image", frame.rgb);
  if (!frame.language) return;
  std::vector<float> levels;
  for (std::int64_t level = 0; level < frame.language.extent(0); ++level) {
    const View<const float, 3> map = frame.language[level];
    const std::size_t begin = levels.size();
    levels.resize(begin + static_cast<std::size_t>(map.size()));
    for (std::int64_t i = 0; i < map.extent(0) * map.extent(1); ++i)
      for (std::int64_t c = 0; c < map.extent(2); ++c)
        levels[begin + static_cast<std::size_t>(c * map.extent(0) * map.extent(1) + i)] =
            map.data()[i * map.extent(2) + c];
  }
  recorder.add("sbd.lang_feature", levels);
}

// [frame, iteration, 9] of [iteration, frame, 9]
std::vector<float> frames_first(View<const float, 3> encodings) {
  std::vector<float> values;
  for (std::int64_t s = 0; s < encodings.extent(1); ++s)
    for (std::int64_t i = 0; i < encodings.extent(0); ++i)
      values.insert(values.end(), encodings[i][s].data(),
                    encodings[i][s].data() + kPoseEncodingSize);
  return values;
}

// Frames of which the decoder's output is wanted at another size: *_resized.fN, [..., H, W].
void check_resized(Comparison& comparison, const LangVggt& model, View<const float, 4> images,
                   Context& ctx) {
  const TensorEntry* wanted = nullptr;
  std::int64_t last = -1;
  for (const TensorEntry& entry : comparison.file().entries()) {
    const std::size_t at = entry.name.find("_resized.f");
    if (at == std::string::npos || entry.shape.size() < 3) continue;
    wanted = &entry;
    last = std::max<std::int64_t>(last, std::atoll(entry.name.c_str() + at + 10));
  }
  if (wanted == nullptr || !model.has_decoder()) return;
  const std::size_t rank = wanted->shape.size();
  Stream stream(model, ctx,
                {.allow_degenerate_camera = true,
                 .decoder_height = wanted->shape[rank - 2],
                 .decoder_width = wanted->shape[rank - 1]});
  for (std::int64_t f = 0; f <= std::min(last, images.extent(0) - 1); ++f) {
    const Frame frame = stream.push(images[f]);
    const std::string suffix = "_resized.f" + std::to_string(f);
    std::vector<float> planes;
    const auto append = [&](View<const float, 3> map) {
      for (std::int64_t c = 0; c < map.extent(2); ++c)
        for (std::int64_t i = 0; i < map.extent(0) * map.extent(1); ++i)
          planes.push_back(map.data()[i * map.extent(2) + c]);
    };
    for (std::int64_t level = 0; level < frame.language.extent(0); ++level)
      append(frame.language[level]);
    comparison.compare("sbd.lang_feature" + suffix, planes);
    planes.clear();
    if (frame.rgb) append(frame.rgb);
    comparison.compare("sbd.pred_image" + suffix, planes);
  }
}

LoadOptions with_overrides(LoadOptions load, const Safetensors& file) {
  for (const TensorEntry& entry : file.entries())
    if (entry.name.starts_with("weight.")) load.overrides = file.path();
  return load;
}

}  // namespace

void check_stream(Comparison& comparison, const LoadOptions& load, Storage cache_storage,
                  Context& ctx) {
  const Safetensors& file = comparison.file();
  const LangVggt model = LangVggt::load(with_overrides(load, file), ctx);
  const Tensor<float, 4> images = input_frames(comparison, ctx);
  const auto [S, H, W, channels] = images.shape();
  std::vector<float> planes(static_cast<std::size_t>(images.size()));
  for (std::int64_t s = 0; s < S; ++s)
    to_planes(View<float, 3>(planes.data() + s * channels * H * W, Shape{channels, H, W}),
              images[s], ctx);
  comparison.compare("images", planes);

  StreamOptions options{.cache_storage = cache_storage,
                        .allow_degenerate_camera = true,
                        .points = model.has_point_head()};
  if (comparison.wants("max_num")) {
    options.max_past_frames = file.read_int64("max_num").at(0);
    comparison.accept("max_num");
  }
  const FrameGeometry geometry = make_frame_geometry(model.geometry().aggregator, H, W, ctx);
  comparison.compare("dino.pos_embed", geometry.pos_embed);

  Recorder recorder(comparison);
  recorder.set_frame_size(H, W);
  recorder.set_heads(model.config().agg_heads);
  Stream stream(model, ctx, options);
  std::vector<std::int64_t> frames_attended;
  const std::int64_t width = 2 * model.config().embed_dim;
  for (std::int64_t s = 0; s < S; ++s) {
    const Frame frame = stream.push(images[s], &recorder);
    frames_attended.push_back(frame.frames_attended);
    add_frame(recorder, frame);
    add_camera(recorder, "cam.cached", frame.pose_encoding, geometry);
    const View<const float, 2> token(recorder.camera_tokens().data() + s * width,
                                     Shape{std::int64_t{1}, width});
    add_uncached_camera(recorder, model, token, geometry, frame.depth, ctx);
  }
  recorder.compare(comparison);
  recorder.compare_cache(comparison, std::min(S, options.max_past_frames));
  comparison.compare("frames_attended", frames_attended);
  comparison.compare("cam.cache_length", std::vector<std::int64_t>{stream.camera_cache_length()});
  if (comparison.wants("batch.cam.pose_enc")) {
    const CameraHead& head = model.geometry().camera_head;
    Tensor<float, 3> encodings(Shape{head.num_iterations, S, kPoseEncodingSize});
    camera_head_batch(encodings,
                      View<const float, 2>(recorder.camera_tokens().data(), Shape{S, width}), head,
                      BatchMode::kCausal, ctx);
    comparison.compare("batch.cam.pose_enc", frames_first(encodings));
  }
  check_resized(comparison, model, images, ctx);
}

void check_clip(Comparison& comparison, const LoadOptions& load, BatchMode mode, Context& ctx) {
  const LangVggt model = LangVggt::load(with_overrides(load, comparison.file()), ctx);
  const StreamVggt& geometry = model.geometry();
  const Tensor<float, 4> images = input_frames(comparison, ctx);
  const std::int64_t S = images.extent(0), H = images.extent(1), W = images.extent(2);
  Recorder recorder(comparison);
  recorder.set_frame_size(H, W);
  recorder.set_heads(model.config().agg_heads);
  StageTimes times;
  const ClipGeometry clip = forward_clip(images, geometry, mode, times, &recorder, ctx);
  comparison.compare("dino.pos_embed", clip.geometry.pos_embed);
  comparison.compare("cam.pose_enc", frames_first(clip.pose_encodings));

  // Dense outputs are there for the last frames only: as many as the file's tensors have.
  std::int64_t num_dense = 0;
  for (const char* name : {"depth", "world_points", "sbd.pred_image", "sbd.lang_feature"})
    if (const TensorEntry* entry = comparison.file().find(name); entry && !entry->shape.empty())
      num_dense = std::max(num_dense, std::min(entry->shape[0], S));
  const std::int64_t P = clip.geometry.num_tokens(geometry.aggregator);
  AggregatedTokens tokens;
  Tensor<float, 4> language(Shape{model.config().sbd_levels, H, W, model.config().lang_dim});
  Tensor<float, 3> points(Shape{H, W, std::int64_t{3}}), rgb(Shape{H, W, std::int64_t{3}});
  Tensor<float, 2> depth(Shape{H, W}), confidence(Shape{H, W}), points_confidence(Shape{H, W});
  const std::int64_t h = clip.geometry.h, w = clip.geometry.w;
  const auto depth_embeddings = make_dpt_embeddings(geometry.depth_head, h, w, H, W);
  for (std::int64_t s = S - num_dense; s < S; ++s) {
    std::array<View<const float, 2>, 4> taps;
    for (std::size_t i = 0; i < 4; ++i)
      taps[i] =
          clip.taps[i].view().narrow(0, s * P + geometry.aggregator.patch_start_idx(), (s + 1) * P);
    Frame frame;
    predict_depth(depth, confidence, taps, clip.geometry, geometry.depth_head, depth_embeddings,
                  ctx);
    frame.depth = depth;
    frame.depth_confidence = confidence;
    if (geometry.point_head) {
      predict_points(points, points_confidence, taps, clip.geometry, *geometry.point_head,
                     make_dpt_embeddings(*geometry.point_head, h, w, H, W), ctx);
      frame.points = points;
      frame.points_confidence = points_confidence;
    }
    if (model.has_decoder()) {
      semantic_bridging_decoder_forward(language, rgb, taps, h, w, H, W, model.decoder(), &recorder,
                                        ctx);
      frame.language = language;
      if (model.decoder().rgb_decoder) frame.rgb = rgb;
    }
    add_frame(recorder, frame);
  }
  recorder.compare(comparison);
}

}  // namespace check_reference
