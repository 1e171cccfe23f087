// SPDX-License-Identifier: Apache-2.0
// The terms of the training objective and their gradients. A prediction a and a target b of shape
// [B, H, W, C] are both multiplied by the mask first, and every mean is over all elements, holes
// included. Values are summed in double, in an order that depends on the shape alone.
//   a, b, da: [B, H, W, C], rows and pixels may be strided
//   mask: [B, H, W], 1 where a pixel is labelled, 0 in a hole; empty: no holes
// A backward pass overwrites da with dloss times the gradient with respect to a; dloss is
// dL/d(value). The gradient with respect to b is that of the loss with a and b exchanged.
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// mean |m (a - b)|; the gradient is m sign(a - b) / size, 0 where a and b are equal.
double l1_loss_forward(View<const float, 4> a, View<const float, 4> b, View<const float, 3> mask,
                       Context& ctx);
void l1_loss_backward(View<float, 4> da, double dloss, View<const float, 4> a,
                      View<const float, 4> b, View<const float, 3> mask, Context& ctx);

// mean (m (a - b))^2; the gradient is 2 m^2 (a - b) / size.
double mse_loss_forward(View<const float, 4> a, View<const float, 4> b, View<const float, 3> mask,
                        Context& ctx);
void mse_loss_backward(View<float, 4> da, double dloss, View<const float, 4> a,
                       View<const float, 4> b, View<const float, 3> mask, Context& ctx);

// The axis along which a cosine takes its vectors: the features of a pixel (the paper's), or the
// pixels of a row of one feature (what the published training script does).
enum class CosineAxis { kChannels, kWidth };

// Vectors shorter than this, and those of holes, have no direction: their cosine is 0, and so is
// their gradient.
inline constexpr double kShortestDirection = 1e-8;

// 1 - mean cos(m a, m b). With u = m a, v = m b, and N vectors in all, the gradient is
//   da = -m / N (v / (|u| |v|) - cos u / |u|^2)
// Derivation: d(u.v / (|u| |v|)) / du = v / (|u| |v|) - (u.v) u / (|u|^3 |v|), and du/da = m.
double cosine_loss_forward(View<const float, 4> a, View<const float, 4> b,
                           View<const float, 3> mask, CosineAxis axis, Context& ctx);
void cosine_loss_backward(View<float, 4> da, double dloss, View<const float, 4> a,
                          View<const float, 4> b, View<const float, 3> mask, CosineAxis axis,
                          Context& ctx);

}  // namespace lvggt
