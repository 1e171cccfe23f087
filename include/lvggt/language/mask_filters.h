// SPDX-License-Identifier: Apache-2.0
// The filters between a relevancy map and a mask. A window of `size` (odd) pixels is centred on
// each pixel; what lies outside of the map is not counted. Running sums: the time does not depend
// on the size of the window.
#pragma once

#include <cstdint>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// y = mean of x over the window, summed in double.   y, x: [H, W]   y is not x.
void box_filter(View<float, 2> y, View<const float, 2> x, std::int64_t size, Context& ctx);

// y = 1 where more than half of the window is 1, else 0.   y, x: [H, W], 0 or 1   y is not x.
void majority_filter(View<std::uint8_t, 2> y, View<const std::uint8_t, 2> x, std::int64_t size,
                     Context& ctx);

// mask = 1 where v > threshold, with v = clip(2 u - 1, 0, 1) of u = (x - min) / (max - min + 1e-9).
// A constant map has an empty mask.   mask, x: [H, W]
void threshold_mask(View<std::uint8_t, 2> mask, View<const float, 2> x, float threshold);

}  // namespace lvggt
