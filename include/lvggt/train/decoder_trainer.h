// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/model/config.h"
#include "lvggt/train/adamw.h"
#include "lvggt/train/communicator.h"
#include "lvggt/train/decoder_batch.h"
#include "lvggt/train/parameter_store.h"
#include "lvggt/train/schedule.h"
#include "lvggt/train/train_options.h"

namespace lvggt {

// Seconds spent in the parts of a step.
struct StepTimes {
  double forward = 0;  // with the losses
  double backward = 0;
  double optimiser = 0;  // norm, clipping, AdamW, average
};

struct StepReport {
  LossTerms loss;        // over the whole batch of all ranks, before the step
  double grad_norm = 0;  // before clipping
  double learning_rate = 0;
  std::int64_t labelled_pixels = 0;       // of all ranks and levels
  std::int64_t frames_without_label = 0;  // they contribute to the RGB loss only
  StepTimes times;
  // Why the step was not taken: "the loss term cos is nan", "the gradient of lang_encoder... is not
  // finite". Weights, moments, average and running statistics are as before; all ranks agree.
  std::optional<std::string> refused;
};

struct FrameShares;

// Trains the decoder: forward, losses, backward, clipping, AdamW, moving average. Deterministic:
// the same store and batches give the same bits for any number of threads.
class DecoderTrainer {
 public:
  // All are borrowed and outlive the trainer. Throws kUsage for options that make no sense.
  DecoderTrainer(ParameterStore& store, const TrainOptions& options, Communicator& communicator,
                 Context& ctx);

  // One optimisation step on this rank's frames. A loss or gradient that is not finite refuses the
  // step (see StepReport); shapes that do not fit the configuration are a kMismatch Error.
  StepReport step(const DecoderBatch& batch);

  // The losses of a batch with batch statistics and without a step; `outputs` receives the
  // predictions. When `gradients` is set, the store's gradients are those of the total loss, summed
  // over the ranks and not clipped, and dtaps (if not empty) those of the tokens.
  LossTerms evaluate(const DecoderBatch& batch, const DecoderOutputs& outputs, bool gradients,
                     const std::array<View<float, 3>, 4>& dtaps = {});

  // Predictions with running statistics, as in inference. `averaged`: of the moving average.
  void predict(const DecoderOutputs& outputs, const DecoderBatch& batch, bool averaged = false);

  // Steps taken; decides the learning rate and AdamW's bias correction.
  std::int64_t steps() const { return steps_; }
  // Goes on after that many steps, with a store that was restored.
  void resume_at(std::int64_t steps) { steps_ = steps; }

  // Makes the running statistics that the last evaluate() saw the store's, as step() does.
  void commit_statistics();

  const TrainOptions& options() const { return options_; }

 private:
  LossTerms run(const DecoderBatch& batch, const FrameShares& shares, const DecoderOutputs& outputs,
                bool gradients, const std::array<View<float, 3>, 4>& dtaps, StepTimes& times);

  ParameterStore& store_;
  TrainOptions options_;
  Communicator& communicator_;
  Context& ctx_;
  std::vector<std::string> level_names_;
  Tensor<float, 1> running_;  // running statistics as the last pass moved them
  std::int64_t steps_ = 0;
};

// Memory that training needs, in bytes; `total` is the sum.
struct TrainingMemory {
  std::size_t parameters = 0;   // weights, gradients, moments, average, running statistics
  std::size_t activations = 0;  // scratch of the largest step (the context's arena)
  std::size_t batch = 0;        // taps and targets of one batch
  std::size_t total = 0;
};

// What steps on `batch_size` frames of h x w patches and targets of H x W pixels need, without
// allocating anything; within a tenth of the measured memory.
TrainingMemory plan_training(const ModelConfig& config, const TrainOptions& options,
                             std::int64_t batch_size, std::int64_t h, std::int64_t w,
                             std::int64_t H, std::int64_t W);

}  // namespace lvggt
