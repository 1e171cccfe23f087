// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "lvggt/exact/linear.h"

namespace lvggt {

// Convolutions, forward and backward, in float64; see lvggt/exact/linear.h.

// Weights [A, B, k, k] as [k, k, A, B] or, exchanged, [k, k, B, A]: inner loops run along a row.
inline Tensor<double, 4> exact_taps(View<const double, 4> weight, bool exchanged) {
  const auto [A, B, k, k2] = weight.shape();
  Tensor<double, 4> taps(exchanged ? Shape{k, k2, B, A} : Shape{k, k2, A, B});
  for (std::int64_t a = 0; a < A; ++a)
    for (std::int64_t b = 0; b < B; ++b)
      for (std::int64_t ky = 0; ky < k; ++ky)
        for (std::int64_t kx = 0; kx < k; ++kx)
          taps(ky, kx, exchanged ? b : a, exchanged ? a : b) = weight(a, b, ky, kx);
  return taps;
}

// sums[n] += sum over k of x[k] w[k, n]
inline void exact_add_product(double* sums, const double* x, View<const double, 2> w) {
  const std::int64_t K = w.extent(0), N = w.extent(1);
  for (std::int64_t k = 0; k < K; ++k) {
    const double value = x[k];
    const double* row = w.data() + k * w.stride(0);
    for (std::int64_t n = 0; n < N; ++n) sums[n] += value * row[n];
  }
}

// The sum over some pixels of the outer product a b^T, added to a weight's tap (ky, kx).
class ExactOuterSum {
 public:
  ExactOuterSum(std::int64_t A, std::int64_t B)
      : A_(A), B_(B), sums_(static_cast<std::size_t>(A * B)) {}

  void add(const double* a, const double* b) {
    double* row = sums_.data();
    for (std::int64_t i = 0; i < A_; ++i, row += B_)
      for (std::int64_t j = 0; j < B_; ++j) row[j] += a[i] * b[j];
  }

  void add_to(View<double, 4> dweight, std::int64_t ky, std::int64_t kx) const {
    for (std::int64_t i = 0; i < A_; ++i)
      for (std::int64_t j = 0; j < B_; ++j)
        dweight(i, j, ky, kx) += sums_[static_cast<std::size_t>(i * B_ + j)];
  }

