// SPDX-License-Identifier: Apache-2.0
// Private: where a bilinear resize reads.
#pragma once

#include <algorithm>
#include <cstdint>

#include "lvggt/core/arena.h"

namespace lvggt::kernels {

// Output index i of one axis is (1 - weight) * input[low] + weight * input[high].
struct LinearTap {
  std::int64_t low;
  std::int64_t high;
  float weight;
};

// One for each output index; low never decreases.
inline View<LinearTap, 1> linear_taps(std::int64_t out, std::int64_t in, bool align_corners,
                                      Arena& arena) {
  const View<LinearTap, 1> taps = arena.alloc<LinearTap>(Shape{out});
  for (std::int64_t i = 0; i < out; ++i) {
    double source = 0;
    if (align_corners) {
      if (out > 1) source = static_cast<double>(i * (in - 1)) / static_cast<double>(out - 1);
    } else {
      source =
          (static_cast<double>(i) + 0.5) * static_cast<double>(in) / static_cast<double>(out) - 0.5;
    }
    const double position = std::clamp(source, 0.0, static_cast<double>(in - 1));
    const auto low = static_cast<std::int64_t>(position);
    taps[i] = {low, std::min(low + 1, in - 1),
               static_cast<float>(position - static_cast<double>(low))};
  }
  return taps;
}

}  // namespace lvggt::kernels
