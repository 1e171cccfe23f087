// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>

#include "lvggt/train/decoder_parameters.h"
#include "lvggt/train/layers.h"

namespace lvggt {

// What the backward pass of a double convolution needs.
struct DoubleConvActivations {
  View<const float, 4> x;              // [B, H, W, Cin], the caller's
  View<float, 4> conv1, relu1, conv2;  // [B, H, W, Cout]; empty when they are computed again
  BatchNormStatistics norm1, norm2;
};

// y = relu(norm2(conv2(relu(norm1(conv1(x)))))).   y: [B, H, W, Cout], pixels may be strided
inline void double_conv_forward(View<float, 4> y, DoubleConvActivations& kept,
                                View<const float, 4> x,
                                const DoubleConvParameters<const float>& layer,
                                TrainingPass& pass) {
  Arena& arena = pass.ctx.arena();
  kept.x = x;
  kept.norm1 = alloc_statistics(y.extent(3), arena);
  kept.norm2 = alloc_statistics(y.extent(3), arena);
  std::optional<Arena::Scope> scope;
  if (pass.recompute) scope.emplace(arena);
  kept.conv1 = arena.alloc(y.shape());
  kept.relu1 = arena.alloc(y.shape());
  conv2d_forward(kept.conv1, x, layer.conv1, Activation::kNone, {}, pass.ctx);
  batch_norm_relu_forward(kept.relu1, kept.norm1, kept.conv1, layer.norm1, pass);
  kept.conv2 = arena.alloc(y.shape());
  conv2d_forward(kept.conv2, kept.relu1, layer.conv2, Activation::kNone, {}, pass.ctx);
  batch_norm_relu_forward(y, kept.norm2, kept.conv2, layer.norm2, pass);
  if (pass.recompute) kept.conv1 = kept.relu1 = kept.conv2 = {};
}

// The maps of the forward pass once more, from its input and statistics: the same bits.
inline void recompute_double_conv(DoubleConvActivations& kept, const Shape<4>& shape,
                                  const DoubleConvParameters<const float>& layer,
                                  TrainingPass& pass) {
  Arena& arena = pass.ctx.arena();
  kept.conv1 = arena.alloc(shape);
  kept.relu1 = arena.alloc(shape);
  kept.conv2 = arena.alloc(shape);
  conv2d_forward(kept.conv1, kept.x, layer.conv1, Activation::kNone, {}, pass.ctx);
  batch_norm2d_normalize(kept.relu1, kept.conv1, kept.norm1.mean, kept.norm1.rstd,
                         layer.norm1.gamma, layer.norm1.beta, Activation::kRelu, pass.ctx);
  conv2d_forward(kept.conv2, kept.relu1, layer.conv2, Activation::kNone, {}, pass.ctx);
}

// dx: as x   dy: as y, pixels may be strided
inline void double_conv_backward(View<float, 4> dx, const DoubleConvParameters<float>& gradient,
                                 View<const float, 4> dy, DoubleConvActivations kept,
                                 const DoubleConvParameters<const float>& layer,
                                 TrainingPass& pass) {
  Arena::Scope scope(pass.ctx.arena());
  if (kept.conv1.empty()) recompute_double_conv(kept, dy.shape(), layer, pass);
  const View<float, 4> dconv = pass.ctx.arena().alloc(dy.shape());
  const View<float, 4> drelu1 = pass.ctx.arena().alloc(dy.shape());
  batch_norm_relu_backward(dconv, gradient.norm2, dy, kept.norm2, kept.conv2, layer.norm2, pass);
  conv2d_backward(drelu1, gradient.conv2, dconv, kept.relu1, layer.conv2, pass.ctx);
  batch_norm_relu_backward(drelu1, gradient.norm1, drelu1, kept.norm1, kept.conv1, layer.norm1,
                           pass);
  conv2d_backward(dx, gradient.conv1, drelu1, kept.x, layer.conv1, pass.ctx);
}

}  // namespace lvggt
