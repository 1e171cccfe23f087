// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>
#include <utility>

#include "lvggt/core/tensor.h"

namespace lvggt::detail {

// One of the eight ways to lay a picture down: first the transposition, then the mirrorings.
struct Orientation {
  bool transpose = false;
  bool flip_x = false;
  bool flip_y = false;
};

// How to show a picture with the EXIF orientation 1 to 8 upright.
inline Orientation from_exif(int orientation) {
  return {orientation >= 5,
          orientation == 2 || orientation == 3 || orientation == 6 || orientation == 7,
          orientation == 3 || orientation == 4 || orientation == 7 || orientation == 8};
}

inline constexpr Orientation kQuarterTurnCcw{true, false, true};

inline Tensor<std::uint8_t, 3> reoriented(View<const std::uint8_t, 3> pixels, Orientation to) {
  const std::int64_t H = to.transpose ? pixels.extent(1) : pixels.extent(0);
  const std::int64_t W = to.transpose ? pixels.extent(0) : pixels.extent(1);
  const std::int64_t C = pixels.extent(2);
  Tensor<std::uint8_t, 3> result(Shape{H, W, C});
  for (std::int64_t y = 0; y < H; ++y) {
    const std::int64_t from_y = to.flip_y ? H - 1 - y : y;
    std::uint8_t* out = result.data() + y * W * C;
    for (std::int64_t x = 0; x < W; ++x, out += C) {
      const std::int64_t from_x = to.flip_x ? W - 1 - x : x;
      const std::uint8_t* in =
          to.transpose ? pixels.data() + from_x * pixels.stride(0) + from_y * pixels.stride(1)
                       : pixels.data() + from_y * pixels.stride(0) + from_x * pixels.stride(1);
      std::copy_n(in, C, out);
    }
  }
  return result;
}

}  // namespace lvggt::detail
