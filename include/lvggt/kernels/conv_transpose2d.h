// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/kernels/packed_matrix.h"

namespace lvggt {

// A transposed convolution with stride == kernel: every input pixel writes its own k x k block, so it is a
// product with N = k * k * Cout followed by a rearrangement.
struct PackedConvTranspose2d {
  std::int64_t out_channels = 0;
  std::int64_t kernel = 0;
  PackedMatrix matrix;  // N = k * k * Cout, ordered [ky, kx, Cout]
  Tensor<float, 1> bias;  // [k * k * Cout], empty without bias
};

// weight: [Cin, Cout, k, k], as PyTorch stores it; bias: [Cout] or empty.
PackedConvTranspose2d pack_conv_transpose2d(View<const float, 4> weight, View<const float, 1> bias);

// y[b, k*i + ky, k*j + kx, :] = sum over Cin of x[b, i, j, :] w[:, :, ky, kx] + bias, channels last.
//   y: [B, k*H, k*W, Cout]   x: [B, H, W, Cin]
void conv_transpose2d_forward(View<float, 4> y, View<const float, 4> x,
                              const PackedConvTranspose2d& w, Context& ctx);

}  // namespace lvggt
