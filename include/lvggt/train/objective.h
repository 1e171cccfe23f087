// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/kernels/loss.h"
#include "lvggt/train/layers.h"
#include "lvggt/train/train_options.h"

namespace lvggt {

// L = w.l1 mean|m (S^ - S)| + w.cos (1 - mean cos(m S^, m S))
//     + w.img_l1 mean|I^ - I| + w.img_l2 mean (I^ - I)^2
struct Objective {
  LossWeights weights;
  CosineAxis axis = CosineAxis::kChannels;
};

inline Objective objective_of(const TrainOptions& options) {
  return {options.loss, options.cosine_over_width ? CosineAxis::kWidth : CosineAxis::kChannels};
}

// Adds the language terms of one level to `terms`, times share: the part that these frames and this
// level have in the mean. dy (empty: not wanted) receives the gradient of the weighted terms.
//   dy, y, target: [B, H, W, d]   mask: [B, H, W]
inline void language_loss(View<float, 4> dy, LossTerms& terms, View<const float, 4> y,
                          View<const float, 4> target, View<const float, 3> mask, double share,
                          const Objective& objective, Context& ctx) {
  terms.l1 += share * l1_loss_forward(y, target, mask, ctx);
  terms.cos += share * cosine_loss_forward(y, target, mask, objective.axis, ctx);
  if (dy.empty()) return;
  Arena::Scope scope(ctx.arena());
  const View<float, 4> dcos = ctx.arena().alloc(dy.shape());
  l1_loss_backward(dy, share * objective.weights.l1, y, target, mask, ctx);
  cosine_loss_backward(dcos, share * objective.weights.cos, y, target, mask, objective.axis, ctx);
  accumulate(batch_rows(dy), batch_rows(dcos), ctx);
}

// The same for the RGB terms.   dy, y, target: [B, H, W, 3]
inline void rgb_loss(View<float, 4> dy, LossTerms& terms, View<const float, 4> y,
                     View<const float, 4> target, double share, const Objective& objective,
                     Context& ctx) {
  terms.img_l1 += share * l1_loss_forward(y, target, {}, ctx);
  terms.img_l2 += share * mse_loss_forward(y, target, {}, ctx);
  if (dy.empty()) return;
  Arena::Scope scope(ctx.arena());
  const View<float, 4> dmse = ctx.arena().alloc(dy.shape());
  l1_loss_backward(dy, share * objective.weights.img_l1, y, target, {}, ctx);
  mse_loss_backward(dmse, share * objective.weights.img_l2, y, target, {}, ctx);
  accumulate(batch_rows(dy), batch_rows(dmse), ctx);
}

// Fills in the weighted sum.
inline void add_up(LossTerms& terms, const LossWeights& weights) {
  terms.total = weights.l1 * terms.l1 + weights.cos * terms.cos + weights.img_l1 * terms.img_l1 +
                weights.img_l2 * terms.img_l2;
}

}  // namespace lvggt
