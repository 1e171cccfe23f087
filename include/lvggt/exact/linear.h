// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>

#include "lvggt/core/parallel.h"
#include "lvggt/kernels/epilogue.h"

namespace lvggt {

// Plain float64 kernels with the signatures of the fast ones: for checking mathematics, not for
// speed. Shapes, aliasing and meaning are those of the float32 declaration of the same name.

// y = residual + gamma * activation(sum + bias), as Epilogue.
template <int R>
struct ExactEpilogue {
  View<const double, 1> bias{};  // [N]
  Activation activation = Activation::kNone;
  View<const double, 1> gamma{};     // [N]
  View<const double, R> residual{};  // shape of y; may be y itself
};

inline double exact_activation(double x, Activation activation) {
  switch (activation) {
    case Activation::kRelu:
      return x < 0 ? 0 : x;
    case Activation::kGelu:
      return x / 2 * std::erfc(-x / std::sqrt(2.0));
    case Activation::kSilu:
      return x / (1 + std::exp(-x));
    case Activation::kSigmoid:
      return 1 / (1 + std::exp(-x));
    case Activation::kNone:
      break;
  }
  return x;
}

// A row of sums, finished and stored.   y, residual: one row of the output, residual may be null
template <int R>
void exact_store(double* y, const double* sums, const double* residual, std::int64_t N,
                 const ExactEpilogue<R>& epilogue) {
  for (std::int64_t n = 0; n < N; ++n) {
    const double bias = epilogue.bias ? epilogue.bias[n] : 0;
    const double gamma = epilogue.gamma ? epilogue.gamma[n] : 1;
    const double value = gamma * exact_activation(sums[n] + bias, epilogue.activation);
    y[n] = residual == nullptr ? value : residual[n] + value;
  }
}

inline void linear_forward(View<double, 2> y, View<const double, 2> x, View<const double, 2> weight,
                           const ExactEpilogue<2>& epilogue, Context& ctx) {
  const std::int64_t M = y.extent(0), N = y.extent(1), K = x.extent(1);
  LVGGT_CHECK(x.extent(0) == M && weight.shape() == (Shape{N, K}), "linear: x is ", x.shape(),
              ", weight ", weight.shape(), " and y ", y.shape());
  parallel_rows(
      M, 16,
      [&](std::int64_t begin, std::int64_t end) {
        std::vector<double> sums(static_cast<std::size_t>(N));
        for (std::int64_t m = begin; m < end; ++m) {
          for (std::int64_t n = 0; n < N; ++n) {
            double sum = 0;
            for (std::int64_t k = 0; k < K; ++k) sum += x[m][k] * weight[n][k];
            sums[static_cast<std::size_t>(n)] = sum;
          }
          exact_store(y[m].data(), sums.data(),
                      epilogue.residual ? epilogue.residual[m].data() : nullptr, N, epilogue);
        }
      },
      ctx);
}

inline void linear_backward(View<double, 2> dx, View<double, 2> dweight, View<double, 1> dbias,
                            View<const double, 2> dy, View<const double, 2> x,
                            View<const double, 2> weight, Context& ctx) {
  const std::int64_t M = dy.extent(0), N = dy.extent(1), K = weight.extent(1);
  LVGGT_CHECK(weight.extent(0) == N, "linear_backward: weight is ", weight.shape(), " and dy ",
              dy.shape());
  const auto column = [&](std::int64_t n, int) {
    for (std::int64_t m = 0; m < M; ++m) {
      if (dbias) dbias[n] += dy[m][n];
      if (dweight.empty()) continue;
      for (std::int64_t k = 0; k < K; ++k) dweight[n][k] += dy[m][n] * x[m][k];
    }
  };
  parallel_chunks(N, column, ctx);
  if (dx.empty()) return;
  const auto row = [&](std::int64_t m, int) {
    std::fill_n(dx[m].data(), K, 0.0);
    for (std::int64_t n = 0; n < N; ++n)
      for (std::int64_t k = 0; k < K; ++k) dx[m][k] += dy[m][n] * weight[n][k];
  };
  parallel_chunks(M, row, ctx);
}

}  // namespace lvggt
