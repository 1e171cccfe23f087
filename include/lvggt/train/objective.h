// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <span>

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

// Which part each frame of a batch has in the means over all frames of the step, on all ranks.
struct FrameShares {
  double rgb = 1;       // 1 / frames
  double language = 1;  // 1 / (frames with a labelled pixel)
  std::span<const std::int64_t>
      labelled_pixels;  // of each frame: one without has no language terms
};

// Adds the language terms of one level to `terms`; levels: how many there are. dy (empty: not
// wanted) receives the gradient of the weighted terms.
//   dy, y, target: [B, H, W, d]   mask: [B, H, W]
template <class T>
void language_loss(View<T, 4> dy, LossTerms& terms, ConstView<T, 4> y, ConstView<T, 4> target,
                   ConstView<T, 3> mask, const FrameShares& shares, std::int64_t levels,
                   const Objective& objective, Context& ctx) {
  const double share = shares.language / static_cast<double>(levels);
  Arena::Scope scope(ctx.arena());
  const Shape one{std::int64_t{1}, y.extent(1), y.extent(2), y.extent(3)};
  const View<T, 4> dcos = dy ? ctx.arena().alloc<T>(one) : View<T, 4>();
  for (std::int64_t b = 0; b < y.extent(0); ++b) {
    const auto frame = [b](auto view) { return view.narrow(0, b, b + 1); };
    if (shares.labelled_pixels[static_cast<std::size_t>(b)] == 0) {
      if (dy) std::fill_n(frame(dy).data(), one.volume(), T{0});
      continue;
    }
    const View<const T, 4> a = frame(y), t = frame(target);
    const View<const T, 3> m = frame(mask);
    terms.l1 += share * l1_loss_forward(a, t, m, ctx);
    terms.cos += share * cosine_loss_forward(a, t, m, objective.axis, ctx);
    if (dy.empty()) continue;
    l1_loss_backward(frame(dy), share * objective.weights.l1, a, t, m, ctx);
    cosine_loss_backward(dcos, share * objective.weights.cos, a, t, m, objective.axis, ctx);
    accumulate(batch_rows(frame(dy)), batch_rows(ConstView<T, 4>(dcos)), ctx);
  }
}

// The same for the RGB terms.   dy, y, target: [B, H, W, 3]
template <class T>
void rgb_loss(View<T, 4> dy, LossTerms& terms, ConstView<T, 4> y, ConstView<T, 4> target,
              const FrameShares& shares, const Objective& objective, Context& ctx) {
  const double share = shares.rgb * static_cast<double>(y.extent(0));
  terms.img_l1 += share * l1_loss_forward(y, target, {}, ctx);
  terms.img_l2 += share * mse_loss_forward(y, target, {}, ctx);
  if (dy.empty()) return;
  Arena::Scope scope(ctx.arena());
  const View<T, 4> dmse = ctx.arena().alloc<T>(dy.shape());
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
