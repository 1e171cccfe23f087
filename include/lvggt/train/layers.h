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
// they are used. Maps are those of a batch, [B, H, W, C], channels last. The scalar T is float in
// training; with double and lvggt/exact/kernels.h the same layers give exact values to compare
// with.

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
template <class T>
void conv2d_forward(View<T, 4> y, ConstView<T, 4> x, const Conv2dParameters<const T>& layer,
                    Activation activation, ConstView<T, 4> residual, Context& ctx) {
  conv2d_forward(y, x, layer.weight, layer.stride, layer.padding,
                 {.bias = layer.bias, .activation = activation, .residual = residual}, ctx);
}

template <class T>
void conv2d_backward(View<T, 4> dx, const Conv2dParameters<T>& gradient, ConstView<T, 4> dy,
                     ConstView<T, 4> x, const Conv2dParameters<const T>& layer, Context& ctx) {
  conv2d_backward(dx, gradient.weight, gradient.bias, dy, x, layer.weight, layer.stride,
                  layer.padding, ctx);
}

template <class T>
void conv_transpose2d_forward(View<T, 4> y, ConstView<T, 4> x,
                              const ConvTranspose2dParameters<const T>& layer, Context& ctx) {
  conv_transpose2d_forward(y, x, layer.weight, layer.bias, ctx);
}

template <class T>
void conv_transpose2d_backward(View<T, 4> dx, const ConvTranspose2dParameters<T>& gradient,
                               ConstView<T, 4> dy, ConstView<T, 4> x,
                               const ConvTranspose2dParameters<const T>& layer, Context& ctx) {
  conv_transpose2d_backward(dx, gradient.weight, gradient.bias, dy, x, layer.weight, ctx);
}

// y = activation(x weight^T + bias).   y: [M, N]   x: [M, K]
template <class T>
void linear_forward(View<T, 2> y, ConstView<T, 2> x, const LinearParameters<const T>& layer,
                    Activation activation, Context& ctx) {
  linear_forward(y, x, layer.weight, {.bias = layer.bias, .activation = activation}, ctx);
}

template <class T>
void linear_backward(View<T, 2> dx, const LinearParameters<T>& gradient, ConstView<T, 2> dy,
                     ConstView<T, 2> x, const LinearParameters<const T>& layer, Context& ctx) {
  linear_backward(dx, gradient.weight, gradient.bias, dy, x, layer.weight, ctx);
}

// What the backward pass of a batch norm needs beside its input.
template <class T>
struct BatchNormStatistics {
  View<T, 1> mean, rstd;   // [C]
  std::int64_t count = 0;  // values a channel, over all ranks
};

template <class T>
BatchNormStatistics<T> alloc_statistics(std::int64_t C, Arena& arena) {
  return {arena.alloc<T>(Shape{C}), arena.alloc<T>(Shape{C}), 0};
}

// y = relu(batch_norm(x)), with the statistics of the batch (of all ranks, if there are several),
// or the running ones when they are frozen. Moves the running statistics.   y may be x.
template <class T>
void batch_norm_relu_forward(View<T, 4> y, BatchNormStatistics<T>& kept, ConstView<T, 4> x,
                             const BatchNormParameters<const T>& layer, TrainingPass& pass) {
  const auto [B, H, W, C] = x.shape();
  kept.count = B * H * W;
  if (pass.ranks == nullptr && !pass.frozen_statistics) {
    batch_norm2d_forward(y, kept.mean, kept.rstd, layer.running_mean, layer.running_var, x,
                         layer.gamma, layer.beta, static_cast<T>(pass.bn_eps),
                         static_cast<T>(pass.bn_momentum), Activation::kRelu, pass.ctx);
    return;
  }
  if (pass.frozen_statistics) {
    std::copy_n(layer.running_mean.data(), C, kept.mean.data());
    batch_norm2d_rstd(kept.rstd, layer.running_var, static_cast<T>(pass.bn_eps));
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
                            kept.count, static_cast<T>(pass.bn_eps),
                            static_cast<T>(pass.bn_momentum));
  }
  batch_norm2d_normalize(y, x, kept.mean, kept.rstd, layer.gamma, layer.beta, Activation::kRelu,
                         pass.ctx);
}

// The same once the statistics are known: for computing y again.
template <class T>
void batch_norm_relu_again(View<T, 4> y, ConstView<T, 4> x, const BatchNormStatistics<T>& kept,
                           const BatchNormParameters<const T>& layer, TrainingPass& pass) {
  batch_norm2d_normalize(y, x, kept.mean, kept.rstd, layer.gamma, layer.beta, Activation::kRelu,
                         pass.ctx);
}

// dx may be dy.
template <class T>
void batch_norm_relu_backward(View<T, 4> dx, const BatchNormParameters<T>& gradient,
                              ConstView<T, 4> dy, const BatchNormStatistics<T>& kept,
                              ConstView<T, 4> x, const BatchNormParameters<const T>& layer,
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
template <class T>
struct SummedGradient {
  View<T, 4> sum;
  bool started = false;
};

// dx: the gradient of one more consumer; pixels may be strided
template <class T>
void add_gradient(SummedGradient<T>& gradient, ConstView<T, 4> dx, Context& ctx) {
  const View<T, 2> sum = batch_rows(gradient.sum);
  if (gradient.started) {
    accumulate(sum, batch_rows(dx), ctx);
  } else {
    copy_rows(sum, batch_rows(dx), ctx);
    gradient.started = true;
  }
}

// The same where backward(dx) computes it, overwriting dx.
template <class T, class Backward>
requires std::is_invocable_v<Backward, View<T, 4>>
void add_gradient(SummedGradient<T>& gradient, const Backward& backward, Context& ctx) {
  if (!gradient.started) {
    backward(gradient.sum);
    gradient.started = true;
    return;
  }
  Arena::Scope scope(ctx.arena());
  const View<T, 4> dx = ctx.arena().alloc<T>(gradient.sum.shape());
  backward(dx);
  add_gradient(gradient, ConstView<T, 4>(dx), ctx);
}

}  // namespace lvggt
