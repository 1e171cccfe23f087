// SPDX-License-Identifier: Apache-2.0
// Private: the mask filters with scratch that their caller provides, so that several maps can be
// filtered at once.
#pragma once

#include <algorithm>
#include <cstdint>

#include "lvggt/core/tensor.h"

namespace lvggt::kernels {

// Calls emit(y, x, sum over the window, pixels of the window inside the map) for every pixel.
// Windows are clipped to the map; columns: scratch for W sums.   x: [H, W]
template <class Sum, class T, class Emit>
void window_sums(View<const T, 2> x, std::int64_t size, Sum* columns, const Emit& emit) {
  const auto [H, W] = x.shape();
  const std::int64_t r = size / 2;
  const auto row = [&](std::int64_t y) { return x.data() + y * x.stride(0); };
  std::fill_n(columns, W, Sum{});
  for (std::int64_t y = 0; y < std::min(r, H); ++y)
    for (std::int64_t i = 0; i < W; ++i) columns[i] += row(y)[i];
  for (std::int64_t y = 0; y < H; ++y) {
    if (y + r < H)
      for (std::int64_t i = 0; i < W; ++i) columns[i] += row(y + r)[i];
    if (y - r - 1 >= 0)
      for (std::int64_t i = 0; i < W; ++i) columns[i] -= row(y - r - 1)[i];
    const std::int64_t rows = std::min(y + r, H - 1) - std::max<std::int64_t>(y - r, 0) + 1;
    Sum sum{};
    for (std::int64_t i = 0; i < std::min(r, W); ++i) sum += columns[i];
    for (std::int64_t i = 0; i < W; ++i) {
      if (i + r < W) sum += columns[i + r];
      if (i - r - 1 >= 0) sum -= columns[i - r - 1];
      const std::int64_t width = std::min(i + r, W - 1) - std::max<std::int64_t>(i - r, 0) + 1;
      emit(y, i, sum, rows * width);
    }
  }
}

// columns: scratch of W values.
inline void box_filter(View<float, 2> y, View<const float, 2> x, std::int64_t size,
                       double* columns) {
  window_sums<double>(
      x, size, columns, [&](std::int64_t row, std::int64_t i, double sum, std::int64_t count) {
        y.data()[row * y.stride(0) + i] = static_cast<float>(sum / static_cast<double>(count));
      });
}

inline void majority_filter(View<std::uint8_t, 2> y, View<const std::uint8_t, 2> x,
                            std::int64_t size, std::int32_t* columns) {
  window_sums<std::int32_t>(
      x, size, columns,
      [&](std::int64_t row, std::int64_t i, std::int32_t sum, std::int64_t count) {
        y.data()[row * y.stride(0) + i] = 2 * std::int64_t{sum} > count ? 1 : 0;
      });
}

}  // namespace lvggt::kernels
