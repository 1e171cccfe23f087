// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "lvggt/core/tensor.h"

namespace lvggt::reference {

// With running statistics.   x: [B, H, W, C]   all others: [C]
template <class T>
Tensor<T, 4> batch_norm2d(const Tensor<T, 4>& x, const Tensor<T, 1>& gamma,
                          const Tensor<T, 1>& beta, const Tensor<T, 1>& running_mean,
                          const Tensor<T, 1>& running_var, T eps) {
  const std::int64_t C = x.extent(3);
  Tensor<T, 4> y(x.shape());
  for (std::int64_t i = 0; i < x.size(); ++i)
    y.data()[i] =
        gamma[i % C] * (x.data()[i] - running_mean[i % C]) / std::sqrt(running_var[i % C] + eps) +
        beta[i % C];
  return y;
}

}  // namespace lvggt::reference
