// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/kernels/epilogue.h"

namespace lvggt {

// Folds a batch norm with running statistics into the convolution before it, at load:
//   scale = gamma / sqrt(running_var + eps);  weight *= scale (per output channel)
//   bias = (bias - running_mean) * scale + beta
//   weight: [Cout, Cin, k, k]   all others: [Cout]
void batch_norm2d_fold(View<float, 4> weight, View<float, 1> bias, View<const float, 1> gamma,
                       View<const float, 1> beta, View<const float, 1> running_mean,
                       View<const float, 1> running_var, float eps);

// Training: a batch norm over all pixels of a batch, with an activation behind it (kNone or kRelu)
// in the same pass.
//   n = (x - mean) rstd     y = activation(gamma n + beta)
//   y, x: [B, H, W, C], rows and pixels may be strided   all vectors: [C]
// mean and rstd = 1 / sqrt(var + eps) are the batch's, kept for backward; var is the population
// variance. The running statistics move towards the batch's, the variance by its unbiased estimate;
// both may be empty:
//   running_mean += momentum (mean - running_mean)
//   running_var  += momentum (var count / (count - 1) - running_var)
// A batch of one value a channel has no variance and is refused, as by the reference.   y may be x.
void batch_norm2d_forward(View<float, 4> y, View<float, 1> mean, View<float, 1> rstd,
                          View<float, 1> running_mean, View<float, 1> running_var,
                          View<const float, 4> x, View<const float, 1> gamma,
                          View<const float, 1> beta, float eps, float momentum,
                          Activation activation, Context& ctx);

// The backward pass of it. With g = dy where the activation passed it on (y > 0), else 0, and avg
// over all pixels of the batch:
//   dx      = gamma rstd (g - avg(g) - n avg(g n))
//   dgamma += sum(g n)     dbeta += sum(g)
// y is not read: gamma n + beta is computed again, by the same instructions as in the forward pass.
//   dx, dy, x: [B, H, W, C]   all vectors: [C]
// An empty dx, dgamma or dbeta is not wanted; dx may be dy.
//
// Derivation: as for layer_norm, dn/dx = rstd (I - 1/N - n n^T / N) for the N values of a channel.
void batch_norm2d_backward(View<float, 4> dx, View<float, 1> dgamma, View<float, 1> dbeta,
                           View<const float, 4> dy, View<const float, 1> mean,
                           View<const float, 1> rstd, View<const float, 4> x,
                           View<const float, 1> gamma, View<const float, 1> beta,
                           Activation activation, Context& ctx);

// The same in steps, for a batch that is spread over several processes: what they compute is added
// up between the steps.
//
//   batch_norm2d_sums                 sums and count to be added up over the processes
//   batch_norm2d_statistics           mean, rstd and running statistics of the whole batch
//   batch_norm2d_normalize            y

// sums[0] = sum(x - pivot), sums[1] = sum((x - pivot)^2), in double.   sums: [2, C]   pivot: [C]
// The pivot is any value near the data that all processes share, such as the running mean: squares
// are taken of deviations from it, so that a large common offset does not drown the variance. An
// empty pivot means 0.
void batch_norm2d_sums(View<double, 2> sums, View<const float, 4> x, View<const float, 1> pivot,
                       Context& ctx);

// count: values a channel that the sums were taken of, at least 2.   All vectors: [C]; the running
// statistics may be empty, running_mean may be the pivot.
void batch_norm2d_statistics(View<float, 1> mean, View<float, 1> rstd, View<float, 1> running_mean,
                             View<float, 1> running_var, View<const double, 2> sums,
                             View<const float, 1> pivot, std::int64_t count, float eps,
                             float momentum);

// y = activation(gamma (x - mean) rstd + beta) with given statistics: the last step above, and the
// whole forward pass with frozen statistics.   y may be x.
void batch_norm2d_normalize(View<float, 4> y, View<const float, 4> x, View<const float, 1> mean,
                            View<const float, 1> rstd, View<const float, 1> gamma,
                            View<const float, 1> beta, Activation activation, Context& ctx);

// rstd = 1 / sqrt(var + eps), for frozen statistics.   rstd, var: [C]
void batch_norm2d_rstd(View<float, 1> rstd, View<const float, 1> var, float eps);

//   batch_norm2d_backward_sums        sums to be added up over the processes
//   batch_norm2d_backward_parameters  dgamma, dbeta, from a process's own sums
//   batch_norm2d_backward_input       dx, from the sums over all processes

// sums[0] = sum(g), sums[1] = sum(g n), in double.   sums: [2, C]
void batch_norm2d_backward_sums(View<double, 2> sums, View<const float, 4> dy,
                                View<const float, 1> mean, View<const float, 1> rstd,
                                View<const float, 4> x, View<const float, 1> gamma,
                                View<const float, 1> beta, Activation activation, Context& ctx);

// dgamma += sums[1], dbeta += sums[0]; either may be empty.   Also with frozen statistics.
void batch_norm2d_backward_parameters(View<float, 1> dgamma, View<float, 1> dbeta,
                                      View<const double, 2> sums);

// dx = gamma rstd (g - sums[0] / count - n sums[1] / count). With frozen statistics, sums is empty
// and dx = gamma rstd g.   dx may be dy.
void batch_norm2d_backward_input(View<float, 4> dx, View<const float, 4> dy,
                                 View<const double, 2> sums, std::int64_t count,
                                 View<const float, 1> mean, View<const float, 1> rstd,
                                 View<const float, 4> x, View<const float, 1> gamma,
                                 View<const float, 1> beta, Activation activation, Context& ctx);

}  // namespace lvggt
