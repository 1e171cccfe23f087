// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/language/autoencoder.h"
#include "lvggt/train/adamw.h"
#include "lvggt/train/layer_parameters.h"
#include "lvggt/train/parameter_store.h"

namespace lvggt {

// How an autoencoder is trained; the published recipe of the CLIP one by default. The dynamic one
// takes cosine_weight 1e-2 and learning_rate 7e-5.
struct AutoencoderTrainOptions {
  double cosine_weight = 1e-3;  // c
  double learning_rate = 7e-4;
  AdamWOptions adam = {.beta1 = 0.9, .beta2 = 0.999, .eps = 1e-8, .weight_decay = 0};
  float bn_eps = 1e-5F, bn_momentum = 0.1F;
};

// The terms of the loss of N rows x and what they come back as, y:
//   l2 = mean over all elements of (y - x)^2     cos = 1 - mean over the rows of the cosine of y, x
struct AutoencoderLoss {
  double l2 = 0, cos = 0;
  double total(double cosine_weight) const { return l2 + cosine_weight * cos; }
};

// The loss of given rows; a row without length has the cosine 0.   y, x: [N, D]
AutoencoderLoss autoencoder_loss(View<const float, 2> y, View<const float, 2> x, Context& ctx);

// The same, and dy = its gradient with respect to y, l2 + cosine_weight cos.   dy, y, x: [N, D]
AutoencoderLoss autoencoder_loss_backward(View<float, 2> dy, View<const float, 2> y,
                                          View<const float, 2> x, double cosine_weight,
                                          Context& ctx);

// Backward of y = x / |x|: dx = (dy - y <y, dy>) / |x|, row by row, 0 where x has no length.
//   dx, dy, y: [N, C]   length: [N], |x|   dx may be dy.
void normalise_rows_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> y,
                             View<const float, 1> length, Context& ctx);

// The parameters of one part, with T = const float the weights, with T = float their gradients.
// Biases right before a batch norm cancel out and have no gradient.
template <class T>
struct AutoencoderParameters {
  std::vector<LinearParameters<T>> encoder, decoder;
  std::vector<BatchNormParameters<T>> norms;  // between the encoder's layers
};

// Trains an autoencoder: forward and backward passes by hand, Adam. The same store and batches give
// the same bits for any number of threads.
class AutoencoderTrainer {
 public:
  // store: of autoencoder_tensors(shape), borrowed. Errors: kMismatch for another store, kUsage for
  // options out of range.
  AutoencoderTrainer(ParameterStore& store, const AutoencoderShape& shape,
                     const AutoencoderTrainOptions& options, Context& ctx);

  // One step on a batch of at least 2 rows: forward with batch statistics, backward, Adam. Returns
  // the loss before the step. Errors: kNumeric, naming the tensor, when the loss or a gradient is
  // not finite; the weights then are as before, the running statistics are not.   x: [N, D]
  AutoencoderLoss step(View<const float, 2> x);

  // The loss of a batch with batch statistics, which moves the running ones; fills the store's
  // gradients. codes and decoded, if not empty, receive the outputs.
  //   codes: [N, d]   decoded: [N, D]   x: [N, D]
  AutoencoderLoss gradients(View<float, 2> codes, View<float, 2> decoded, View<const float, 2> x);

  // As it is now, for inference and evaluation.
  Autoencoder autoencoder() const;

  std::int64_t steps() const { return steps_; }
  void resume_at(std::int64_t steps) { steps_ = steps; }

 private:
  struct Kept;
  void forward(Kept& kept, View<const float, 2> x);
  void encode(Kept& kept, View<const float, 2> x);
  void backward(Kept& kept, View<float, 2> ddecoded, View<const float, 2> x);
  View<float, 2> decoder_backward(Kept& kept, View<float, 2> ddecoded);

  ParameterStore& store_;
  AutoencoderShape shape_;
  AutoencoderTrainOptions options_;
  Context& ctx_;
  AutoencoderParameters<const float> weights_;
  AutoencoderParameters<float> gradients_;
  std::int64_t steps_ = 0;
};

// Mean loss of rows under an autoencoder in evaluation mode, tile by tile.   x: [N, D], N >= 1
AutoencoderLoss evaluate_autoencoder(const Autoencoder& autoencoder, View<const float, 2> x,
                                     Context& ctx);

// Bytes that training a shape with batches of that many rows needs: parameters with gradients and
// moments, and scratch.
std::size_t plan_autoencoder(const AutoencoderShape& shape, std::int64_t batch);

}  // namespace lvggt
