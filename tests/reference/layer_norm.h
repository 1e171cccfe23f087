// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <complex>

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// Without the affine part.   x: [N, C]
template <class T>
Tensor<T, 2> layer_norm(const Tensor<T, 2>& x, T eps) {
  const auto [N, C] = x.shape();
  Tensor<T, 2> y(x.shape());
  for (std::int64_t n = 0; n < N; ++n) {
    T mean = 0, variance = 0;
    for (std::int64_t c = 0; c < C; ++c) mean += x(n, c) / T(C);
    for (std::int64_t c = 0; c < C; ++c) variance += (x(n, c) - mean) * (x(n, c) - mean) / T(C);
    for (std::int64_t c = 0; c < C; ++c) y(n, c) = (x(n, c) - mean) / std::sqrt(variance + eps);
  }
  return y;
}

}  // namespace lvggt::reference
