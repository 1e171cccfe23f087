// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>

#include "lvggt/exact/conv2d.h"

namespace lvggt {

// Element-wise operations and resizes in float64; see lvggt/exact/linear.h.

inline void add(View<double, 2> y, View<const double, 2> a, View<const double, 2> b, Context&) {
  for (std::int64_t n = 0; n < y.extent(0); ++n)
    for (std::int64_t c = 0; c < y.extent(1); ++c) y[n][c] = a[n][c] + b[n][c];
}

inline void accumulate(View<double, 2> dx, View<const double, 2> dx_other, Context& ctx) {
  add(dx, dx, dx_other, ctx);
}

inline void copy_rows(View<double, 2> y, View<const double, 2> x, Context&) {
  for (std::int64_t n = 0; n < y.extent(0); ++n) std::copy_n(x[n].data(), y.extent(1), y[n].data());
}

inline void activation_forward(View<double, 2> y, View<const double, 2> x, Activation activation,
                               Context&) {
  for (std::int64_t n = 0; n < y.extent(0); ++n)
    for (std::int64_t c = 0; c < y.extent(1); ++c) y[n][c] = exact_activation(x[n][c], activation);
}

inline void relu_backward(View<double, 2> dx, View<const double, 2> dy, View<const double, 2> y,
                          Context&) {
  for (std::int64_t n = 0; n < dx.extent(0); ++n)
    for (std::int64_t c = 0; c < dx.extent(1); ++c) dx[n][c] = y[n][c] > 0 ? dy[n][c] : 0;
}

inline void sigmoid_backward(View<double, 2> dx, View<const double, 2> dy, View<const double, 2> y,
                             Context&) {
  for (std::int64_t n = 0; n < dx.extent(0); ++n)
    for (std::int64_t c = 0; c < dx.extent(1); ++c) dx[n][c] = dy[n][c] * y[n][c] * (1 - y[n][c]);
}

// The two input samples that an output sample of a resize is blended from.
struct ExactBlend {
  std::array<std::int64_t, 2> from{};
  std::array<double, 2> weight{};
};

inline ExactBlend exact_blend(std::int64_t i, std::int64_t out, std::int64_t in,
                              bool align_corners) {
  double source = 0;
  if (!align_corners) {
    source = std::max(
        (static_cast<double>(i) + 0.5) * static_cast<double>(in) / static_cast<double>(out) - 0.5,
        0.0);
  } else if (out > 1) {
    source = static_cast<double>(i) * static_cast<double>(in - 1) / static_cast<double>(out - 1);
  }
  const std::int64_t low = std::min(static_cast<std::int64_t>(source), in - 1);
  const double part = source - static_cast<double>(low);
  return {{low, std::min(low + 1, in - 1)}, {1 - part, part}};
}

// Calls f(from, to, weight) with the pixels' channels for all four inputs of every output of frame
// b.   small: the resize's input or its gradient, large: its output or its gradient
template <class Small, class Large, class F>
void exact_for_each_blend(View<Small, 4> small, View<Large, 4> large, std::int64_t b,
                          bool align_corners, const F& f) {
  for (std::int64_t i = 0; i < large.extent(1); ++i) {
    const ExactBlend y = exact_blend(i, large.extent(1), small.extent(1), align_corners);
    for (std::int64_t j = 0; j < large.extent(2); ++j) {
      const ExactBlend x = exact_blend(j, large.extent(2), small.extent(2), align_corners);
      for (std::size_t corner = 0; corner < 4; ++corner)
        f(exact_pixel(small, b, y.from[corner / 2], x.from[corner % 2]),
          exact_pixel(large, b, i, j), y.weight[corner / 2] * x.weight[corner % 2]);
    }
  }
}

inline void bilinear_forward(View<double, 4> y, View<const double, 4> x, bool align_corners,
                             Context&) {
  for (std::int64_t b = 0; b < y.extent(0); ++b) {
    exact_clear(y, b);
    exact_for_each_blend(x, y, b, align_corners,
                         [&](const double* from, double* to, double weight) {
                           for (std::int64_t c = 0; c < y.extent(3); ++c) to[c] += weight * from[c];
                         });
  }
}

inline void bilinear_backward(View<double, 4> dx, View<const double, 4> dy, bool align_corners,
                              Context&) {
  for (std::int64_t b = 0; b < dx.extent(0); ++b) {
    exact_clear(dx, b);
    exact_for_each_blend(dx, dy, b, align_corners,
                         [&](double* to, const double* from, double weight) {
                           for (std::int64_t c = 0; c < dx.extent(3); ++c)
                             to[c] += weight * from[c];
                         });
  }
}

}  // namespace lvggt
