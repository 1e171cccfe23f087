// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/batch_norm2d.h"

#include <cmath>

namespace lvggt {

void batch_norm2d_fold(View<float, 4> weight, View<float, 1> bias, View<const float, 1> gamma,
                       View<const float, 1> beta, View<const float, 1> running_mean,
                       View<const float, 1> running_var, float eps) {
  const std::int64_t C = weight.extent(0);
  for (const View<const float, 1>& vector :
       {View<const float, 1>(bias), gamma, beta, running_mean, running_var})
    LVGGT_CHECK(vector.extent(0) == C, "batch_norm2d: weight is ", weight.shape(),
                " but a vector of its channels is ", vector.shape());
  for (std::int64_t c = 0; c < C; ++c) {
    // In double, so that the fold itself adds no more than one rounding to each value.
    const double scale = gamma[c] / std::sqrt(static_cast<double>(running_var[c]) + eps);
    for (std::int64_t i = 0; i < weight.extent(1); ++i)
      for (std::int64_t ky = 0; ky < weight.extent(2); ++ky)
        for (std::int64_t kx = 0; kx < weight.extent(3); ++kx)
          weight(c, i, ky, kx) = static_cast<float>(weight(c, i, ky, kx) * scale);
    bias[c] =
        static_cast<float>((static_cast<double>(bias[c]) - running_mean[c]) * scale + beta[c]);
  }
}

}  // namespace lvggt
