// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>

#include "lvggt/train/decoder_parameters.h"
#include "lvggt/train/layers.h"

namespace lvggt {

// What the backward pass of a double convolution needs.
template <class T>
struct DoubleConvActivations {
  View<const T, 4> x;              // [B, H, W, Cin], the caller's
  View<T, 4> conv1, relu1, conv2;  // [B, H, W, Cout]; empty when they are computed again
  BatchNormStatistics<T> norm1, norm2;
};

// y = relu(norm2(conv2(relu(norm1(conv1(x)))))).   y: [B, H, W, Cout], pixels may be strided
template <class T>
void double_conv_forward(View<T, 4> y, DoubleConvActivations<T>& kept, ConstView<T, 4> x,
                         const DoubleConvParameters<const T>& layer, TrainingPass& pass) {
  Arena& arena = pass.ctx.arena();
  kept.x = x;
  kept.norm1 = alloc_statistics<T>(y.extent(3), arena);
  kept.norm2 = alloc_statistics<T>(y.extent(3), arena);
  std::optional<Arena::Scope> scope;
  if (pass.recompute) scope.emplace(arena);
  kept.conv1 = arena.alloc<T>(y.shape());
  kept.relu1 = arena.alloc<T>(y.shape());
  conv2d_forward(kept.conv1, x, layer.conv1, Activation::kNone, {}, pass.ctx);
  batch_norm_relu_forward(kept.relu1, kept.norm1, kept.conv1, layer.norm1, pass);
  kept.conv2 = arena.alloc<T>(y.shape());
  conv2d_forward(kept.conv2, kept.relu1, layer.conv2, Activation::kNone, {}, pass.ctx);
  batch_norm_relu_forward(y, kept.norm2, kept.conv2, layer.norm2, pass);
  if (pass.recompute) kept.conv1 = kept.relu1 = kept.conv2 = {};
}

// The maps of the forward pass once more, from its input and statistics: the same bits.
template <class T>
void recompute_double_conv(DoubleConvActivations<T>& kept, const Shape<4>& shape,
                           const DoubleConvParameters<const T>& layer, TrainingPass& pass) {
  Arena& arena = pass.ctx.arena();
  kept.conv1 = arena.alloc<T>(shape);
  kept.relu1 = arena.alloc<T>(shape);
  kept.conv2 = arena.alloc<T>(shape);
  conv2d_forward(kept.conv1, kept.x, layer.conv1, Activation::kNone, {}, pass.ctx);
  batch_norm_relu_again(kept.relu1, kept.conv1, kept.norm1, layer.norm1, pass);
  conv2d_forward(kept.conv2, kept.relu1, layer.conv2, Activation::kNone, {}, pass.ctx);
}

// dx: as x   dy: as y, pixels may be strided
template <class T>
void double_conv_backward(View<T, 4> dx, const DoubleConvParameters<T>& gradient,
                          ConstView<T, 4> dy, DoubleConvActivations<T> kept,
                          const DoubleConvParameters<const T>& layer, TrainingPass& pass) {
  Arena::Scope scope(pass.ctx.arena());
  if (kept.conv1.empty()) recompute_double_conv(kept, dy.shape(), layer, pass);
  const View<T, 4> dconv = pass.ctx.arena().alloc<T>(dy.shape());
  const View<T, 4> drelu1 = pass.ctx.arena().alloc<T>(dy.shape());
  batch_norm_relu_backward(dconv, gradient.norm2, dy, kept.norm2, kept.conv2, layer.norm2, pass);
  conv2d_backward(drelu1, gradient.conv2, dconv, kept.relu1, layer.conv2, pass.ctx);
  batch_norm_relu_backward(drelu1, gradient.norm1, drelu1, kept.norm1, kept.conv1, layer.norm1,
                           pass);
  conv2d_backward(dx, gradient.conv1, drelu1, kept.x, layer.conv1, pass.ctx);
}

}  // namespace lvggt
