// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <complex>
#include <vector>

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// Query n of frame f = n / P sees the keys of frame f and, with `earlier`, of those before it; P =
// 0: all.
inline bool sees(std::int64_t query, std::int64_t key, std::int64_t P, bool earlier) {
  if (P == 0) return true;
  return earlier ? key / P <= query / P : key / P == query / P;
}

// softmax(q k^T / sqrt(D)) v over the keys that are seen, for scores whose exponentials do not
// overflow.   q: [Nq, heads, D]   k, v: [Nk, heads, D]
template <class T>
Tensor<T, 3> masked_attention(const Tensor<T, 3>& q, const Tensor<T, 3>& k, const Tensor<T, 3>& v,
                              std::int64_t P, bool earlier) {
  const auto [Nq, heads, D] = q.shape();
  const std::int64_t Nk = k.extent(0);
  Tensor<T, 3> y(q.shape());
  std::vector<T> weights(static_cast<std::size_t>(Nk));
  for (std::int64_t i = 0; i < Nq; ++i)
    for (std::int64_t h = 0; h < heads; ++h) {
      T total = 0;
      for (std::int64_t j = 0; j < Nk; ++j) {
        T score = 0;
        for (std::int64_t d = 0; d < D; ++d) score += q(i, h, d) * k(j, h, d);
        const T weight = std::exp(score / std::sqrt(static_cast<double>(D)));
        total += weights[static_cast<std::size_t>(j)] = sees(i, j, P, earlier) ? weight : T(0);
      }
      for (std::int64_t j = 0; j < Nk; ++j)
        for (std::int64_t d = 0; d < D; ++d)
          y(i, h, d) += weights[static_cast<std::size_t>(j)] / total * v(j, h, d);
    }
  return y;
}

}  // namespace lvggt::reference
