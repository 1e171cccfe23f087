// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// Without bias.   x: [B, H, W, Cin]   w: [Cout, Cin, k, k]   returns [B, Ho, Wo, Cout]
template <class T>
Tensor<T, 4> conv2d(const Tensor<T, 4>& x, const Tensor<T, 4>& w, std::int64_t stride,
                    std::int64_t padding) {
  const auto [B, H, W, Cin] = x.shape();
  const std::int64_t k = w.extent(2);
  Tensor<T, 4> y(Shape{B, (H + 2 * padding - k) / stride + 1, (W + 2 * padding - k) / stride + 1,
                       w.extent(0)});
  for (std::int64_t n = 0; n < y.size(); ++n) {
    const std::int64_t o = n % y.extent(3), j = n / y.extent(3) % y.extent(2);
    const std::int64_t i = n / (y.extent(3) * y.extent(2)) % y.extent(1), b = n / (y.size() / B);
    for (std::int64_t ky = 0; ky < k; ++ky)
      for (std::int64_t kx = 0; kx < k; ++kx) {
        const std::int64_t h = i * stride + ky - padding, v = j * stride + kx - padding;
        if (h < 0 || h >= H || v < 0 || v >= W) continue;
        for (std::int64_t c = 0; c < Cin; ++c) y(b, i, j, o) += x(b, h, v, c) * w(o, c, ky, kx);
      }
  }
  return y;
}

}  // namespace lvggt::reference
