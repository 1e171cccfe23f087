// SPDX-License-Identifier: Apache-2.0
// Attention over packed keys and values: a frame over itself, and over a cache of frames.
#include <cmath>
#include <vector>

#include "bench/peak.h"
#include "bench/shapes.h"
#include "lvggt/kernels/attention.h"

namespace {

using namespace lvggt;
using namespace lvggt::bench;

// The first output of the last head by its definition, so that a broken kernel is not timed.
void verify(View<const float, 3> y, View<const float, 3> q, View<const float, 3> k,
            View<const float, 3> v, float scale, double tolerance) {
  const std::int64_t Nk = k.extent(0), h = q.extent(1) - 1, D = q.extent(2);
  double sum = 0, weighted = 0;
  for (std::int64_t n = 0; n < Nk; ++n) {
    double score = 0;
    for (std::int64_t i = 0; i < D; ++i) score += static_cast<double>(q(0, h, i)) * k(n, h, i);
    const double weight = std::exp(scale * score);
    sum += weight;
    weighted += weight * v(n, h, 0);
  }
  LVGGT_CHECK(std::abs(y(0, h, 0) - weighted / sum) < tolerance, "bench_attention: y is ",
              y(0, h, 0), " but should be ", weighted / sum);
}

// Nk keys in groups of at most one frame's tokens, as the cache holds them.
void scaled_dot_product_attention(benchmark::State& state, Storage storage) {
  const std::int64_t Nq = state.range(0), Nk = state.range(1);
  Context ctx(static_cast<int>(state.range(2)));
  const auto q = random_tensor(Shape{Nq, kHeads, kHeadDim}, 1);
  const auto k = random_tensor(Shape{Nk, kHeads, kHeadDim}, 2);
  const auto v = random_tensor(Shape{Nk, kHeads, kHeadDim}, 3);
  std::vector<Tensor<std::byte, 1>> buffers;
  std::vector<PackedKeysValues> past;
  for (std::int64_t begin = 0; begin < Nk; begin += Nq) {
    const std::int64_t tokens = std::min(Nq, Nk - begin);
    buffers.emplace_back(Shape{keys_values_layout(storage, kHeads, tokens, kHeadDim).size});
    past.push_back({buffers.back().data(), storage, kHeads, tokens, kHeadDim});
    pack_keys_values(past.back(), k.view().narrow(0, begin, begin + tokens),
                     v.view().narrow(0, begin, begin + tokens), ctx);
  }
  Tensor<float, 3> y(q.shape());
  const float scale = 1 / std::sqrt(static_cast<float>(kHeadDim));
  lvggt::scaled_dot_product_attention(y, q, past, scale, ctx);
  verify(y, q, k, v, scale, storage == Storage::kF32 ? 1e-4 : 1e-2);
  run_against_peak(state, ctx, 4.0 * static_cast<double>(Nq * Nk * kHeads * kHeadDim),
                   [&] { lvggt::scaled_dot_product_attention(y, q, past, scale, ctx); });
}

void frames(benchmark::internal::Benchmark* b) {
  b->ArgNames({"Nq", "Nk", "threads"})->UseManualTime()->Unit(benchmark::kMillisecond);
  for (const std::int64_t frames : {1, 4, 16, 64}) b->Args({kTokens, frames * kTokens, 0});
  b->Args({kTokensSquare, kTokensSquare, 0});
  b->Args({kTokens, kTokens, 1});
}

BENCHMARK_CAPTURE(scaled_dot_product_attention, f32, Storage::kF32)->Apply(frames);
BENCHMARK_CAPTURE(scaled_dot_product_attention, bf16, Storage::kBf16)->Apply(frames);
BENCHMARK_CAPTURE(scaled_dot_product_attention, int8, Storage::kI8)->Apply(frames);

}  // namespace
