// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/train/decoder_parameters.h"
#include "lvggt/train/layers.h"

namespace lvggt {

template <class T>
struct ReassembleActivations {
  View<const T, 2> tokens;  // [B*h*w, 2C], the caller's
  View<T, 1> mean, rstd;    // [B*h*w]
  View<T, 2> normed;        // [B*h*w, 2C]
  View<T, 4> projected;     // [B, h, w, out]
  View<T, 4> resized;       // [B, H, W, out]; the projected map itself for tap 2
};

// Size of a tap's feature map: 4, 2, 1 and 1/2 times the patch grid.
template <class T>
Shape<4> reassembled_shape(const ReassembleParameters<T>& layer, const Shape<4>& projected) {
  Shape<4> shape = projected;
  if (const auto* up = std::get_if<ConvTranspose2dParameters<T>>(&layer.resize)) {
    shape[1] *= up->weight.extent(2);
    shape[2] *= up->weight.extent(2);
  } else if (const auto* down = std::get_if<Conv2dParameters<T>>(&layer.resize)) {
    shape = conv2d_shape(*down, shape);
  }
  shape[3] = layer.layer_rn.weight.extent(0);
  return shape;
}

// y = layer_rn(resize(project(norm(tokens)))).
//   y: reassembled_shape   tokens: [B, h*w, 2C], patch tokens of one tap, dense
template <class T>
void reassemble_forward(View<T, 4> y, ReassembleActivations<T>& kept, ConstView<T, 3> tokens,
                        std::int64_t h, std::int64_t w, const ReassembleParameters<const T>& layer,
                        T eps, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena& arena = ctx.arena();
  const auto [B, N, C2] = tokens.shape();
  const std::int64_t channels = layer.project.weight.extent(0);
  kept.tokens = tokens.reshaped(Shape{B * N, C2});
  kept.mean = arena.alloc<T>(Shape{B * N});
  kept.rstd = arena.alloc<T>(Shape{B * N});
  kept.normed = arena.alloc<T>(Shape{B * N, C2});
  layer_norm_forward(kept.normed, kept.mean, kept.rstd, kept.tokens, layer.norm.gamma,
                     layer.norm.beta, eps, ctx);
  kept.resized = kept.projected = arena.alloc<T>(Shape{B, h, w, channels});
  linear_forward(batch_rows(kept.projected), kept.normed, layer.project, Activation::kNone, ctx);
  const Shape resized{B, y.extent(1), y.extent(2), channels};
  if (const auto* up = std::get_if<ConvTranspose2dParameters<const T>>(&layer.resize)) {
    kept.resized = arena.alloc<T>(resized);
    conv_transpose2d_forward(kept.resized, kept.projected, *up, ctx);
  } else if (const auto* down = std::get_if<Conv2dParameters<const T>>(&layer.resize)) {
    kept.resized = arena.alloc<T>(resized);
    conv2d_forward(kept.resized, kept.projected, *down, Activation::kNone, {}, ctx);
  }
  conv2d_forward(y, kept.resized, layer.layer_rn, Activation::kNone, {}, ctx);
}

// dtokens: [B*h*w, 2C], may be empty
template <class T>
void reassemble_backward(View<T, 2> dtokens, const ReassembleParameters<T>& gradient,
                         ConstView<T, 4> dy, const ReassembleActivations<T>& kept,
                         const ReassembleParameters<const T>& layer, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  const View<T, 4> dresized = ctx.arena().alloc<T>(kept.resized.shape());
  conv2d_backward(dresized, gradient.layer_rn, dy, kept.resized, layer.layer_rn, ctx);
  View<T, 4> dprojected = dresized;
  if (const auto* up = std::get_if<ConvTranspose2dParameters<const T>>(&layer.resize)) {
    dprojected = ctx.arena().alloc<T>(kept.projected.shape());
    conv_transpose2d_backward(dprojected, std::get<ConvTranspose2dParameters<T>>(gradient.resize),
                              dresized, kept.projected, *up, ctx);
  } else if (const auto* down = std::get_if<Conv2dParameters<const T>>(&layer.resize)) {
    dprojected = ctx.arena().alloc<T>(kept.projected.shape());
    conv2d_backward(dprojected, std::get<Conv2dParameters<T>>(gradient.resize), dresized,
                    kept.projected, *down, ctx);
  }
  const View<T, 2> dnormed = ctx.arena().alloc<T>(kept.normed.shape());
  linear_backward(dnormed, gradient.project, batch_rows(dprojected), kept.normed, layer.project,
                  ctx);
  layer_norm_backward(dtokens, gradient.norm.gamma, gradient.norm.beta, dnormed, kept.mean,
                      kept.rstd, kept.tokens, layer.norm.gamma, ctx);
}

}  // namespace lvggt
