// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>

#include "lvggt/kernels/activation.h"
#include "lvggt/kernels/batch_norm2d.h"
#include "lvggt/kernels/conv2d.h"
#include "lvggt/kernels/conv_transpose2d.h"
#include "lvggt/kernels/elementwise.h"
#include "lvggt/kernels/interpolate.h"
#include "lvggt/kernels/layer_norm.h"
#include "lvggt/kernels/linear.h"
#include "lvggt/train/layer_parameters.h"
#include "lvggt/train/training_pass.h"

namespace lvggt {

// The elementary layers in training: their weights change with every step, so they are packed where
// they are used. Maps are those of a batch, [B, H, W, C], channels last.

// The pixels of a batch as [B*H*W, C]; they may be strided, but rows and frames have no gaps.
template <class T>
View<T, 2> batch_rows(View<T, 4> map) {
  const auto [B, H, W, C] = map.shape();
  LVGGT_CHECK((H == 1 || map.stride(1) == W * map.stride(2)) &&
                  (B == 1 || map.stride(0) == H * W * map.stride(2)),
              "batch_rows: map ", map.shape(), " has gaps between its rows");
  return View<T, 2>(map.data(), Shape{B * H * W, C}, {map.stride(2), 1});
}

// Shape of the map that a convolution makes of x.
template <class T>
Shape<4> conv2d_shape(const Conv2dParameters<T>& layer, const Shape<4>& x) {
  const std::int64_t kernel = layer.weight.extent(2);
  return Shape{x[0], conv2d_extent(x[1], kernel, layer.stride, layer.padding),
               conv2d_extent(x[2], kernel, layer.stride, layer.padding), layer.weight.extent(0)};
}

// y = conv2d(x) + bias (+ residual), activated before the residual is added.
inline void conv2d_forward(View<float, 4> y, View<const float, 4> x,
                           const Conv2dParameters<const float>& layer, Activation activation,
                           View<const float, 4> residual, Context& ctx) {
  conv2d_forward(y, x, layer.weight, layer.stride, layer.padding,
                 {.bias = layer.bias, .activation = activation, .residual = residual}, ctx);
}

inline void conv2d_backward(View<float, 4> dx, const Conv2dParameters<float>& gradient,
                            View<const float, 4> dy, View<const float, 4> x,
                            const Conv2dParameters<const float>& layer, Context& ctx) {
  conv2d_backward(dx, gradient.weight, gradient.bias, dy, x, layer.weight, layer.stride,
                  layer.padding, ctx);
}

inline void conv_transpose2d_forward(View<float, 4> y, View<const float, 4> x,
                                     const ConvTranspose2dParameters<const float>& layer,
                                     Context& ctx) {
  conv_transpose2d_forward(y, x, layer.weight, layer.bias, ctx);
}

inline void conv_transpose2d_backward(View<float, 4> dx,
                                      const ConvTranspose2dParameters<float>& gradient,
                                      View<const float, 4> dy, View<const float, 4> x,
                                      const ConvTranspose2dParameters<const float>& layer,
                                      Context& ctx) {
  conv_transpose2d_backward(dx, gradient.weight, gradient.bias, dy, x, layer.weight, ctx);
}

// y = activation(x weight^T + bias).   y: [M, N]   x: [M, K]
inline void linear_forward(View<float, 2> y, View<const float, 2> x,
                           const LinearParameters<const float>& layer, Activation activation,
                           Context& ctx) {
  linear_forward(y, x, layer.weight, Epilogue<2>{.bias = layer.bias, .activation = activation},
                 ctx);
}

inline void linear_backward(View<float, 2> dx, const LinearParameters<float>& gradient,
                            View<const float, 2> dy, View<const float, 2> x,
                            const LinearParameters<const float>& layer, Context& ctx) {
  linear_backward(dx, gradient.weight, gradient.bias, dy, x, layer.weight, ctx);
}

// What the backward pass of a batch norm needs beside its input.
struct BatchNormStatistics {
  View<float, 1> mean, rstd;  // [C]
  std::int64_t count = 0;     // values a channel, over all ranks
};

inline BatchNormStatistics alloc_statistics(std::int64_t C, Arena& arena) {
  return {arena.alloc(Shape{C}), arena.alloc(Shape{C}), 0};
}

// y = relu(batch_norm(x)), with the statistics of the batch (of all ranks, if there are several),
// or the running ones when they are frozen. Moves the running statistics.   y may be x.
inline void batch_norm_relu_forward(View<float, 4> y, BatchNormStatistics& kept,
                                    View<const float, 4> x,
                                    const BatchNormParameters<const float>& layer,
                                    TrainingPass& pass) {
  const auto [B, H, W, C] = x.shape();
  kept.count = B * H * W;
  if (pass.ranks == nullptr && !pass.frozen_statistics) {
    batch_norm2d_forward(y, kept.mean, kept.rstd, layer.running_mean, layer.running_var, x,
                         layer.gamma, layer.beta, pass.bn_eps, pass.bn_momentum, Activation::kRelu,
                         pass.ctx);
    return;
  }
  if (pass.frozen_statistics) {
    std::copy_n(layer.running_mean.data(), C, kept.mean.data());
    batch_norm2d_rstd(kept.rstd, layer.running_var, pass.bn_eps);
  } else {
    // The running mean is the same on all ranks and near the data.
    Arena::Scope scope(pass.ctx.arena());
    const View<double, 2> sums = pass.ctx.arena().alloc<double>(Shape{std::int64_t{3}, C});
    batch_norm2d_sums(sums.narrow(0, 0, 2), x, layer.running_mean, pass.ctx);
    sums(2, 0) = static_cast<double>(kept.count);
    pass.ranks->sum(std::span(sums.data(), static_cast<std::size_t>(2 * C + 1)));
    kept.count = static_cast<std::int64_t>(sums(2, 0));
    batch_norm2d_statistics(kept.mean, kept.rstd, layer.running_mean, layer.running_var,
                            View<const double, 2>(sums.narrow(0, 0, 2)), layer.running_mean,
                            kept.count, pass.bn_eps, pass.bn_momentum);
  }
  batch_norm2d_normalize(y, x, kept.mean, kept.rstd, layer.gamma, layer.beta, Activation::kRelu,
                         pass.ctx);
}

// The same once the statistics are known: for computing y again.
inline void batch_norm_relu_again(View<float, 4> y, View<const float, 4> x,
                                  const BatchNormStatistics& kept,
                                  const BatchNormParameters<const float>& layer,
                                  TrainingPass& pass) {
  batch_norm2d_normalize(y, x, kept.mean, kept.rstd, layer.gamma, layer.beta, Activation::kRelu,
                         pass.ctx);
}

// dx may be dy.
inline void batch_norm_relu_backward(View<float, 4> dx, const BatchNormParameters<float>& gradient,
                                     View<const float, 4> dy, const BatchNormStatistics& kept,
                                     View<const float, 4> x,
                                     const BatchNormParameters<const float>& layer,
                                     TrainingPass& pass) {
  if (pass.ranks == nullptr && !pass.frozen_statistics) {
    batch_norm2d_backward(dx, gradient.gamma, gradient.beta, dy, kept.mean, kept.rstd, x,
                          layer.gamma, layer.beta, Activation::kRelu, pass.ctx);
    return;
  }
  Arena::Scope scope(pass.ctx.arena());
  const std::int64_t C = x.extent(3);
  View<double, 2> sums = pass.ctx.arena().alloc<double>(Shape{std::int64_t{2}, C});
  batch_norm2d_backward_sums(sums, dy, kept.mean, kept.rstd, x, layer.gamma, layer.beta,
                             Activation::kRelu, pass.ctx);
  // Each rank's own part: the gradients of the parameters are summed over the ranks later.
  batch_norm2d_backward_parameters(gradient.gamma, gradient.beta, sums);
  if (pass.frozen_statistics) {
    sums = {};
  } else {
    pass.ranks->sum(std::span(sums.data(), static_cast<std::size_t>(2 * C)));
  }
  batch_norm2d_backward_input(dx, dy, sums, kept.count, kept.mean, kept.rstd, x, layer.gamma,
                              layer.beta, Activation::kRelu, pass.ctx);
}

// The gradient of a map with several consumers: the first one's is written, the others' are added.
struct SummedGradient {
  View<float, 4> sum;
  bool started = false;
};

// dx: the gradient of one more consumer; pixels may be strided
inline void add_gradient(SummedGradient& gradient, View<const float, 4> dx, Context& ctx) {
  const View<float, 2> sum = batch_rows(gradient.sum);
  if (gradient.started) {
    accumulate(sum, batch_rows(dx), ctx);
  } else {
    copy_rows(sum, batch_rows(dx), ctx);
    gradient.started = true;
  }
}

// The same where backward(dx) computes it, overwriting dx.
template <class Backward>
requires std::is_invocable_v<Backward, View<float, 4>>
void add_gradient(SummedGradient& gradient, const Backward& backward, Context& ctx) {
  if (!gradient.started) {
    backward(gradient.sum);
    gradient.started = true;
    return;
  }
  Arena::Scope scope(ctx.arena());
  const View<float, 4> dx = ctx.arena().alloc(gradient.sum.shape());
  backward(dx);
  add_gradient(gradient, View<const float, 4>(dx), ctx);
}

}  // namespace lvggt
