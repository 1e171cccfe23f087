// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <string>

#include "lvggt/train/fusion_block.h"
#include "lvggt/train/reassemble.h"

namespace lvggt {

using Taps = std::array<View<const float, 3>, 4>;    // [B, h*w, 2C], patch tokens only
using TapGradients = std::array<View<float, 3>, 4>;  // an empty one is not wanted

struct DptActivations {
  std::array<ReassembleActivations, 4> reassemble;
  std::array<Shape<4>, 4> layers;  // shapes of the reassembled maps
  std::array<FusionBlockActivations, 4> refinenet;
  View<float, 4> fused;  // what output_conv1 reads
};

// A tap's view as rows; empty when it is.
inline View<float, 2> token_rows(View<float, 3> tokens) {
  if (tokens.empty()) return {};
  return tokens.reshaped(Shape{tokens.extent(0) * tokens.extent(1), tokens.extent(2)});
}

// The DPT's features: taps reassembled, fused from the coarsest to the finest, output_conv1,
// resize.
//   y: [B, H, W, F]   h, w: patch grid
inline void dpt_forward(View<float, 4> y, DptActivations& kept, const Taps& taps, std::int64_t h,
                        std::int64_t w, const DptParameters<const float>& dpt, float eps,
                        TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena& arena = ctx.arena();
  const std::int64_t B = y.extent(0);
  std::array<View<float, 4>, 4> layers;
  for (std::size_t i = 0; i < 4; ++i) {
    const ReassembleParameters<const float>& tap = dpt.reassemble[i];
    kept.layers[i] = reassembled_shape(tap, Shape{B, h, w, tap.project.weight.extent(0)});
    layers[i] = arena.alloc(kept.layers[i]);
    reassemble_forward(layers[i], kept.reassemble[i], taps[i], h, w, tap, eps, pass);
  }
  View<float, 4> fused = layers[3], skip;
  for (std::size_t i = 4; i-- > 0;) {
    // To the size of the next layer, the last to twice its own.
    Shape<4> shape = kept.layers[i == 0 ? 0 : i - 1];
    if (i == 0) shape = Shape{B, 2 * shape[1], 2 * shape[2], shape[3]};
    const View<float, 4> resized = arena.alloc(shape);
    fusion_block_forward(resized, kept.refinenet[i], fused, skip, dpt.refinenet[i], pass);
    fused = resized;
    if (i > 0) skip = layers[i - 1];
  }
  kept.fused = fused;
  Arena::Scope scope(arena);
  const View<float, 4> output = arena.alloc(conv2d_shape(dpt.output_conv1, fused.shape()));
  conv2d_forward(output, fused, dpt.output_conv1, Activation::kNone, {}, ctx);
  bilinear_forward(y, output, true, ctx);
}

inline void dpt_backward(const TapGradients& dtaps, const DptParameters<float>& gradient,
                         View<const float, 4> dy, const DptActivations& kept,
                         const DptParameters<const float>& dpt, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena& arena = ctx.arena();
  Arena::Scope scope(arena);
  std::array<View<float, 4>, 4> dlayers;
  for (std::size_t i = 0; i < 4; ++i) dlayers[i] = arena.alloc(kept.layers[i]);
  {
    Arena::Scope maps(arena);
    View<float, 4> dfused = arena.alloc(kept.fused.shape());
    {
      Arena::Scope output(arena);
      const View<float, 4> doutput =
          arena.alloc(conv2d_shape(dpt.output_conv1, kept.fused.shape()));
      bilinear_backward(doutput, dy, true, ctx);
      conv2d_backward(dfused, gradient.output_conv1, doutput, kept.fused, dpt.output_conv1, ctx);
    }
    for (std::size_t i = 0; i < 4; ++i) {
      // refinenet{i+1} read the map fused before it and, but for the coarsest, layer i as its skip.
      const View<float, 4> dx = i == 3 ? dlayers[3] : arena.alloc(kept.layers[i]);
      const View<float, 4> dskip = i == 3 ? View<float, 4>() : dlayers[i];
      fusion_block_backward(dx, dskip, gradient.refinenet[i], dfused, kept.refinenet[i],
                            dpt.refinenet[i], pass);
      dfused = dx;
    }
  }
  if (pass.gradients_ready) {
    pass.gradients_ready("feature_extractor.scratch.output_conv1.");
    pass.gradients_ready("feature_extractor.scratch.refinenet");
  }
  for (std::size_t i = 4; i-- > 0;) {
    reassemble_backward(token_rows(dtaps[i]), gradient.reassemble[i], dlayers[i],
                        kept.reassemble[i], dpt.reassemble[i], pass);
    if (!pass.gradients_ready) continue;
    const std::string number = std::to_string(i);
    pass.gradients_ready("feature_extractor.projects." + number);
    pass.gradients_ready("feature_extractor.resize_layers." + number);
    pass.gradients_ready("feature_extractor.scratch.layer" + std::to_string(i + 1));
  }
  if (pass.gradients_ready) pass.gradients_ready("feature_extractor.norm.");
}

// The ablation without a DPT: the last tap projected to F channels and resized.
inline void projection_forward(View<float, 4> y, const Taps& taps, std::int64_t h, std::int64_t w,
                               const LinearParameters<const float>& project, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  const auto [B, N, C2] = taps[3].shape();
  const View<float, 4> projected = ctx.arena().alloc(Shape{B, h, w, y.extent(3)});
  linear_forward(batch_rows(projected), taps[3].reshaped(Shape{B * N, C2}), project,
                 Activation::kNone, ctx);
  bilinear_forward(y, projected, true, ctx);
}

inline void projection_backward(const TapGradients& dtaps, const LinearParameters<float>& gradient,
                                View<const float, 4> dy, const Taps& taps, std::int64_t h,
                                std::int64_t w, const LinearParameters<const float>& project,
                                TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  const auto [B, N, C2] = taps[3].shape();
  const View<float, 4> dprojected = ctx.arena().alloc(Shape{B, h, w, dy.extent(3)});
  bilinear_backward(dprojected, dy, true, ctx);
  linear_backward(token_rows(dtaps[3]), gradient, batch_rows(dprojected),
                  taps[3].reshaped(Shape{B * N, C2}), project, ctx);
  for (std::size_t i = 0; i < 3; ++i)  // the other taps play no part
    if (dtaps[i]) std::fill_n(dtaps[i].data(), dtaps[i].size(), 0.0f);
  if (pass.gradients_ready) pass.gradients_ready("feature_extractor.project.");
}

}  // namespace lvggt
