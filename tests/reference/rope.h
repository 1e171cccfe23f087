// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// x: [N, heads, D]   positions: [P, 2] (row, column); token n has position n % P
template <class T>
Tensor<T, 3> rope_2d(const Tensor<T, 3>& x, const Tensor<std::int64_t, 2>& positions, T base) {
  const auto [N, heads, D] = x.shape();
  const std::int64_t half = D / 2, quarter = D / 4;
  Tensor<T, 3> y(x.shape());
  for (std::int64_t n = 0; n < N; ++n)
    for (std::int64_t h = 0; h < heads; ++h)
      for (std::int64_t axis = 0; axis < 2; ++axis)
        for (std::int64_t j = 0; j < quarter; ++j) {
          const T frequency = std::pow(base, T(-2 * j) / T(half));
          const T angle = T(positions(n % positions.extent(0), axis)) * frequency;
          const std::int64_t k = axis * half + j;
          y(n, h, k) = x(n, h, k) * std::cos(angle) - x(n, h, k + quarter) * std::sin(angle);
          y(n, h, k + quarter) =
              x(n, h, k + quarter) * std::cos(angle) + x(n, h, k) * std::sin(angle);
        }
  return y;
}

}  // namespace lvggt::reference
