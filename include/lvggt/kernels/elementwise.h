// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// y = a + b.   y, a, b: [N, C], rows may be strided.   y may be a or b.
void add(View<float, 2> y, View<const float, 2> a, View<const float, 2> b, Context& ctx);

// dx += dx_other: the gradients of two consumers of x.   both: [N, C], rows may be strided.
inline void accumulate(View<float, 2> dx, View<const float, 2> dx_other, Context& ctx) {
  add(dx, dx, dx_other, ctx);
}

// y = gate * (x * (1 + scale) + shift) + t: the adaptive LayerNorm of the camera head.
//   all: [N, C], rows may be strided.   y may be x or t.
void modulate(View<float, 2> y, View<const float, 2> x, View<const float, 2> shift,
              View<const float, 2> scale, View<const float, 2> gate, View<const float, 2> t,
              Context& ctx);

// Rows copied between views with different strides.   y, x: [N, C]
void copy_rows(View<float, 2> y, View<const float, 2> x, Context& ctx);

// Channels last to planes and back.   planes: [C, H, W]   pixels: [H, W, C], pixels may be strided
void to_planes(View<float, 3> planes, View<const float, 3> pixels, Context& ctx);
void from_planes(View<float, 3> pixels, View<const float, 3> planes, Context& ctx);

// Index of the first element that is NaN or infinite, or -1.
std::int64_t find_nonfinite(View<const float, 1> x);

}  // namespace lvggt
