// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// The pictures of single objects that CLIP sees when features are made, as 4DLangSplat cuts them.

// One object of a label map and its box. As published the box is max - min of the object's pixels:
// the last column and row are cut off, and an object one pixel wide or high is dropped.
struct ObjectBox {
  std::int32_t label = 0;
  std::int64_t x = 0, y = 0, width = 0, height = 0;

  bool dropped() const { return width == 0 || height == 0; }
};

// The objects of a map, by ascending label; 0 and below is background. Dropped ones are listed.
//   labels: [H, W]
std::vector<ObjectBox> find_objects(View<const std::int32_t, 2> labels);

// The object's box with everything outside of the object black, in the middle of a black square as
// long as its longer side l: floor((l - w) / 2) columns on the left, the rest on the right; rows
// likewise. Refused (kMismatch) for a dropped object.
//   result: [l, l, 3]   rgb: [H, W, 3]   labels: [H, W]
Tensor<std::uint8_t, 3> object_crop(View<const std::uint8_t, 3> rgb,
                                    View<const std::int32_t, 2> labels, const ObjectBox& box);

// A square resized as OpenCV's 8-bit linear resize does it, bit by bit: fixed point with 11-bit
// weights, no antialiasing; exactly twice the size is averaged over 2 x 2.
//   out: [S, S, 3]   in: [l, l, 3]
void resize_linear_u8(View<std::uint8_t, 3> out, View<const std::uint8_t, 3> in);

// out = (in / 255 - mean) / deviation, with CLIP's.   out, in: [S, S, 3]
void clip_normalize(View<float, 3> out, View<const std::uint8_t, 3> in);

// All of the above for several objects of one picture.   pixels: [n, S, S, 3]
void clip_object_pixels(View<float, 4> pixels, View<const std::uint8_t, 3> rgb,
                        View<const std::int32_t, 2> labels, const std::vector<ObjectBox>& boxes,
                        Context& ctx);

}  // namespace lvggt
