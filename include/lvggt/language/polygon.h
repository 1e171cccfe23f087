// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <span>

#include "lvggt/core/tensor.h"

namespace lvggt {

// Coordinates beyond this in either direction are refused: 16 of 63 bits hold the fraction.
inline constexpr double kMaxPolygonCoordinate = 1 << 20;

// Sets the pixels of a polygon to 1 and leaves the others as they are: its outline and its even-odd
// interior, the same pixels as OpenCV 4.6 fills with fillPoly.
//   mask: [H, W]   points: x, y in pixels, truncated towards zero; none: nothing is drawn
// The outline's edges are 8-connected lines drawn from their left end, each clipped to the image
// first. The interior of row y are the pixels between pairs of crossings with the edges
// y0 <= y < y1, in 16.16 fixed point. Errors: kFormat for a coordinate that is not finite or beyond
// kMaxPolygonCoordinate.
void fill_polygon(View<std::uint8_t, 2> mask, std::span<const std::array<double, 2>> points);

}  // namespace lvggt
