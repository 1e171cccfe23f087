// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// Stride = kernel, without bias.   x: [B, H, W, Cin]   w: [Cin, Cout, k, k]   returns [B, kH, kW,
// Cout]
template <class T>
Tensor<T, 4> conv_transpose2d(const Tensor<T, 4>& x, const Tensor<T, 4>& w) {
  const auto [B, H, W, Cin] = x.shape();
  const std::int64_t Cout = w.extent(1), k = w.extent(2);
  Tensor<T, 4> y(Shape{B, k * H, k * W, Cout});
  for (std::int64_t b = 0; b < B; ++b)
    for (std::int64_t i = 0; i < k * H; ++i)
      for (std::int64_t j = 0; j < k * W; ++j)
        for (std::int64_t o = 0; o < Cout; ++o)
          for (std::int64_t c = 0; c < Cin; ++c)
            y(b, i, j, o) += x(b, i / k, j / k, c) * w(c, o, i % k, j % k);
  return y;
}

}  // namespace lvggt::reference
