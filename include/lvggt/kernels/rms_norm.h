// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// y = gamma * x / sqrt(mean(x^2) + eps) over the last axis.
//   y, x: [N, C]   gamma: [C]   y may be x.
void rms_norm_forward(View<float, 2> y, View<const float, 2> x, View<const float, 1> gamma,
                      float eps, Context& ctx);

}  // namespace lvggt
