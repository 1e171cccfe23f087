// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/geometry/confidence.h"

namespace lvggt {

using Rgb8 = std::array<std::uint8_t, 3>;

inline std::uint8_t to_byte(double x) {  // [0, 1] to [0, 255]; below and NaN 0, above 255
  return static_cast<std::uint8_t>(std::lround(255 * std::clamp(x > 0 ? x : 0.0, 0.0, 1.0)));
}

// A rainbow from dark blue over green to dark red whose brightness peaks in the middle, so that
// near and far stay apart in print: linear between nine colours, equally spaced. x in [0, 1],
// clamped.
inline Rgb8 rainbow(double x) {
  constexpr std::array<std::array<double, 3>, 9> kStops{{{0.17, 0.07, 0.35},
                                                         {0.22, 0.33, 0.85},
                                                         {0.16, 0.62, 0.96},
                                                         {0.12, 0.86, 0.71},
                                                         {0.45, 0.97, 0.35},
                                                         {0.82, 0.89, 0.20},
                                                         {0.99, 0.63, 0.18},
                                                         {0.89, 0.27, 0.07},
                                                         {0.48, 0.03, 0.02}}};
  const double position = std::clamp(x > 0 ? x : 0.0, 0.0, 1.0) * (kStops.size() - 1);
  const auto low = std::min(static_cast<std::size_t>(position), kStops.size() - 2);
  const double fraction = position - static_cast<double>(low);
  Rgb8 color;
  for (std::size_t c = 0; c < 3; ++c)
    color[c] = to_byte(kStops[low][c] + fraction * (kStops[low + 1][c] - kStops[low][c]));
  return color;
}

// An interval of values that pictures show; low == high for a constant.
struct ValueRange {
  float low = 0, high = 1;
  // Where x lies, 0 to 1 inside the interval; the middle when it is empty.
  double position(double x) const {
    return high > low ? (x - low) / (static_cast<double>(high) - low) : 0.5;
  }
};

// From the p-th to the (100 - p)-th percentile of the values: outliers do not take the colours.
inline ValueRange robust_range(View<const float, 2> values, double p = 2) {
  std::vector<float> sorted;
  sorted.reserve(static_cast<std::size_t>(values.size()));
  for (std::int64_t y = 0; y < values.extent(0); ++y)
    sorted.insert(sorted.end(), values[y].data(), values[y].data() + values.extent(1));
  const float low = percentile_in_place(sorted, p);
  return {low, percentile_in_place(sorted, 100 - p)};
}

// Values as colours of the rainbow.
//   pixels: [H, W, 3]   values: [H, W]
inline void color_values(View<std::uint8_t, 3> pixels, View<const float, 2> values,
                         const ValueRange& range) {
  LVGGT_CHECK((pixels.shape() == Shape{values.extent(0), values.extent(1), std::int64_t{3}}),
              "color_values: pixels are ", pixels.shape(), " but values are ", values.shape());
  for (std::int64_t y = 0; y < values.extent(0); ++y)
    for (std::int64_t x = 0; x < values.extent(1); ++x)
      std::ranges::copy(rainbow(range.position(values(y, x))), pixels[y][x].data());
}

// Colours in [0, 1] as bytes, clamped.
//   pixels, rgb: [H, W, 3]
inline void color_bytes(View<std::uint8_t, 3> pixels, View<const float, 3> rgb) {
  LVGGT_CHECK(pixels.shape() == rgb.shape(), "color_bytes: pixels are ", pixels.shape(),
              " but colours are ", rgb.shape());
  for (std::int64_t y = 0; y < rgb.extent(0); ++y)
    for (std::int64_t x = 0; x < rgb.extent(1); ++x)
      for (std::int64_t c = 0; c < rgb.extent(2); ++c) pixels(y, x, c) = to_byte(rgb(y, x, c));
}

}  // namespace lvggt
