// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/kernels/packed_matrix.h"

namespace lvggt {

// A transposed convolution with stride == kernel: every input pixel writes its own k x k block, so
// it is a product for each of the k x k places, all with the same input rows. Packed once at load.
struct PackedConvTranspose2d {
  std::int64_t in_channels = 0;
  std::int64_t out_channels = 0;
  std::int64_t kernel = 0;
  std::vector<PackedMatrix> places;  // [ky * k + kx]: N = Cout, K = Cin
};

// weight: [Cin, Cout, k, k], as PyTorch stores it; int8 is refused.
PackedConvTranspose2d pack_conv_transpose2d(View<const float, 4> weight,
                                            Storage storage = Storage::kF32);

// y[b, k*i + ky, k*j + kx, :] = sum over Cin of x[b, i, j, :] w[:, :, ky, kx] + bias, channels
// last; pixels may be strided.
//   y: [B, k*H, k*W, Cout]   x: [B, H, W, Cin]   bias: [Cout] or empty
void conv_transpose2d_forward(View<float, 4> y, View<const float, 4> x,
                              const PackedConvTranspose2d& w, View<const float, 1> bias,
                              Context& ctx);

// The same with weights [Cin, Cout, k, k] that are packed into scratch for this call: for training,
// which changes them every step.
void conv_transpose2d_forward(View<float, 4> y, View<const float, 4> x, View<const float, 4> weight,
                              View<const float, 1> bias, Context& ctx);

// Backward of conv_transpose2d_forward: it is a convolution with its input and output exchanged, so
//   dx[i, j, ci]            = sum over ky, kx, co of dy[k i + ky, k j + kx, co] weight[ci, co, ky,
//   kx] dweight[ci, co, ky, kx] += sum over i, j of x[i, j, ci] dy[k i + ky, k j + kx, co]
//   dbias[co]               += sum over all pixels of dy[., ., co]
//   dx, x: [B, H, W, Cin]   dweight, weight: [Cin, Cout, k, k]   dbias: [Cout]
//   dy: [B, k*H, k*W, Cout]
// An empty dx, dweight or dbias is not wanted; pixels may be strided.
void conv_transpose2d_backward(View<float, 4> dx, View<float, 4> dweight, View<float, 1> dbias,
                               View<const float, 4> dy, View<const float, 4> x,
                               View<const float, 4> weight, Context& ctx);

}  // namespace lvggt
