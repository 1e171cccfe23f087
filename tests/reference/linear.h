// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// y[m, n] = sum over k of x[m, k] w[n, k]
template <class T>
Tensor<T, 2> linear(const Tensor<T, 2>& x, const Tensor<T, 2>& w) {
  Tensor<T, 2> y(Shape{x.extent(0), w.extent(0)});
  for (std::int64_t m = 0; m < x.extent(0); ++m)
    for (std::int64_t n = 0; n < w.extent(0); ++n)
      for (std::int64_t k = 0; k < x.extent(1); ++k) y(m, n) += x(m, k) * w(n, k);
  return y;
}

}  // namespace lvggt::reference
