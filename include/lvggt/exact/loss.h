// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <vector>

#include "lvggt/exact/norm.h"
#include "lvggt/kernels/loss.h"

namespace lvggt {

// The terms of the training objective in float64; see lvggt/kernels/loss.h and
// lvggt/exact/linear.h.

// m (a - b) of one element.
inline double exact_error(View<const double, 4> a, View<const double, 4> b,
                          View<const double, 3> mask, std::int64_t n, std::int64_t i,
                          std::int64_t j, std::int64_t c) {
  return (mask ? mask(n, i, j) : 1) * (a(n, i, j, c) - b(n, i, j, c));
}

inline double l1_loss_forward(View<const double, 4> a, View<const double, 4> b,
                              View<const double, 3> mask, Context&) {
  double sum = 0;
  exact_for_each_element(a, [&](auto n, auto i, auto j, auto c) {
    sum += std::abs(exact_error(a, b, mask, n, i, j, c));
  });
  return sum / static_cast<double>(a.size());
}

inline void l1_loss_backward(View<double, 4> da, double dloss, View<const double, 4> a,
                             View<const double, 4> b, View<const double, 3> mask, Context&) {
  const double scale = dloss / static_cast<double>(a.size());
  exact_for_each_element(a, [&](auto n, auto i, auto j, auto c) {
    const double error = exact_error(a, b, mask, n, i, j, c);
    const double sign = error > 0 ? 1 : error < 0 ? -1 : 0;
    da(n, i, j, c) = scale * (mask ? mask(n, i, j) : 1) * sign;
  });
}

inline double mse_loss_forward(View<const double, 4> a, View<const double, 4> b,
                               View<const double, 3> mask, Context&) {
  double sum = 0;
  exact_for_each_element(a, [&](auto n, auto i, auto j, auto c) {
    const double error = exact_error(a, b, mask, n, i, j, c);
    sum += error * error;
  });
  return sum / static_cast<double>(a.size());
}

inline void mse_loss_backward(View<double, 4> da, double dloss, View<const double, 4> a,
                              View<const double, 4> b, View<const double, 3> mask, Context&) {
  const double scale = 2 * dloss / static_cast<double>(a.size());
  exact_for_each_element(a, [&](auto n, auto i, auto j, auto c) {
    da(n, i, j, c) = scale * (mask ? mask(n, i, j) : 1) * exact_error(a, b, mask, n, i, j, c);
  });
}

// The sums that the cosine of two vectors is made of.
struct ExactCosine {
  double uv = 0, uu = 0, vv = 0;

  bool directed() const {
    return std::sqrt(uu) >= kShortestDirection && std::sqrt(vv) >= kShortestDirection;
  }
  double value() const { return directed() ? uv / std::sqrt(uu * vv) : 0; }
};

// One for every vector along the axis: [B, H, W, 1] or, over the width, [B, H, 1, C].
inline Tensor<ExactCosine, 4> exact_cosines(View<const double, 4> a, View<const double, 4> b,
                                            View<const double, 3> mask, CosineAxis axis) {
  Shape<4> shape = a.shape();
  shape[axis == CosineAxis::kChannels ? 3 : 2] = 1;
  Tensor<ExactCosine, 4> cosines(shape);
  exact_for_each_element(a, [&](auto n, auto i, auto j, auto c) {
    const double m = mask ? mask(n, i, j) : 1;
    const double u = m * a(n, i, j, c), v = m * b(n, i, j, c);
    ExactCosine& cosine = axis == CosineAxis::kChannels ? cosines(n, i, j, 0) : cosines(n, i, 0, c);
    cosine.uv += u * v;
    cosine.uu += u * u;
    cosine.vv += v * v;
  });
  return cosines;
}

inline double cosine_loss_forward(View<const double, 4> a, View<const double, 4> b,
                                  View<const double, 3> mask, CosineAxis axis, Context&) {
  const Tensor<ExactCosine, 4> cosines = exact_cosines(a, b, mask, axis);
  double sum = 0;
  for (std::int64_t n = 0; n < cosines.size(); ++n) sum += cosines.data()[n].value();
  return 1 - sum / static_cast<double>(cosines.size());
}

inline void cosine_loss_backward(View<double, 4> da, double dloss, View<const double, 4> a,
                                 View<const double, 4> b, View<const double, 3> mask,
                                 CosineAxis axis, Context&) {
  const Tensor<ExactCosine, 4> cosines = exact_cosines(a, b, mask, axis);
  const double scale = -dloss / static_cast<double>(cosines.size());
  exact_for_each_element(a, [&](auto n, auto i, auto j, auto c) {
    const ExactCosine& cosine =
        axis == CosineAxis::kChannels ? cosines(n, i, j, 0) : cosines(n, i, 0, c);
    const double m = mask ? mask(n, i, j) : 1;
    const double u = m * a(n, i, j, c), v = m * b(n, i, j, c);
    da(n, i, j, c) =
        cosine.directed()
            ? scale * m * (v / std::sqrt(cosine.uu * cosine.vv) - cosine.value() * u / cosine.uu)
            : 0;
  });
}

}  // namespace lvggt
