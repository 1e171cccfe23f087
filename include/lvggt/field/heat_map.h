// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>

#include "lvggt/core/tensor.h"
#include "lvggt/field/color_map.h"

namespace lvggt {

// What answers are painted with: in the mask, and where a state does not hold.
inline constexpr Rgb8 kAnswerColor{255, 122, 16}, kNegativeColor{96, 128, 208};

// A relevancy that says nothing: as near to the phrase as to the nearest canonical one.
inline constexpr float kNeutralRelevancy = 0.5F;

namespace heat_map_detail {

// Brightness of a pixel in [0, 255] (ITU-R BT.601).
inline double grey_of(View<const std::uint8_t, 1> pixel) {
  return 0.299 * pixel[0] + 0.587 * pixel[1] + 0.114 * pixel[2];
}

inline std::uint8_t mixed(double below, double above, double opacity) {
  return to_byte((below + opacity * (above - below)) / 255);
}

// Whether the pixel is in the mask and a neighbour is not; the frame's border counts as outside.
inline bool on_outline(View<const std::uint8_t, 2> mask, std::int64_t y, std::int64_t x) {
  if (mask(y, x) == 0) return false;
  return y == 0 || x == 0 || y + 1 == mask.extent(0) || x + 1 == mask.extent(1) ||
         mask(y - 1, x) == 0 || mask(y + 1, x) == 0 || mask(y, x - 1) == 0 || mask(y, x + 1) == 0;
}

inline void check(View<std::uint8_t, 3> pixels, View<const std::uint8_t, 3> picture,
                  View<const std::uint8_t, 2> mask) {
  const auto [H, W] = mask.shape();
  LVGGT_CHECK((pixels.shape() == Shape{H, W, std::int64_t{3}}) && pixels.shape() == picture.shape(),
              "answer picture: pixels are ", pixels.shape(), ", the frame ", picture.shape(),
              " and the mask ", mask.shape());
}

}  // namespace heat_map_detail

// Relevancy over a frame: the frame pale and grey, coloured from blue to red where the relevancy is
// above neutral, and the mask outlined in white. Red is the frame's own maximum, at least 0.6, so
// that a phrase for which nothing stands out does not glow.
//   pixels, picture: [H, W, 3]   relevancy: [H, W], in [0, 1]   mask: [H, W], 0 or 1
inline void paint_heat_map(View<std::uint8_t, 3> pixels, View<const std::uint8_t, 3> picture,
                           View<const float, 2> relevancy, View<const std::uint8_t, 2> mask) {
  using namespace heat_map_detail;
  check(pixels, picture, mask);
  LVGGT_CHECK(relevancy.shape() == mask.shape(), "heat map: the relevancy is ", relevancy.shape(),
              " but the mask ", mask.shape());
  constexpr float kLeastMaximum = 0.6F;
  const auto [H, W] = mask.shape();
  float highest = kLeastMaximum;
  for (std::int64_t y = 0; y < H; ++y)
    for (std::int64_t x = 0; x < W; ++x) highest = std::max(highest, relevancy(y, x));
  for (std::int64_t y = 0; y < H; ++y) {
    for (std::int64_t x = 0; x < W; ++x) {
      const double heat = (relevancy(y, x) - kNeutralRelevancy) / (highest - kNeutralRelevancy);
      const double grey = 40 + 0.6 * grey_of(picture[y][x]);
      const Rgb8 color = rainbow(heat);
      const double opacity = heat > 0 ? 0.3 + 0.5 * std::min(heat, 1.0) : 0;
      for (std::int64_t c = 0; c < 3; ++c)
        pixels(y, x, c) = on_outline(mask, y, x)
                              ? std::uint8_t{255}
                              : mixed(grey, color[static_cast<std::size_t>(c)], opacity);
    }
  }
}

// An answer over a frame: what is in the mask keeps its brightness and takes the colour, the rest
// is grey.
//   pixels, picture: [H, W, 3]   mask: [H, W], 0 or 1
inline void paint_answer(View<std::uint8_t, 3> pixels, View<const std::uint8_t, 3> picture,
                         View<const std::uint8_t, 2> mask, const Rgb8& color = kAnswerColor) {
  using namespace heat_map_detail;
  check(pixels, picture, mask);
  const auto [H, W] = mask.shape();
  for (std::int64_t y = 0; y < H; ++y) {
    for (std::int64_t x = 0; x < W; ++x) {
      const double grey = grey_of(picture[y][x]);
      for (std::int64_t c = 0; c < 3; ++c)
        pixels(y, x, c) = mask(y, x) != 0
                              ? mixed(picture(y, x, c), color[static_cast<std::size_t>(c)], 0.6)
                              : mixed(grey, 255, 0.1);
    }
  }
}

}  // namespace lvggt