 private:
  std::int64_t A_, B_;
  std::vector<double> sums_;
};

// The channels of one pixel.
template <class T>
T* exact_pixel(View<T, 4> map, std::int64_t b, std::int64_t i, std::int64_t j) {
  return map.data() + b * map.stride(0) + i * map.stride(1) + j * map.stride(2);
}

inline void exact_clear(View<double, 4> map, std::int64_t b) {
  for (std::int64_t i = 0; i < map.extent(1); ++i)
    for (std::int64_t j = 0; j < map.extent(2); ++j)
      std::fill_n(exact_pixel(map, b, i, j), map.extent(3), 0.0);
}

// dbias += sum over all pixels of dy.
inline void exact_bias_backward(View<double, 1> dbias, View<const double, 4> dy) {
  if (dbias.empty()) return;
  for (std::int64_t b = 0; b < dy.extent(0); ++b)
    for (std::int64_t i = 0; i < dy.extent(1); ++i)
      for (std::int64_t j = 0; j < dy.extent(2); ++j)
        for (std::int64_t c = 0; c < dy.extent(3); ++c) dbias[c] += dy(b, i, j, c);
}

inline void conv2d_forward(View<double, 4> y, View<const double, 4> x, View<const double, 4> weight,
                           std::int64_t stride, std::int64_t padding,
                           const ExactEpilogue<4>& epilogue, Context& ctx) {
  const std::int64_t Ho = y.extent(1), Cout = y.extent(3), H = x.extent(1), W = x.extent(2);
  const std::int64_t k = weight.extent(2);
  LVGGT_CHECK(weight.extent(0) == Cout && weight.extent(1) == x.extent(3), "conv2d: x is ",
              x.shape(), ", weight ", weight.shape(), " and y ", y.shape());
  const Tensor<double, 4> taps = exact_taps(weight, true);  // [k, k, Cin, Cout]
  const auto row = [&](std::int64_t chunk, int) {
    const std::int64_t b = chunk / Ho, i = chunk % Ho;
    std::vector<double> sums(static_cast<std::size_t>(Cout));
    for (std::int64_t j = 0; j < y.extent(2); ++j) {
      std::fill(sums.begin(), sums.end(), 0.0);
      for (std::int64_t ky = 0; ky < k; ++ky)
        for (std::int64_t kx = 0; kx < k; ++kx) {
          const std::int64_t h = i * stride + ky - padding, w = j * stride + kx - padding;
          if (h < 0 || h >= H || w < 0 || w >= W) continue;
          exact_add_product(sums.data(), exact_pixel(x, b, h, w), taps[ky][kx]);
        }
      exact_store(exact_pixel(y, b, i, j), sums.data(),
                  epilogue.residual ? exact_pixel(epilogue.residual, b, i, j) : nullptr, Cout,
                  epilogue);
    }
  };
  parallel_chunks(y.extent(0) * Ho, row, ctx);
}

inline void conv2d_backward(View<double, 4> dx, View<double, 4> dweight, View<double, 1> dbias,
                            View<const double, 4> dy, View<const double, 4> x,
                            View<const double, 4> weight, std::int64_t stride, std::int64_t padding,
                            Context& ctx) {
  const std::int64_t B = dy.extent(0), Ho = dy.extent(1), Wo = dy.extent(2);
  const std::int64_t k = weight.extent(2);
  // f(b, i, j, h, w): output pixel (i, j) reads input pixel (h, w) of H x W by tap (ky, kx)
  const auto for_each_pair = [&](std::int64_t b, std::int64_t ky, std::int64_t kx, std::int64_t H,
                                 std::int64_t W, const auto& f) {
    for (std::int64_t i = 0; i < Ho; ++i)
      for (std::int64_t j = 0; j < Wo; ++j) {
        const std::int64_t h = i * stride + ky - padding, w = j * stride + kx - padding;
        if (h >= 0 && h < H && w >= 0 && w < W) f(b, i, j, h, w);
      }
  };
  exact_bias_backward(dbias, dy);
  if (dweight) {
    const auto tap = [&](std::int64_t t, int) {
      ExactOuterSum sum(weight.extent(0), weight.extent(1));
      for (std::int64_t b = 0; b < B; ++b)
        for_each_pair(b, t / k, t % k, x.extent(1), x.extent(2),
                      [&](auto b2, auto i, auto j, auto h, auto w) {
                        sum.add(exact_pixel(dy, b2, i, j), exact_pixel(x, b2, h, w));
                      });
      sum.add_to(dweight, t / k, t % k);
    };
    parallel_chunks(k * k, tap, ctx);
  }
  if (dx.empty()) return;
  const Tensor<double, 4> taps = exact_taps(weight, false);  // [k, k, Cout, Cin]
  const auto frame = [&](std::int64_t b, int) {
    exact_clear(dx, b);
    for (std::int64_t t = 0; t < k * k; ++t)
      for_each_pair(b, t / k, t % k, dx.extent(1), dx.extent(2),
                    [&](auto b2, auto i, auto j, auto h, auto w) {
                      exact_add_product(exact_pixel(dx, b2, h, w), exact_pixel(dy, b2, i, j),
                                        taps[t / k][t % k]);
                    });
  };
  parallel_chunks(B, frame, ctx);
}

inline void conv_transpose2d_forward(View<double, 4> y, View<const double, 4> x,
                                     View<const double, 4> weight, View<const double, 1> bias,
                                     Context& ctx) {
  const std::int64_t Ho = y.extent(1), Cout = y.extent(3), k = weight.extent(2);
  LVGGT_CHECK(weight.extent(0) == x.extent(3) && weight.extent(1) == Cout && Ho == k * x.extent(1),
              "conv_transpose2d: x is ", x.shape(), ", weight ", weight.shape(), " and y ",
              y.shape());
  const Tensor<double, 4> taps = exact_taps(weight, false);  // [k, k, Cin, Cout]
  const auto row = [&](std::int64_t chunk, int) {
    const std::int64_t b = chunk / Ho, i = chunk % Ho;
    for (std::int64_t j = 0; j < y.extent(2); ++j) {
      double* out = exact_pixel(y, b, i, j);
      for (std::int64_t c = 0; c < Cout; ++c) out[c] = bias ? bias[c] : 0;
      exact_add_product(out, exact_pixel(x, b, i / k, j / k), taps[i % k][j % k]);
    }
  };
  parallel_chunks(y.extent(0) * Ho, row, ctx);
}

inline void conv_transpose2d_backward(View<double, 4> dx, View<double, 4> dweight,
                                      View<double, 1> dbias, View<const double, 4> dy,
                                      View<const double, 4> x, View<const double, 4> weight,
                                      Context& ctx) {
  const std::int64_t k = weight.extent(2), B = dy.extent(0);
  const std::int64_t H = dy.extent(1) / k, W = dy.extent(2) / k;
  exact_bias_backward(dbias, dy);
  if (dweight) {
    const auto place = [&](std::int64_t t, int) {
      ExactOuterSum sum(weight.extent(0), weight.extent(1));
      for (std::int64_t b = 0; b < B; ++b)
        for (std::int64_t i = 0; i < H; ++i)
          for (std::int64_t j = 0; j < W; ++j)
            sum.add(exact_pixel(x, b, i, j), exact_pixel(dy, b, k * i + t / k, k * j + t % k));
      sum.add_to(dweight, t / k, t % k);
    };
    parallel_chunks(k * k, place, ctx);
  }
  if (dx.empty()) return;
  const Tensor<double, 4> taps = exact_taps(weight, true);  // [k, k, Cout, Cin]
  const auto frame = [&](std::int64_t b, int) {
    exact_clear(dx, b);
    for (std::int64_t i = 0; i < k * H; ++i)
      for (std::int64_t j = 0; j < k * W; ++j)
        exact_add_product(exact_pixel(dx, b, i / k, j / k), exact_pixel(dy, b, i, j),
                          taps[i % k][j % k]);
  };
  parallel_chunks(B, frame, ctx);
}

}  // namespace lvggt
