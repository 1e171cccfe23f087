// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/train/decoder_batch.h"
#include "lvggt/train/feature_extractor.h"
#include "lvggt/train/objective.h"
#include "lvggt/train/pixel_head.h"

namespace lvggt {

// The Semantic Bridging Decoder in training: losses of a batch and, if wanted, their gradients.
//
//   features = DPT(taps)
//   branch in (language, RGB):  encoded = UNet encoder(features)
//     head in the branch:         prediction = UNet decoder(encoded), loss(prediction, target)
//
// Every head is followed by its own backward pass before the next one runs, and a branch by its
// encoder's: the gradients of what they share are summed, and memory holds the activations of one
// head, one encoder and the DPT at a time.
template <class T>
struct DecoderStep {
  const BasicDecoderBatch<T>& batch;
  const DecoderParameters<const T>& parameters;
  const DecoderParameters<T>* gradients;  // null: losses and outputs only
  BasicDecoderOutputs<T> outputs;
  Objective objective;
  FrameShares shares;
  std::int64_t H = 0, W = 0;  // of the features: patch_size times the patch grid
  T ln_eps = 0;
};

// A map's levels: [B, levels, H, W, d] to level `l`, [B, H, W, d]
template <class T, int R>
View<T, R - 1> level_of(View<T, R> maps, std::int64_t l) {
  Shape<R - 1> shape;
  std::array<std::int64_t, R - 1> strides;
  for (int axis = 0; axis < R - 1; ++axis) {
    shape[axis] = maps.extent(axis == 0 ? 0 : axis + 1);
    strides[static_cast<std::size_t>(axis)] = maps.stride(axis == 0 ? 0 : axis + 1);
  }
  return View<T, R - 1>(maps.data() + l * maps.stride(1), shape, strides);
}

// Copies maps frame by frame; an empty y is not wanted.
template <class T>
void copy_frames(View<T, 4> y, ConstView<T, 4> x, Context& ctx) {
  if (y.empty()) return;
  for (std::int64_t b = 0; b < x.extent(0); ++b)
    copy_rows(batch_rows(y.narrow(0, b, b + 1)), batch_rows(x.narrow(0, b, b + 1)), ctx);
}

// One branch, forward and backward. loss(dy, terms, prediction, head index) adds a head's terms;
// names: of the encoder and of the heads in the checkpoint.
template <class T, class Loss>
void branch_step(SummedGradient<T>& dfeatures, LossTerms& terms, ConstView<T, 4> features,
                 const BranchParameters<const T>& parameters, const BranchParameters<T>* gradients,
                 Activation activation, std::int64_t channels, std::int64_t Ho, std::int64_t Wo,
                 const std::string& encoder_name, const std::vector<std::string>& head_names,
                 const Loss& loss, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  BranchActivations<T> branch{features, {}};
  BranchGradients<T> dbranch{dfeatures, {}};
  if (parameters.encoder) {
    const TimeInto time(pass.forward_seconds);
    unet_encoder_forward(branch.encoded, features, *parameters.encoder, pass);
    if (gradients != nullptr) dbranch.encoded = alloc_gradients(branch.encoded, ctx.arena());
  }
  const auto ready = [&](const std::string& name) {
    if (pass.gradients_ready) pass.gradients_ready(name + ".");
  };
  for (std::size_t i = 0; i < parameters.heads.size(); ++i) {
    Arena::Scope head_scope(ctx.arena());
    PixelHeadActivations<T> kept;
    View<T, 4> dy;
    {
      const TimeInto time(pass.forward_seconds);
      pixel_head_forward(kept, branch, parameters.heads[i], activation, channels, Ho, Wo, pass);
      if (gradients != nullptr) dy = ctx.arena().alloc<T>(kept.resized.shape());
      loss(dy, terms, kept.resized, i);
    }
    if (gradients == nullptr) continue;
    const TimeInto time(pass.backward_seconds);
    pixel_head_backward(dbranch, gradients->heads[i], dy, kept, parameters.heads[i], activation,
                        pass);
    ready(head_names[i]);
  }
  if (gradients == nullptr || !parameters.encoder) return;
  const TimeInto time(pass.backward_seconds);
  add_gradient(
      dfeatures,
      [&](View<T, 4> dx) {
        unet_encoder_backward(dx, *gradients->encoder, dbranch.encoded, branch.encoded,
                              *parameters.encoder, pass);
      },
      ctx);
  ready(encoder_name);
}

// Both branches: adds to terms, and sums the gradient of the features.
template <class T>
void branches_step(SummedGradient<T>& dfeatures, LossTerms& terms, ConstView<T, 4> features,
                   const DecoderStep<T>& step, const std::vector<std::string>& level_names,
                   TrainingPass& pass) {
  const BasicDecoderBatch<T>& batch = step.batch;
  const std::int64_t Ho = batch.height(), Wo = batch.width();
  const std::int64_t levels = batch.features.extent(1);
  branch_step(
      dfeatures, terms, features, step.parameters.language,
      step.gradients ? &step.gradients->language : nullptr, Activation::kNone,
      batch.features.extent(4), Ho, Wo, "lang_encoder", level_names,
      [&](View<T, 4> dy, LossTerms& sum, ConstView<T, 4> y, std::size_t i) {
        const auto level = static_cast<std::int64_t>(i);
        language_loss(dy, sum, y, level_of(batch.features, level), level_of(batch.mask, level),
                      step.shares, levels, step.objective, pass.ctx);
        if (step.outputs.language) copy_frames(level_of(step.outputs.language, level), y, pass.ctx);
      },
      pass);
  if (!step.parameters.rgb) return;
  branch_step(
      dfeatures, terms, features, *step.parameters.rgb,
      step.gradients ? &*step.gradients->rgb : nullptr, Activation::kSigmoid, 3, Ho, Wo,
      "rgb_encoder", {"rgb_decoder.0"},
      [&](View<T, 4> dy, LossTerms& sum, ConstView<T, 4> y, std::size_t) {
        rgb_loss(dy, sum, y, batch.images, step.shares, step.objective, pass.ctx);
        copy_frames(step.outputs.rgb, y, pass.ctx);
      },
      pass);
}

// Adds the batch's loss terms (unweighted) and gradients; dtaps, where not empty, receive those of
// the tokens.
template <class T>
void decoder_step(const TapGradients<T>& dtaps, LossTerms& terms, const DecoderStep<T>& step,
                  const std::vector<std::string>& level_names, TrainingPass& pass) {
  Context& ctx = pass.ctx;
  Arena::Scope scope(ctx.arena());
  const BasicDecoderBatch<T>& batch = step.batch;
  const auto* dpt = std::get_if<DptParameters<const T>>(&step.parameters.feature_extractor);
  const auto* projection =
      std::get_if<LinearParameters<const T>>(&step.parameters.feature_extractor);
  const std::int64_t F = dpt ? dpt->output_conv1.weight.extent(0) : projection->weight.extent(0);
  const Shape shape{batch.num_frames(), step.H, step.W, F};
  const View<T, 4> features = ctx.arena().alloc<T>(shape);
  SummedGradient<T> dfeatures;
  if (step.gradients) dfeatures.sum = ctx.arena().alloc<T>(shape);

  DptActivations<T> kept;
  const auto extract = [&] {
    const TimeInto time(pass.forward_seconds);
    if (dpt) {
      dpt_forward(features, kept, batch.taps, batch.h, batch.w, *dpt, step.ln_eps, pass);
    } else {
      projection_forward(features, batch.taps, batch.h, batch.w, *projection, pass);
    }
  };
  const bool again = pass.recompute && dpt && step.gradients;
  if (again) {
    Arena::Scope first(ctx.arena());
    extract();
  } else {
    extract();
  }
  branches_step(dfeatures, terms, features, step, level_names, pass);
  if (!step.gradients) return;
  if (again) extract();
  const TimeInto time(pass.backward_seconds);
  if (dpt) {
    dpt_backward(dtaps, std::get<DptParameters<T>>(step.gradients->feature_extractor),
                 dfeatures.sum, kept, *dpt, pass);
  } else {
    projection_backward(dtaps, std::get<LinearParameters<T>>(step.gradients->feature_extractor),
                        dfeatures.sum, batch.taps, batch.h, batch.w, *projection, pass);
  }
}

}  // namespace lvggt
