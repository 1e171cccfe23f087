// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>

#include "lvggt/core/context.h"
#include "lvggt/train/parameter_store.h"

namespace lvggt {

struct AdamWOptions {
  double beta1 = 0.9;
  double beta2 = 0.95;
  double eps = 1e-8;
  double weight_decay = 1e-4;  // of parameters whose entry decays
};

// Euclidean norm of the whole gradient, in double, the same bits for any number of threads. NaN or
// infinity when the gradient is not finite.
double gradient_norm(const ParameterStore& store, Context& ctx);

// The first parameter whose gradient is not finite, or null.
const ParameterEntry* find_nonfinite_gradient(const ParameterStore& store);

// One AdamW step, number t = 1, 2, ..., with g = gradient_scale * gradient (clipping):
//   m = b1 m + (1 - b1) g    v = b2 v + (1 - b2) g^2
//   w = w (1 - lr decay) - lr (m / (1 - b1^t)) / (sqrt(v / (1 - b2^t)) + eps)
// All states are float32. With a running average: average = ema average + (1 - ema) w.
void adamw_step(ParameterStore& store, std::int64_t t, double learning_rate, double gradient_scale,
                double ema_decay, const AdamWOptions& options, Context& ctx);

}  // namespace lvggt
