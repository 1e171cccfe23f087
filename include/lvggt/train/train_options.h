// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>

#include "lvggt/train/adamw.h"
#include "lvggt/train/schedule.h"

namespace lvggt {

// L = l1 + cos + img_l1 + img_l2, each with its weight: the published alpha = beta = 1.
struct LossWeights {
  double l1 = 0.2;      // mean |m (S^ - S)|
  double cos = 0.01;    // 1 - mean cosine of m S^ and m S
  double img_l1 = 0.5;  // mean |I^ - I|
  double img_l2 = 0.5;  // mean (I^ - I)^2
};

// Values of the terms, unweighted, and their weighted sum. Means are over all elements, holes
// included (a hole's cosine is 0), of all frames; those of the language terms leave out frames
// without any labelled pixel.
struct LossTerms {
  double l1 = 0, cos = 0, img_l1 = 0, img_l2 = 0;
  double total = 0;
};

// What is kept from the forward pass for the backward pass.
enum class CheckpointActivations {
  kKeep,       // everything
  kRecompute,  // inputs and statistics of each stage; what lies between is computed again
};

struct TrainOptions {
  LossWeights loss;
  // The cosine over the image's width instead of the feature axis, as the released training script
  // computes it; for comparison only.
  bool cosine_over_width = false;
  AdamWOptions adamw;
  double max_grad_norm = 1.0;  // global norm the gradient is clipped to; 0: no clipping
  Schedule schedule;
  double ema_decay = 0;  // of the moving average, below 1; needs a store that has it. 0: none
  CheckpointActivations activations = CheckpointActivations::kKeep;
  // A batch is processed in that many parts, one after the other, their gradients added. Memory
  // shrinks with it, but batch norms then see the statistics of one part only.
  std::int64_t accumulate = 1;
  // Batch norms use the running statistics and leave them alone.
  bool frozen_batch_norm = false;
  // Batch statistics over the frames of all ranks; false: each rank its own, like the release.
  bool synchronise_batch_norm = true;
  // Called with the losses and the gradient's norm of every finite step; a sentence it returns
  // refuses the step. All ranks see the same numbers and must answer alike.
  std::function<std::optional<std::string>(const LossTerms& loss, double grad_norm)> judge;
};

}  // namespace lvggt
