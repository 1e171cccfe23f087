// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <complex>

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

template <class T>
struct BatchStatistics {
  Tensor<T, 1> mean, var;  // var: population variance
};
template <class T>
BatchStatistics<T> batch_statistics(const Tensor<T, 4>& x) {
  const std::int64_t C = x.extent(3);
  const T n = T(static_cast<double>(x.size() / C));
  BatchStatistics<T> s{Tensor<T, 1>(Shape{C}), Tensor<T, 1>(Shape{C})};
  for (std::int64_t i = 0; i < x.size(); ++i) s.mean[i % C] += x.data()[i] / n;
  for (std::int64_t i = 0; i < x.size(); ++i) {
    const T deviation = x.data()[i] - s.mean[i % C];
    s.var[i % C] += deviation * deviation / n;
  }
  return s;
}

}  // namespace lvggt::reference
