// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <optional>

#include "lvggt/model/aggregator.h"
#include "lvggt/model/camera_head.h"
#include "lvggt/model/dpt_head.h"

namespace lvggt {

// The geometry model: aggregator, camera head and dense heads.
struct StreamVggt {
  Aggregator aggregator;
  CameraHead camera_head;
  DptHead depth_head;
  std::optional<DptHead> point_head;
};

// Patch tokens of frame s of the aggregated tokens: what the dense heads read.
inline std::array<View<const float, 2>, 4> patch_taps(const AggregatedTokens& tokens,
                                                      std::int64_t s, std::int64_t P,
                                                      std::int64_t patch_start_idx) {
  std::array<View<const float, 2>, 4> taps;
  for (std::size_t i = 0; i < 4; ++i)
    taps[i] = tokens.taps[i].narrow(0, s * P + patch_start_idx, (s + 1) * P);
  return taps;
}

// depth, confidence: [H, W]   taps: four times [h*w, 2C]
inline void predict_depth(View<float, 2> depth, View<float, 2> confidence,
                          const std::array<View<const float, 2>, 4>& taps,
                          const FrameGeometry& geometry, const DptHead& head,
                          const std::optional<DptEmbeddings>& embeddings, Context& ctx) {
  const std::int64_t H = geometry.H, W = geometry.W;
  Arena::Scope scope(ctx.arena());
  const View<float, 3> raw = ctx.arena().alloc(Shape{H, W, std::int64_t{2}});
  dpt_head_forward(raw, taps, geometry.h, geometry.w, head, embeddings, ctx);
  depth_activation(depth.reshaped(Shape{H * W}), confidence.reshaped(Shape{H * W}), pixel_rows(raw),
                   ctx);
}

// points: [H, W, 3], in world coordinates   confidence: [H, W]   taps: four times [h*w, 2C]
inline void predict_points(View<float, 3> points, View<float, 2> confidence,
                           const std::array<View<const float, 2>, 4>& taps,
                           const FrameGeometry& geometry, const DptHead& head,
                           const std::optional<DptEmbeddings>& embeddings, Context& ctx) {
  const std::int64_t H = geometry.H, W = geometry.W;
  Arena::Scope scope(ctx.arena());
  const View<float, 3> raw = ctx.arena().alloc(Shape{H, W, std::int64_t{4}});
  dpt_head_forward(raw, taps, geometry.h, geometry.w, head, embeddings, ctx);
  point_activation(pixel_rows(points), confidence.reshaped(Shape{H * W}), pixel_rows(raw), ctx);
}

// Tokens and poses of S frames given at once, which own their memory.
struct ClipGeometry {
  std::int64_t num_frames = 0;
  FrameGeometry geometry;
  std::array<Tensor<float, 2>, 4> taps;  // [S*P, 2C]
  Tensor<float, 2> camera_tokens;        // [S, 2C]
  Tensor<float, 3> pose_encodings;       // [iterations, S, 9]
};

// Batch: all frames of a clip at once, the camera head masked like the global blocks.
//   pixels: [S, H, W, 3], RGB in [0, 1]
inline ClipGeometry forward_clip(View<const float, 4> pixels, const StreamVggt& model,
                                 BatchMode mode, StageTimes& times, Observer* observer,
                                 Context& ctx) {
  const std::int64_t S = pixels.extent(0);
  LVGGT_CHECK(S > 0 && pixels.extent(3) == 3, "forward_clip: pixels are ", pixels.shape(),
              ", not [frames, H, W, 3]");
  ClipGeometry clip{S,
                    make_frame_geometry(model.aggregator, pixels.extent(1), pixels.extent(2), ctx),
                    {},
                    {},
                    {}};
  const std::int64_t P = clip.geometry.num_tokens(model.aggregator),
                     C = model.aggregator.embed_dim();
  Arena::Scope scope(ctx.arena());
  const View<float, 2> tokens = ctx.arena().alloc(Shape{S * P, C});
  {
    const StageTimer timer(times.dino);
    for (std::int64_t s = 0; s < S; ++s)
      embed_frame(tokens.narrow(0, s * P, (s + 1) * P), pixels[s], model.aggregator, s,
                  clip.geometry, observer, ctx);
  }
  AggregatedTokens out;
  for (std::size_t i = 0; i < 4; ++i) {
    clip.taps[i] = Tensor<float, 2>(Shape{S * P, 2 * C});
    out.taps[i] = clip.taps[i];
  }
  clip.camera_tokens = Tensor<float, 2>(Shape{S, 2 * C});
  out.camera = clip.camera_tokens;
  aggregate_batch(out, tokens, model.aggregator, clip.geometry, mode, times, observer, ctx);

  const StageTimer timer(times.camera);
  clip.pose_encodings =
      Tensor<float, 3>(Shape{model.camera_head.num_iterations, S, kPoseEncodingSize});
  camera_head_batch(clip.pose_encodings, clip.camera_tokens, model.camera_head, mode, ctx);
  return clip;
}

}  // namespace lvggt
