// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/kernels/epilogue.h"
#include "lvggt/kernels/packed_matrix.h"

namespace lvggt {

// A convolution's weights, packed once at load. Square kernels only: 1x1, 2x2 s2, 3x3 s1/s2 p1,
// 14x14 s14.
struct PackedConv2d {
  std::int64_t in_channels = 0;
  std::int64_t kernel = 0;
  std::int64_t stride = 0;
  std::int64_t padding = 0;
  PackedMatrix matrix;  // taps = kernel^2 (row-major), K = in_channels
};

// weight: [Cout, Cin, k, k], as PyTorch stores it; int8 is refused.
PackedConv2d pack_conv2d(View<const float, 4> weight, std::int64_t stride, std::int64_t padding,
                         Storage storage = Storage::kF32);

// Extent of the output along one axis: floor((in + 2 padding - kernel) / stride) + 1.
constexpr std::int64_t conv2d_extent(std::int64_t in, std::int64_t kernel, std::int64_t stride,
                                     std::int64_t padding) {
  return (in + 2 * padding - kernel) / stride + 1;
}

// y = epilogue(conv2d(x, w)), channels last; rows and pixels of x, y and the residual may be
// strided, so that y can be a slice of a wider, concatenated map.
//   y: [B, Ho, Wo, Cout]   x: [B, H, W, Cin]   y may be epilogue.residual, not x.
void conv2d_forward(View<float, 4> y, View<const float, 4> x, const PackedConv2d& w,
                    const Epilogue<4>& epilogue, Context& ctx);

// The same with weights [Cout, Cin, k, k] that are packed into scratch for this call: for training,
// which changes them every step.
void conv2d_forward(View<float, 4> y, View<const float, 4> x, View<const float, 4> weight,
                    std::int64_t stride, std::int64_t padding, const Epilogue<4>& epilogue,
                    Context& ctx);

// Backward of y = conv2d(x, weight) + bias. With the loss L, dy = dL/dy, and input pixel
// p = stride o + tap - padding of output pixel o,
//   dx[p, ci]          = sum over o, tap, co of dy[o, co] weight[co, ci, tap]
//   dweight[co, ci, t] += sum over o of dy[o, co] x[stride o + t - padding, ci]
//   dbias[co]          += sum over o of dy[o, co]
//   dx, x: [B, H, W, Cin]   dweight, weight: [Cout, Cin, k, k], as PyTorch stores it   dbias:
//   [Cout] dy: [B, Ho, Wo, Cout]
// An empty dx, dweight or dbias is not wanted; x may then be empty if dweight is. Rows and pixels
// of dx, dy and x may be strided. dx may be x, but not dy.
void conv2d_backward(View<float, 4> dx, View<float, 4> dweight, View<float, 1> dbias,
                     View<const float, 4> dy, View<const float, 4> x, View<const float, 4> weight,
                     std::int64_t stride, std::int64_t padding, Context& ctx);

}  // namespace lvggt
