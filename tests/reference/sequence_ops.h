// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// y = gamma x / sqrt(mean(x^2) + eps)   x: [N, C]
template <class T>
Tensor<T, 2> rms_norm(const Tensor<T, 2>& x, const Tensor<T, 1>& gamma, T eps) {
  Tensor<T, 2> y(x.shape());
  for (std::int64_t n = 0; n < x.extent(0); ++n) {
    T squares = 0;
    for (std::int64_t c = 0; c < x.extent(1); ++c) squares += x(n, c) * x(n, c);
    const T length = std::sqrt(squares / T(x.extent(1)) + eps);
    for (std::int64_t c = 0; c < x.extent(1); ++c) y(n, c) = gamma(c) * x(n, c) / length;
  }
  return y;
}

// Element j of a head turns with j + D/2; token n has position n % P.   x: [N, heads, D]
template <class T>
Tensor<T, 3> rope_1d(const Tensor<T, 3>& x, std::int64_t P, T base) {
  const auto [N, heads, D] = x.shape();
  Tensor<T, 3> y(x.shape());
  for (std::int64_t n = 0; n < N; ++n)
    for (std::int64_t h = 0; h < heads; ++h)
      for (std::int64_t j = 0; j < D / 2; ++j) {
        const T angle = T(n % P) * std::pow(base, T(-2 * j) / T(D));
        const T a = x(n, h, j), b = x(n, h, j + D / 2);
        y(n, h, j) = a * std::cos(angle) - b * std::sin(angle);
        y(n, h, j + D / 2) = b * std::cos(angle) + a * std::sin(angle);
      }
  return y;
}

// Sequences of P tokens; query head h uses key head h / (heads / key_heads).
//   q: [N, heads, D]   k, v: [N, key_heads, D]
template <class T>
Tensor<T, 3> causal_attention(const Tensor<T, 3>& q, const Tensor<T, 3>& k, const Tensor<T, 3>& v,
                              std::int64_t P, T scale) {
  const auto [N, heads, D] = q.shape();
  Tensor<T, 3> y(q.shape());
  for (std::int64_t n = 0; n < N; ++n)
    for (std::int64_t h = 0; h < heads; ++h) {
      const std::int64_t g = h / (heads / k.extent(1));
      T sum = 0;
      for (std::int64_t j = n / P * P; j <= n; ++j) {
        T score = 0;
        for (std::int64_t c = 0; c < D; ++c) score += scale * q(n, h, c) * k(j, g, c);
        const T weight = std::exp(score);
        sum += weight;
        for (std::int64_t c = 0; c < D; ++c) y(n, h, c) += weight * v(j, g, c);
      }
      for (std::int64_t c = 0; c < D; ++c) y(n, h, c) /= sum;
    }
  return y;
}

}  // namespace lvggt::reference
