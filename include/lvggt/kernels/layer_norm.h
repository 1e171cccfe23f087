// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// y = gamma * (x - mean) / sqrt(var + eps) + beta over the last axis; var is the population
// variance, by two passes. gamma and beta may be empty (no affine part).
//   y, x: [N, C]   gamma, beta: [C]   y may be x.
void layer_norm_forward(View<float, 2> y, View<const float, 2> x, View<const float, 1> gamma,
                        View<const float, 1> beta, float eps, Context& ctx);

// The same for every head of every token: the q/k norm.
//   y, x: [N, heads, D]   gamma, beta: [D]   y may be x.
void layer_norm_forward(View<float, 3> y, View<const float, 3> x, View<const float, 1> gamma,
                        View<const float, 1> beta, float eps, Context& ctx);

}  // namespace lvggt
