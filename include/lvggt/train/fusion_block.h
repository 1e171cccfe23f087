// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/train/decoder_parameters.h"
#include "lvggt/train/layers.h"

namespace lvggt {

template <class T>
struct ResidualConvUnitActivations {
  View<T, 4> x;       // rectified   [B, H, W, F], the caller's
  View<T, 4> hidden;  // relu(conv1(relu(x)))
};

// y = conv2(relu(conv1(r))) + r with r = relu(x), which takes x's place.
// The skip is relu(x), not x: the reference activates in place before adding.
template <class T>
void residual_conv_unit_forward(View<T, 4> y, ResidualConvUnitActivations<T>& kept, View<T, 4> x,
                                const ResidualConvUnitParameters<const T>& unit,
                                TrainingPass& pass) {
  kept.x = x;
  kept.hidden = pass.ctx.arena().alloc<T>(x.shape());
  activation_forward(batch_rows(x), batch_rows(x), Activation::kRelu, pass.ctx);
  conv2d_forward(kept.hidden, x, unit.conv1, Activation::kRelu, {}, pass.ctx);
  conv2d_forward(y, kept.hidden, unit.conv2, Activation::kNone, x, pass.ctx);
}

// With h = relu(conv1(r)): dr = conv1'(relu'(conv2'(dy))) + dy, dx = dr where x > 0.
template <class T>
void residual_conv_unit_backward(View<T, 4> dx, const ResidualConvUnitParameters<T>& gradient,
                                 ConstView<T, 4> dy, const ResidualConvUnitActivations<T>& kept,
                                 const ResidualConvUnitParameters<const T>& unit,
                                 TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  const View<T, 4> dhidden = ctx.arena().alloc<T>(kept.hidden.shape());
  conv2d_backward(dhidden, gradient.conv2, dy, kept.hidden, unit.conv2, ctx);
  relu_backward(batch_rows(dhidden), batch_rows(dhidden), batch_rows(kept.hidden), ctx);
  conv2d_backward(dx, gradient.conv1, dhidden, kept.x, unit.conv1, ctx);
  accumulate(batch_rows(dx), batch_rows(dy), ctx);
  relu_backward(batch_rows(dx), batch_rows(dx), batch_rows(kept.x), ctx);
}

template <class T>
struct FusionBlockActivations {
  ResidualConvUnitActivations<T> unit1, unit2;
  View<T, 4> refined;  // what out_conv reads   [B, H, W, F]
};

// y = resize(out_conv(resConfUnit2(x + resConfUnit1(skip)))), bilinear with align_corners; a 1x1
// convolution and a bilinear resize commute.
//   y: [B, Ho, Wo, F]   x, skip: [B, H, W, F], skip empty without resConfUnit1; both are
//   overwritten
template <class T>
void fusion_block_forward(View<T, 4> y, FusionBlockActivations<T>& kept, View<T, 4> x,
                          View<T, 4> skip, const FusionBlockParameters<const T>& block,
                          TrainingPass& pass) {
  Context& ctx = pass.ctx;
  LVGGT_CHECK(skip.empty() != block.res_conv_unit1.has_value(),
              "fusion_block: a skip and resConfUnit1 belong together");
  if (skip) {
    const View<T, 4> refined_skip = ctx.arena().alloc<T>(x.shape());
    residual_conv_unit_forward(refined_skip, kept.unit1, skip, *block.res_conv_unit1, pass);
    accumulate(batch_rows(x), batch_rows(refined_skip), ctx);
    kept.refined = refined_skip;  // its values are in x now
  } else {
    kept.refined = ctx.arena().alloc<T>(x.shape());
  }
  residual_conv_unit_forward(kept.refined, kept.unit2, x, block.res_conv_unit2, pass);
  Arena::Scope scope(ctx.arena());
  const View<T, 4> projected = ctx.arena().alloc<T>(x.shape());
  linear_forward(batch_rows(projected), batch_rows(kept.refined), block.out_conv, Activation::kNone,
                 ctx);
  bilinear_forward(y, projected, true, ctx);
}

// dskip: empty without resConfUnit1
template <class T>
void fusion_block_backward(View<T, 4> dx, View<T, 4> dskip,
                           const FusionBlockParameters<T>& gradient, ConstView<T, 4> dy,
                           const FusionBlockActivations<T>& kept,
                           const FusionBlockParameters<const T>& block, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  const View<T, 4> dprojected = ctx.arena().alloc<T>(kept.refined.shape());
  const View<T, 4> drefined = ctx.arena().alloc<T>(kept.refined.shape());
  bilinear_backward(dprojected, dy, true, ctx);
  linear_backward(batch_rows(drefined), gradient.out_conv, batch_rows(dprojected),
                  batch_rows(kept.refined), block.out_conv, ctx);
  residual_conv_unit_backward(dx, gradient.res_conv_unit2, drefined, kept.unit2,
                              block.res_conv_unit2, pass);
  if (dskip)
    residual_conv_unit_backward(dskip, *gradient.res_conv_unit1, dx, kept.unit1,
                                *block.res_conv_unit1, pass);
}

}  // namespace lvggt
