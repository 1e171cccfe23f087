// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/exact/conv2d.h"

namespace lvggt {

// Layer norm and batch norm, forward and backward, in float64; see lvggt/exact/linear.h.

inline void layer_norm_forward(View<double, 2> y, View<double, 1> mean, View<double, 1> rstd,
                               View<const double, 2> x, View<const double, 1> gamma,
                               View<const double, 1> beta, double eps, Context&) {
  const std::int64_t C = x.extent(1);
  const auto count = static_cast<double>(C);
  for (std::int64_t n = 0; n < x.extent(0); ++n) {
    double sum = 0, squares = 0;
    for (std::int64_t c = 0; c < C; ++c) sum += x[n][c];
    mean[n] = sum / count;
    for (std::int64_t c = 0; c < C; ++c) squares += (x[n][c] - mean[n]) * (x[n][c] - mean[n]);
    rstd[n] = 1 / std::sqrt(squares / count + eps);
    for (std::int64_t c = 0; c < C; ++c)
      y[n][c] = (gamma ? gamma[c] : 1) * (x[n][c] - mean[n]) * rstd[n] + (beta ? beta[c] : 0);
  }
}

inline void layer_norm_backward(View<double, 2> dx, View<double, 1> dgamma, View<double, 1> dbeta,
                                View<const double, 2> dy, View<const double, 1> mean,
                                View<const double, 1> rstd, View<const double, 2> x,
                                View<const double, 1> gamma, Context&) {
  const std::int64_t C = x.extent(1);
  const auto count = static_cast<double>(C);
  for (std::int64_t n = 0; n < x.extent(0); ++n) {
    const auto normed = [&](std::int64_t c) { return (x[n][c] - mean[n]) * rstd[n]; };
    const auto g = [&](std::int64_t c) { return (gamma ? gamma[c] : 1) * dy[n][c]; };
    double sum = 0, product = 0;
    for (std::int64_t c = 0; c < C; ++c) {
      sum += g(c);
      product += g(c) * normed(c);
      if (dgamma) dgamma[c] += dy[n][c] * normed(c);
      if (dbeta) dbeta[c] += dy[n][c];
    }
    if (dx.empty()) continue;
    for (std::int64_t c = 0; c < C; ++c)
      dx[n][c] = rstd[n] * (g(c) - sum / count - normed(c) * product / count);
  }
}

// Calls f(b, i, j, c) for every element of a map.
template <class T, class F>
void exact_for_each_element(View<T, 4> map, const F& f) {
  for (std::int64_t b = 0; b < map.extent(0); ++b)
    for (std::int64_t i = 0; i < map.extent(1); ++i)
      for (std::int64_t j = 0; j < map.extent(2); ++j)
        for (std::int64_t c = 0; c < map.extent(3); ++c) f(b, i, j, c);
}

inline void batch_norm2d_sums(View<double, 2> sums, View<const double, 4> x,
                              View<const double, 1> pivot, Context&) {
  for (std::int64_t c = 0; c < x.extent(3); ++c) sums(0, c) = sums(1, c) = 0;
  exact_for_each_element(x, [&](auto b, auto i, auto j, auto c) {
    const double deviation = x(b, i, j, c) - (pivot ? pivot[c] : 0);
    sums(0, c) += deviation;
    sums(1, c) += deviation * deviation;
  });
}

inline void batch_norm2d_statistics(View<double, 1> mean, View<double, 1> rstd,
                                    View<double, 1> running_mean, View<double, 1> running_var,
                                    View<const double, 2> sums, View<const double, 1> pivot,
                                    std::int64_t count, double eps, double momentum) {
  const auto n = static_cast<double>(count);
  LVGGT_CHECK(count >= 2, "batch_norm2d: ", count, " values a channel have no variance");
  for (std::int64_t c = 0; c < mean.extent(0); ++c) {
    const double shift = sums(0, c) / n;
    const double var = sums(1, c) / n - shift * shift;
    mean[c] = (pivot ? pivot[c] : 0) + shift;
    rstd[c] = 1 / std::sqrt(var + eps);
    if (running_mean) running_mean[c] += momentum * (mean[c] - running_mean[c]);
    if (running_var) running_var[c] += momentum * (var * n / (n - 1) - running_var[c]);
  }
}

inline void batch_norm2d_rstd(View<double, 1> rstd, View<const double, 1> var, double eps) {
  for (std::int64_t c = 0; c < var.extent(0); ++c) rstd[c] = 1 / std::sqrt(var[c] + eps);
}

inline void batch_norm2d_normalize(View<double, 4> y, View<const double, 4> x,
                                   View<const double, 1> mean, View<const double, 1> rstd,
                                   View<const double, 1> gamma, View<const double, 1> beta,
                                   Activation activation, Context&) {
  exact_for_each_element(x, [&](auto b, auto i, auto j, auto c) {
    const double normed = (x(b, i, j, c) - mean[c]) * rstd[c];
    y(b, i, j, c) = exact_activation(gamma[c] * normed + beta[c], activation);
  });
}

// In two passes: the mean, then the squares around it.
inline void batch_norm2d_forward(View<double, 4> y, View<double, 1> mean, View<double, 1> rstd,
                                 View<double, 1> running_mean, View<double, 1> running_var,
                                 View<const double, 4> x, View<const double, 1> gamma,
                                 View<const double, 1> beta, double eps, double momentum,
                                 Activation activation, Context& ctx) {
  const std::int64_t C = x.extent(3), count = x.size() / C;
  Tensor<double, 2> sums(Shape{std::int64_t{2}, C});
  Tensor<double, 1> pivot(Shape{C});
  batch_norm2d_sums(sums, x, {}, ctx);
  for (std::int64_t c = 0; c < C; ++c) pivot[c] = sums(0, c) / static_cast<double>(count);
  batch_norm2d_sums(sums, x, pivot, ctx);
  batch_norm2d_statistics(mean, rstd, running_mean, running_var, sums, pivot, count, eps, momentum);
  batch_norm2d_normalize(y, x, mean, rstd, gamma, beta, activation, ctx);
}

// dy where the activation passed it on. The comparison is that of normalize's own value.
inline double exact_passed(double dy, double normed, double gamma, double beta,
                           Activation activation) {
  return activation != Activation::kRelu || gamma * normed + beta > 0 ? dy : 0;
}

inline void batch_norm2d_backward_sums(View<double, 2> sums, View<const double, 4> dy,
                                       View<const double, 1> mean, View<const double, 1> rstd,
                                       View<const double, 4> x, View<const double, 1> gamma,
                                       View<const double, 1> beta, Activation activation,
                                       Context&) {
  for (std::int64_t c = 0; c < x.extent(3); ++c) sums(0, c) = sums(1, c) = 0;
  exact_for_each_element(x, [&](auto b, auto i, auto j, auto c) {
    const double normed = (x(b, i, j, c) - mean[c]) * rstd[c];
    const double g = exact_passed(dy(b, i, j, c), normed, gamma[c], beta[c], activation);
    sums(0, c) += g;
    sums(1, c) += g * normed;
  });
}

inline void batch_norm2d_backward_parameters(View<double, 1> dgamma, View<double, 1> dbeta,
                                             View<const double, 2> sums) {
  for (std::int64_t c = 0; c < sums.extent(1); ++c) {
    if (dgamma) dgamma[c] += sums(1, c);
    if (dbeta) dbeta[c] += sums(0, c);
  }
}

inline void batch_norm2d_backward_input(View<double, 4> dx, View<const double, 4> dy,
                                        View<const double, 2> sums, std::int64_t count,
                                        View<const double, 1> mean, View<const double, 1> rstd,
                                        View<const double, 4> x, View<const double, 1> gamma,
                                        View<const double, 1> beta, Activation activation,
                                        Context&) {
  const auto n = static_cast<double>(count);
  exact_for_each_element(x, [&](auto b, auto i, auto j, auto c) {
    const double normed = (x(b, i, j, c) - mean[c]) * rstd[c];
    double g = exact_passed(dy(b, i, j, c), normed, gamma[c], beta[c], activation);
    if (sums) g -= sums(0, c) / n + normed * sums(1, c) / n;
    dx(b, i, j, c) = gamma[c] * rstd[c] * g;
  });
}

inline void batch_norm2d_backward(View<double, 4> dx, View<double, 1> dgamma, View<double, 1> dbeta,
                                  View<const double, 4> dy, View<const double, 1> mean,
                                  View<const double, 1> rstd, View<const double, 4> x,
                                  View<const double, 1> gamma, View<const double, 1> beta,
                                  Activation activation, Context& ctx) {
  const std::int64_t C = x.extent(3);
  Tensor<double, 2> sums(Shape{std::int64_t{2}, C});
  batch_norm2d_backward_sums(sums, dy, mean, rstd, x, gamma, beta, activation, ctx);
  batch_norm2d_backward_parameters(dgamma, dbeta, sums);
  if (dx.empty()) return;
  batch_norm2d_backward_input(dx, dy, sums, x.size() / C, mean, rstd, x, gamma, beta, activation,
                              ctx);
}

}  // namespace lvggt
