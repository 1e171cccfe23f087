// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>
#include <vector>

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// softmax(scale q k^T) v.   q: [Nq, heads, D]   k, v: [Nk, heads, D]
template <class T>
Tensor<T, 3> attention(const Tensor<T, 3>& q, const Tensor<T, 3>& k, const Tensor<T, 3>& v,
                       T scale) {
  Tensor<T, 3> y(q.shape());
  std::vector<T> p(static_cast<std::size_t>(k.extent(0)));
  for (std::int64_t i = 0; i < q.extent(0); ++i)
    for (std::int64_t h = 0; h < q.extent(1); ++h) {
      for (std::size_t j = 0; j < p.size(); ++j) {
        p[j] = 0;
        for (std::int64_t d = 0; d < q.extent(2); ++d)
          p[j] += scale * q(i, h, d) * k(static_cast<std::int64_t>(j), h, d);
      }
      const T largest = *std::max_element(p.begin(), p.end());
      T total = 0;
      for (T& score : p) total += score = std::exp(score - largest);
      for (std::size_t j = 0; j < p.size(); ++j)
        for (std::int64_t d = 0; d < q.extent(2); ++d)
          y(i, h, d) += p[j] / total * v(static_cast<std::int64_t>(j), h, d);
    }
  return y;
}

}  // namespace lvggt::reference
