// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/tensor.h"

namespace lvggt {

// Folds a batch norm with running statistics into the convolution before it, at load:
//   scale = gamma / sqrt(running_var + eps);  weight *= scale (per output channel)
//   bias = (bias - running_mean) * scale + beta
//   weight: [Cout, Cin, k, k]   all others: [Cout]
void batch_norm2d_fold(View<float, 4> weight, View<float, 1> bias, View<const float, 1> gamma,
                       View<const float, 1> beta, View<const float, 1> running_mean,
                       View<const float, 1> running_var, float eps);

}  // namespace lvggt
