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

// The same, keeping what the backward pass needs.   mean, rstd: [N]; rstd = 1 / sqrt(var + eps)
void layer_norm_forward(View<float, 2> y, View<float, 1> mean, View<float, 1> rstd,
                        View<const float, 2> x, View<const float, 1> gamma,
                        View<const float, 1> beta, float eps, Context& ctx);

// With n = (x - mean) rstd and g = gamma dy:
//   dx      = rstd (g - avg(g) - n avg(g n))     avg over C
//   dgamma += sum(dy n)     dbeta += sum(dy)     sum over N
//   dx, dy, x: [N, C]   dgamma, dbeta, gamma: [C]; gamma empty without affine part   mean, rstd:
//   [N]
// An empty dx, dgamma or dbeta is not wanted; dx may be dy.
//
// Derivation: dn/dx = rstd (I - 1/C - n n^T / C), since dmean/dx = 1/C and drstd/dx = -rstd^2 n /
// C; the matrix is symmetric, so dx is that matrix times g.
void layer_norm_backward(View<float, 2> dx, View<float, 1> dgamma, View<float, 1> dbeta,
                         View<const float, 2> dy, View<const float, 1> mean,
                         View<const float, 1> rstd, View<const float, 2> x,
                         View<const float, 1> gamma, Context& ctx);

}  // namespace lvggt
