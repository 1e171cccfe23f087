// SPDX-License-Identifier: Apache-2.0
// Private: what the passes of a batch norm over a row of pixels are given.
#pragma once

#include <cstdint>

namespace lvggt::kernels {

// A row of pixels of every map that a pass reads or writes; unused ones are null.
struct BatchNormRow {
  float* out;  // y or dx
  std::int64_t out_step;
  const float* dy;
  std::int64_t dy_step;
  const float* x;
  std::int64_t x_step;
  std::int64_t W;
};

// What every pass knows of the channels, [C] each.
struct BatchNormChannels {
  const float* mean;
  const float* rstd;
  const float* scale;  // gamma rstd
  const float* beta;
  const float* avg_g;   // null with frozen statistics
  const float* avg_gn;  // null with frozen statistics
  std::int64_t C;
};

}  // namespace lvggt::kernels
