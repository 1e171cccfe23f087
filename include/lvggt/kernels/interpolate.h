// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// Bilinear resize, channels last, as torch.nn.functional.interpolate(mode="bilinear"). Output i
// reads
//   align_corners true:   source coordinate i (in-1)/(out-1)
//   align_corners false:  source coordinate max((i + 1/2) in/out - 1/2, 0)
//   y: [B, Ho, Wo, C]   x: [B, H, W, C]
// Pixels may be strided: y can be a slice of a concatenated map.
void bilinear_forward(View<float, 4> y, View<const float, 4> x, bool align_corners, Context& ctx);

// Backward of bilinear_forward, its transpose: every output pixel hands dy back to the (up to) four
// input pixels it was blended from, with the same weights.
//   dx: [B, H, W, C]   dy: [B, Ho, Wo, C]; pixels of both may be strided
void bilinear_backward(View<float, 4> dx, View<const float, 4> dy, bool align_corners,
                       Context& ctx);

// Bicubic resize with antialiasing, channels last, as interpolate(mode="bicubic", antialias=True,
// align_corners=False): cubic with a = -1/2, its support widened by the scale when shrinking.
//   y: [H', W', C]   x: [H, W, C]
void bicubic_antialias_forward(View<float, 3> y, View<const float, 3> x, Context& ctx);

}  // namespace lvggt
