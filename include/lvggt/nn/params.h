// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/kernels/conv2d.h"
#include "lvggt/kernels/conv_transpose2d.h"
#include "lvggt/kernels/layer_norm.h"
#include "lvggt/kernels/linear.h"

namespace lvggt {

// Parameters of the elementary layers, packed for inference, and the operators applied to them.
// Feature maps are those of one frame: [H, W, C], channels last.

struct Linear {
  PackedMatrix weight;    // [N, K]
  Tensor<float, 1> bias;  // [N], may be empty
};

struct LayerNorm {
  Tensor<float, 1> weight;  // [C]; empty without affine part
  Tensor<float, 1> bias;    // [C]
  float eps = 0;
};

struct Conv2d {
  PackedConv2d weight;    // [Cout, Cin, k, k]
  Tensor<float, 1> bias;  // [Cout], may be empty
};

struct ConvTranspose2d {
  PackedConvTranspose2d weight;  // [Cin, Cout, k, k]
  Tensor<float, 1> bias;         // [Cout]
};

// An owned tensor as a view; empty when it is.
template <class T, int R>
View<const T, R> view_or_empty(const Tensor<T, R>& tensor) {
  return tensor.empty() ? View<const T, R>() : tensor.view();
}

// [H, W, C] as a batch of one.
template <class T>
View<T, 4> batch_of_one(View<T, 3> map) {
  const auto [H, W, C] = map.shape();
  return View<T, 4>(map.data(), Shape{std::int64_t{1}, H, W, C},
                    {H * map.stride(0), map.stride(0), map.stride(1), map.stride(2)});
}

// The pixels of a map without gaps between its rows as [H*W, C]; the pixels may be strided.
template <class T>
View<T, 2> pixel_rows(View<T, 3> map) {
  const auto [H, W, C] = map.shape();
  LVGGT_CHECK(H <= 1 || map.stride(0) == W * map.stride(1), "pixel_rows: map ", map.shape(),
              " has gaps between its rows");
  return View<T, 2>(map.data(), Shape{H * W, C}, {map.stride(1), 1});
}

// y = epilogue(x w^T) with the layer's bias.   y: [M, N]   x: [M, K]
inline void linear_forward(View<float, 2> y, View<const float, 2> x, const Linear& layer,
                           Epilogue<2> epilogue, Context& ctx) {
  epilogue.bias = view_or_empty(layer.bias);
  linear_forward(y, x, layer.weight, epilogue, ctx);
}

// y, x: [N, C]   y may be x.
inline void layer_norm_forward(View<float, 2> y, View<const float, 2> x, const LayerNorm& layer,
                               Context& ctx) {
  layer_norm_forward(y, x, view_or_empty(layer.weight), view_or_empty(layer.bias), layer.eps, ctx);
}

// What a convolution does after its sums: y = residual + activation(sum + bias).
struct ConvEpilogue {
  Activation activation = Activation::kNone;
  View<const float, 3> residual{};  // shape of y; may be y itself
};

// y: [Ho, Wo, Cout]   x: [H, W, Cin]
inline void conv2d_forward(View<float, 3> y, View<const float, 3> x, const Conv2d& layer,
                           const ConvEpilogue& epilogue, Context& ctx) {
  Epilogue<4> full{.bias = view_or_empty(layer.bias), .activation = epilogue.activation};
  if (epilogue.residual) full.residual = batch_of_one(epilogue.residual);
  conv2d_forward(batch_of_one(y), batch_of_one(x), layer.weight, full, ctx);
}

// y: [k*H, k*W, Cout]   x: [H, W, Cin]
inline void conv_transpose2d_forward(View<float, 3> y, View<const float, 3> x,
                                     const ConvTranspose2d& layer, Context& ctx) {
  conv_transpose2d_forward(batch_of_one(y), batch_of_one(x), layer.weight,
                           view_or_empty(layer.bias), ctx);
}

// The map that the convolution makes of one of H x W, for allocating it.
inline Shape<3> conv2d_shape(const Conv2d& layer, std::int64_t H, std::int64_t W) {
  const PackedConv2d& w = layer.weight;
  return Shape{conv2d_extent(H, w.kernel, w.stride, w.padding),
               conv2d_extent(W, w.kernel, w.stride, w.padding), w.matrix.N};
}

}  // namespace lvggt
