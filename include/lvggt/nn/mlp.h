// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/nn/params.h"

namespace lvggt {

struct Mlp {
  Linear fc1;  // [hidden, C]
  Linear fc2;  // [N, hidden]
};

// y = residual + gamma * fc2(gelu(fc1(x))); residual and gamma may be empty.
//   y: [M, N]   x: [M, C]   y may be residual, not x.
inline void mlp_forward(View<float, 2> y, View<const float, 2> x, const Mlp& mlp,
                        View<const float, 1> gamma, View<const float, 2> residual, Context& ctx) {
  Arena::Scope scope(ctx.arena());
  const View<float, 2> hidden = ctx.arena().alloc(Shape{x.extent(0), mlp.fc1.weight.N});
  linear_forward(hidden, x, mlp.fc1, {.activation = Activation::kGelu}, ctx);
  linear_forward(y, hidden, mlp.fc2, {.gamma = gamma, .residual = residual}, ctx);
}

}  // namespace lvggt
