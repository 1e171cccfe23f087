// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <string>

#include "lvggt/train/fusion_block.h"
#include "lvggt/train/reassemble.h"

namespace lvggt {

template <class T>
using Taps = std::array<View<const T, 3>, 4>;  // [B, h*w, 2C], patch tokens only
template <class T>
using TapGradients = std::array<View<T, 3>, 4>;  // an empty one is not wanted

template <class T>
struct DptActivations {
  std::array<ReassembleActivations<T>, 4> reassemble;
  std::array<Shape<4>, 4> layers;  // shapes of the reassembled maps
  std::array<FusionBlockActivations<T>, 4> refinenet;
  View<T, 4> fused;  // what output_conv1 reads
};

// A tap's view as rows; empty when it is.
template <class T>
View<T, 2> token_rows(View<T, 3> tokens) {
  if (tokens.empty()) return {};
  return tokens.reshaped(Shape{tokens.extent(0) * tokens.extent(1), tokens.extent(2)});
}

// The DPT's features: taps reassembled, fused from the coarsest to the finest, output_conv1,
// resize.
//   y: [B, H, W, F]   h, w: patch grid
template <class T>
void dpt_forward(View<T, 4> y, DptActivations<T>& kept, const Taps<T>& taps, std::int64_t h,
                 std::int64_t w, const DptParameters<const T>& dpt, T eps, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena& arena = ctx.arena();
  const std::int64_t B = y.extent(0);
  std::array<View<T, 4>, 4> layers;
  for (std::size_t i = 0; i < 4; ++i) {
    const ReassembleParameters<const T>& tap = dpt.reassemble[i];
    kept.layers[i] = reassembled_shape(tap, Shape{B, h, w, tap.project.weight.extent(0)});
    layers[i] = arena.alloc<T>(kept.layers[i]);
    reassemble_forward(layers[i], kept.reassemble[i], taps[i], h, w, tap, eps, pass);
  }
  View<T, 4> fused = layers[3], skip;
  for (std::size_t i = 4; i-- > 0;) {
    // To the size of the next layer, the last to twice its own.
    Shape<4> shape = kept.layers[i == 0 ? 0 : i - 1];
    if (i == 0) shape = Shape{B, 2 * shape[1], 2 * shape[2], shape[3]};
    const View<T, 4> resized = arena.alloc<T>(shape);
    fusion_block_forward(resized, kept.refinenet[i], fused, skip, dpt.refinenet[i], pass);
    fused = resized;
    if (i > 0) skip = layers[i - 1];
  }
  kept.fused = fused;
  Arena::Scope scope(arena);
  const View<T, 4> output = arena.alloc<T>(conv2d_shape(dpt.output_conv1, fused.shape()));
  conv2d_forward(output, fused, dpt.output_conv1, Activation::kNone, {}, ctx);
  bilinear_forward(y, output, true, ctx);
}

template <class T>
void dpt_backward(const TapGradients<T>& dtaps, const DptParameters<T>& gradient,
                  ConstView<T, 4> dy, const DptActivations<T>& kept,
                  const DptParameters<const T>& dpt, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena& arena = ctx.arena();
  Arena::Scope scope(arena);
  std::array<View<T, 4>, 4> dlayers;
  for (std::size_t i = 0; i < 4; ++i) dlayers[i] = arena.alloc<T>(kept.layers[i]);
  {
    Arena::Scope maps(arena);
    View<T, 4> dfused = arena.alloc<T>(kept.fused.shape());
    {
      Arena::Scope output(arena);
      const View<T, 4> doutput = arena.alloc<T>(conv2d_shape(dpt.output_conv1, kept.fused.shape()));
      bilinear_backward(doutput, dy, true, ctx);
      conv2d_backward(dfused, gradient.output_conv1, doutput, kept.fused, dpt.output_conv1, ctx);
    }
    for (std::size_t i = 0; i < 4; ++i) {
      // refinenet{i+1} read the map fused before it and, but for the coarsest, layer i as its skip.
      const View<T, 4> dx = i == 3 ? dlayers[3] : arena.alloc<T>(kept.layers[i]);
      const View<T, 4> dskip = i == 3 ? View<T, 4>() : dlayers[i];
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
template <class T>
void projection_forward(View<T, 4> y, const Taps<T>& taps, std::int64_t h, std::int64_t w,
                        const LinearParameters<const T>& project, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  const auto [B, N, C2] = taps[3].shape();
  const View<T, 4> projected = ctx.arena().alloc<T>(Shape{B, h, w, y.extent(3)});
  linear_forward(batch_rows(projected), taps[3].reshaped(Shape{B * N, C2}), project,
                 Activation::kNone, ctx);
  bilinear_forward(y, projected, true, ctx);
}

template <class T>
void projection_backward(const TapGradients<T>& dtaps, const LinearParameters<T>& gradient,
                         ConstView<T, 4> dy, const Taps<T>& taps, std::int64_t h, std::int64_t w,
                         const LinearParameters<const T>& project, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  const auto [B, N, C2] = taps[3].shape();
  const View<T, 4> dprojected = ctx.arena().alloc<T>(Shape{B, h, w, dy.extent(3)});
  bilinear_backward(dprojected, dy, true, ctx);
  linear_backward(token_rows(dtaps[3]), gradient, batch_rows(dprojected),
                  taps[3].reshaped(Shape{B * N, C2}), project, ctx);
  for (std::size_t i = 0; i < 3; ++i)  // the other taps play no part
    if (dtaps[i]) std::fill_n(dtaps[i].data(), dtaps[i].size(), T{0});
  if (pass.gradients_ready) pass.gradients_ready("feature_extractor.project.");
}

}  // namespace lvggt
