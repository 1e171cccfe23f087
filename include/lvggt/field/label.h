// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>

#include "lvggt/core/tensor.h"
#include "lvggt/field/color_map.h"

namespace lvggt {

// Height of a line of text, in pixels times the scale, and the width of `text`. ASCII only: other
// bytes show as '?'.
inline constexpr int kLabelHeight = 12;
int label_width(const std::string& text, int scale);

// Draws one line of text with its top left corner at pixel (x, y); what falls outside the picture
// is cut.
//   pixels: [H, W, 3]
void draw_label(View<std::uint8_t, 3> pixels, std::int64_t x, std::int64_t y,
                const std::string& text, int scale, const Rgb8& color);

}  // namespace lvggt
