// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <span>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// Points below this confidence are never kept; the release's constant.
inline constexpr float kMinConfidence = 1e-5f;

// Default percentile of the confidence filter; the release's constant.
inline constexpr double kConfidencePercentile = 3;

// The p-th percentile with linear interpolation between the two nearest ranks, as numpy.percentile:
// rank p / 100 * (n - 1). Reorders `values`. Errors: p outside [0, 100] or not a number (kUsage),
// no values (kMismatch), a NaN among them (kNumeric).
inline float percentile_in_place(std::span<float> values, double p) {
  if (!(p >= 0 && p <= 100)) fail(ErrorKind::kUsage, "percentile: ", p, " is not in [0, 100]");
  LVGGT_CHECK(!values.empty(), "percentile: there are no values");
  for (const float value : values)
    if (std::isnan(value)) fail(ErrorKind::kNumeric, "percentile: one of the values is NaN");
  const double rank = p / 100 * static_cast<double>(values.size() - 1);
  const auto low = static_cast<std::ptrdiff_t>(rank);
  std::nth_element(values.begin(), values.begin() + low, values.end());
  const double below = values[static_cast<std::size_t>(low)];
  const double fraction = rank - static_cast<double>(low);
  if (fraction == 0) return static_cast<float>(below);
  const double above = *std::min_element(values.begin() + low + 1, values.end());
  return static_cast<float>(below + (above - below) * fraction);
}

// Which points of a frame to keep: confidence at least its p-th percentile in the frame and above
// kMinConfidence. Returns how many.
//   keep: [H, W], 1 or 0   confidence: [H, W]
inline std::int64_t confidence_filter(View<std::uint8_t, 2> keep, View<const float, 2> confidence,
                                      double p, Context& ctx) {
  const auto [H, W] = confidence.shape();
  LVGGT_CHECK(keep.shape() == confidence.shape(), "confidence_filter: keep is ", keep.shape(),
              " but confidence is ", confidence.shape());
  Arena::Scope scope(ctx.arena());
  const auto values = ctx.arena().alloc<float>(Shape{H * W});
  for (std::int64_t y = 0; y < H; ++y) std::copy_n(confidence[y].data(), W, values.data() + y * W);
  const float threshold = percentile_in_place({values.data(), static_cast<std::size_t>(H * W)}, p);

  std::int64_t kept = 0;
  for (std::int64_t y = 0; y < H; ++y) {
    for (std::int64_t x = 0; x < W; ++x) {
      const float value = confidence(y, x);
      keep(y, x) = value >= threshold && value > kMinConfidence;
      kept += keep(y, x);
    }
  }
  return kept;
}

}  // namespace lvggt
