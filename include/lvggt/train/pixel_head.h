// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <variant>

#include "lvggt/train/unet.h"

namespace lvggt {

// The ablation of a UNet: y = activation(fc2(relu(fc1(features)))), pixel by pixel.
template <class T>
struct MlpHeadActivations {
  View<const T, 4> features;  // [B, H, W, F], the caller's
  View<T, 4> hidden;          // [B, H, W, 4 hidden]
};

template <class T>
void mlp_head_forward(View<T, 4> y, MlpHeadActivations<T>& kept, ConstView<T, 4> features,
                      const MlpHeadParameters<const T>& head, Activation activation,
                      TrainingPass& pass) {
  const auto [B, H, W, F] = features.shape();
  kept.features = features;
  kept.hidden = pass.ctx.arena().alloc<T>(Shape{B, H, W, head.fc1.weight.extent(0)});
  linear_forward(batch_rows(kept.hidden), batch_rows(features), head.fc1, Activation::kRelu,
                 pass.ctx);
  linear_forward(batch_rows(y), batch_rows(ConstView<T, 4>(kept.hidden)), head.fc2, activation,
                 pass.ctx);
}

// dy: of fc2's sums, before the activation
template <class T>
void mlp_head_backward(View<T, 4> dfeatures, const MlpHeadParameters<T>& gradient,
                       ConstView<T, 4> dy, const MlpHeadActivations<T>& kept,
                       const MlpHeadParameters<const T>& head, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  const View<T, 2> dhidden = batch_rows(ctx.arena().alloc<T>(kept.hidden.shape()));
  const View<T, 2> hidden = batch_rows(kept.hidden);
  linear_backward(dhidden, gradient.fc2, batch_rows(dy), hidden, head.fc2, ctx);
  relu_backward(dhidden, dhidden, hidden, ctx);
  linear_backward(batch_rows(dfeatures), gradient.fc1, dhidden, batch_rows(kept.features), head.fc1,
                  ctx);
}

// A head's prediction at the features' size and, if that is another, at the targets' size.
template <class T>
struct PixelHeadActivations {
  std::variant<UNetDecoderActivations<T>, MlpHeadActivations<T>> head;
  View<T, 4> predicted;  // [B, H, W, d]
  View<T, 4> resized;    // [B, Ho, Wo, d]; predicted itself when the sizes agree
};

// What the heads of a branch read.
template <class T>
struct BranchActivations {
  View<const T, 4> features;          // [B, H, W, F], the caller's
  UNetEncoderActivations<T> encoded;  // without maps for MLP heads
};

// Gradients of what the heads read.
template <class T>
struct BranchGradients {
  SummedGradient<T>& features;  // MLP heads add to it; an encoder's backward pass does it once
  UNetEncoderGradients<T> encoded;
};

// kept.resized: [B, Ho, Wo, d], semantics linear, colours through a sigmoid
template <class T>
void pixel_head_forward(PixelHeadActivations<T>& kept, const BranchActivations<T>& branch,
                        const PixelHeadParameters<const T>& head, Activation activation,
                        std::int64_t channels, std::int64_t Ho, std::int64_t Wo,
                        TrainingPass& pass) {
  Arena& arena = pass.ctx.arena();
  const auto [B, H, W, F] = branch.features.shape();
  kept.resized = kept.predicted = arena.alloc<T>(Shape{B, H, W, channels});
  if (const auto* unet = std::get_if<UNetDecoderParameters<const T>>(&head)) {
    unet_decoder_forward(kept.predicted, kept.head.template emplace<UNetDecoderActivations<T>>(),
                         branch.encoded, *unet, activation, pass);
  } else {
    mlp_head_forward(kept.predicted, kept.head.template emplace<MlpHeadActivations<T>>(),
                     branch.features, std::get<MlpHeadParameters<const T>>(head), activation, pass);
  }
  if (Ho == H && Wo == W) return;
  kept.resized = arena.alloc<T>(Shape{B, Ho, Wo, channels});
  bilinear_forward(kept.resized, kept.predicted, false, pass.ctx);
}

// dy: [B, Ho, Wo, d], overwritten
template <class T>
void pixel_head_backward(BranchGradients<T>& dbranch, const PixelHeadParameters<T>& gradient,
                         View<T, 4> dy, const PixelHeadActivations<T>& kept,
                         const PixelHeadParameters<const T>& head, Activation activation,
                         TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  View<T, 4> dsum = dy;
  if (kept.resized.data() != kept.predicted.data()) {
    dsum = ctx.arena().alloc<T>(kept.predicted.shape());
    bilinear_backward(dsum, dy, false, ctx);
  }
  if (activation == Activation::kSigmoid)
    sigmoid_backward(batch_rows(dsum), batch_rows(dsum), batch_rows(kept.predicted), ctx);
  if (const auto* unet = std::get_if<UNetDecoderParameters<const T>>(&head)) {
    unet_decoder_backward(dbranch.encoded, std::get<UNetDecoderParameters<T>>(gradient), dsum,
                          std::get<UNetDecoderActivations<T>>(kept.head), *unet, pass);
    return;
  }
  add_gradient(
      dbranch.features,
      [&](View<T, 4> dfeatures) {
        mlp_head_backward(dfeatures, std::get<MlpHeadParameters<T>>(gradient), dsum,
                          std::get<MlpHeadActivations<T>>(kept.head),
                          std::get<MlpHeadParameters<const T>>(head), pass);
      },
      ctx);
}

}  // namespace lvggt
