// SPDX-License-Identifier: Apache-2.0
// Private: 3x3 convolutions with 2.25 times fewer multiplications (Lavin and Gray, Fast Algorithms
// for Convolutional Neural Networks, 2015: F(2x2, 3x3)).
#pragma once

#include "kernels/conv2d_product.h"

namespace lvggt::kernels {

// Whether a convolution is computed this way: 3x3, stride 1, padding 1, with enough channels that
// the products outweigh the transforms, and enough pixels that they outweigh transforming the
// weights for each call. Depends on one picture's shape alone, so that a batch gives the bits of
// its pictures one by one.
bool winograd_pays(const Shape<4>& x, const ConvGeometry& geometry, std::int64_t out_channels);

// run_conv2d for what winograd_pays() accepts; shapes are checked by the caller.
void run_winograd(View<float, 4> y, View<const float, 4> x, const PackedPanels& w,
                  const Epilogue<4>& epilogue, Context& ctx);

}  // namespace lvggt::kernels
