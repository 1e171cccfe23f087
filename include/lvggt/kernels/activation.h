// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/kernels/epilogue.h"

namespace lvggt {

// y = activation(x), element by element:
//   relu    max(x, 0)
//   gelu    x/2 (1 + erf(x / sqrt 2))
//   silu    x / (1 + exp(-x))
//   sigmoid 1 / (1 + exp(-x))
//   y, x: [N, C], rows may be strided.   y may be x.   NaN stays NaN.
void activation_forward(View<float, 2> y, View<const float, 2> x, Activation activation,
                        Context& ctx);

// Backward of the activations: dx = dy activation'(x). ReLU and sigmoid are read off their output,
// GELU and SiLU need their input.
//   relu     dx = dy where y > 0, else 0
//   sigmoid  dx = dy y (1 - y)
//   gelu     dx = dy (Phi(x) + x phi(x)), Phi and phi the normal distribution and its density
//   silu     dx = dy s (1 + x (1 - s)), s = sigmoid(x)
//   all: [N, C], rows may be strided.   dx may be dy.
void relu_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> y,
                   Context& ctx);
void sigmoid_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> y,
                      Context& ctx);
void gelu_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> x,
                   Context& ctx);
void silu_backward(View<float, 2> dx, View<const float, 2> dy, View<const float, 2> x,
                   Context& ctx);

// Depth heads: depth = exp(x[:,0]), confidence = 1 + exp(x[:,1]).
//   x: [N, 2]   depth, confidence: [N]
void depth_activation(View<float, 1> depth, View<float, 1> confidence, View<const float, 2> x,
                      Context& ctx);

// Point heads: point = sign(v) expm1(|v|) of the first three channels,
// confidence = 1 + exp(x[:,3]).
//   x: [N, 4]   points: [N, 3]   confidence: [N]
void point_activation(View<float, 2> points, View<float, 1> confidence, View<const float, 2> x,
                      Context& ctx);

}  // namespace lvggt
