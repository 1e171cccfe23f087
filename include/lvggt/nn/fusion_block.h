// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>

#include "lvggt/kernels/elementwise.h"
#include "lvggt/kernels/interpolate.h"
#include "lvggt/nn/residual_conv_unit.h"

namespace lvggt {

// A feature fusion block of the DPT head.
struct FusionBlock {
  std::optional<ResidualConvUnit> res_conv_unit1;  // of the skip; the coarsest block has none
  ResidualConvUnit res_conv_unit2;
  Conv2d out_conv;  // 1x1
};

// y = resize(out_conv(resConfUnit2(x + resConfUnit1(skip)))), bilinear with align_corners. The
// reference resizes first; a 1x1 convolution and a bilinear resize commute, and this order
// convolves a quarter of the pixels.
//   y: [Ho, Wo, F]   x, skip: [H, W, F], skip empty for a block without resConfUnit1; both are
//   overwritten
inline void fusion_block_forward(View<float, 3> y, View<float, 3> x, View<float, 3> skip,
                                 const FusionBlock& block, Context& ctx) {
  LVGGT_CHECK(skip.empty() != block.res_conv_unit1.has_value(),
              "fusion_block: a skip and resConfUnit1 belong together");
  Arena::Scope scope(ctx.arena());
  const View<float, 3> scratch = ctx.arena().alloc(x.shape());
  if (skip) {
    LVGGT_CHECK(skip.shape() == x.shape(), "fusion_block: x is ", x.shape(), " but the skip is ",
                skip.shape());
    residual_conv_unit_forward(skip, scratch, *block.res_conv_unit1, ctx);
    add(pixel_rows(x), pixel_rows(x), pixel_rows(skip), ctx);
  }
  residual_conv_unit_forward(x, scratch, block.res_conv_unit2, ctx);
  conv2d_forward(scratch, x, block.out_conv, {}, ctx);
  bilinear_forward(batch_of_one(y), batch_of_one(View<const float, 3>(scratch)), true, ctx);
}

}  // namespace lvggt
