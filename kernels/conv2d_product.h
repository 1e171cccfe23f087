// SPDX-License-Identifier: Apache-2.0
// Private: a convolution with weights that are packed already, forward or backward.
#pragma once

#include "kernels/product.h"
#include "lvggt/core/tensor.h"

namespace lvggt::kernels {

struct ConvGeometry {
  std::int64_t in_channels = 0;
  std::int64_t kernel = 0;
  std::int64_t stride = 0;
  std::int64_t padding = 0;
};

// conv2d_forward, whose checks are made here.
void run_conv2d(View<float, 4> y, View<const float, 4> x, const ConvGeometry& geometry,
                const PackedPanels& w, const Epilogue<4>& epilogue, Context& ctx);

}  // namespace lvggt::kernels
