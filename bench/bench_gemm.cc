// SPDX-License-Identifier: Apache-2.0
// The matrix products of a transformer block with their fused epilogues.
#include <cmath>

#include "bench/peak.h"
#include "bench/shapes.h"
#include "lvggt/kernels/linear.h"

namespace {

using namespace lvggt;
using namespace lvggt::bench;

// Two output elements by their definition, to within what the storage rounds, so that a broken
// kernel is not timed.
void verify(View<const float, 2> y, View<const float, 2> x, View<const float, 2> w,
            View<const float, 1> bias, double tolerance) {
  for (const std::int64_t m : {std::int64_t{0}, x.extent(0) - 1}) {
    const std::int64_t n = w.extent(0) - 1;
    double sum = bias[n];
    for (std::int64_t k = 0; k < x.extent(1); ++k) sum += static_cast<double>(x(m, k)) * w(n, k);
    LVGGT_CHECK(std::abs(y(m, n) - sum) < tolerance, "bench_gemm: y is ", y(m, n),
                " but should be ", sum);
  }
}

void linear_forward(benchmark::State& state, Storage storage) {
  const std::int64_t M = state.range(0), N = state.range(1), K = state.range(2);
  Context ctx(static_cast<int>(state.range(3)));
  const auto x = random_tensor(Shape{M, K}, 1);
  const auto weight = random_tensor(Shape{N, K}, 2);
  const auto bias = random_tensor(Shape{N}, 3);
  const PackedMatrix w = pack_linear(weight, storage);
  Tensor<float, 2> y(Shape{M, N});
  lvggt::linear_forward(y, x, w, {.bias = bias}, ctx);
  verify(y, x, weight, bias, storage == Storage::kF32 ? 1e-3 : 1.0);
  // fc1 is the layer with the GELU.
  const Activation activation = N == 4 * K ? Activation::kGelu : Activation::kNone;
  run_against_peak(state, ctx, 2.0 * static_cast<double>(M * N * K), [&] {
    lvggt::linear_forward(y, x, w, {.bias = bias, .activation = activation}, ctx);
  });
}

void block_shapes(benchmark::internal::Benchmark* b) {
  b->ArgNames({"M", "N", "K", "threads"});
  for (const std::int64_t M : {kTokens, kTokensSquare}) {
    b->Args({M, 3 * kDim, kDim, 0});
    b->Args({M, kDim, kDim, 0});
    b->Args({M, 4 * kDim, kDim, 0});
    b->Args({M, kDim, 4 * kDim, 0});
  }
  b->Args({kTokens, kDim, kDim, 1});
  b->Args({kTokens, 4 * kDim, kDim, 1});
  b->Args({kTokens, kDim, 4 * kDim, 1});
  b->Args({1, 6 * kDim, 2 * kDim, 0});  // the camera head's qkv for one token
}

BENCHMARK_CAPTURE(linear_forward, f32, Storage::kF32)
    ->Apply(block_shapes)
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(linear_forward, bf16, Storage::kBf16)
    ->Apply(block_shapes)
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(linear_forward, f16, Storage::kF16)
    ->Apply(block_shapes)
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);
BENCHMARK_CAPTURE(linear_forward, int8, Storage::kI8)
    ->Apply(block_shapes)
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);

}  // namespace
