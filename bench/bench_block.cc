// SPDX-License-Identifier: Apache-2.0
// A whole transformer block of the aggregator: LayerNorm, qkv, qk-norm, RoPE, attention,
// projection, MLP, LayerScale.
#include <cmath>

#include "bench/peak.h"
#include "bench/shapes.h"
#include "lvggt/nn/block.h"

namespace {

using namespace lvggt;
using namespace lvggt::bench;

Linear random_linear(std::int64_t N, std::int64_t K, std::uint32_t seed, Storage storage) {
  auto weight = random_tensor(Shape{N, K}, seed);
  const float scale = 1 / std::sqrt(static_cast<float>(K));
  for (std::int64_t i = 0; i < weight.size(); ++i) weight.data()[i] *= scale;
  return {pack_linear(weight, storage), random_tensor(Shape{N}, seed + 1)};
}

LayerNorm unit_norm(std::int64_t C) {
  LayerNorm norm{Tensor<float, 1>(Shape{C}), Tensor<float, 1>(Shape{C}), 1e-5f};
  for (std::int64_t i = 0; i < C; ++i) norm.weight(i) = 1;
  return norm;
}

Block random_block(std::int64_t C, std::int64_t heads, Storage storage) {
  Block block;
  block.norm1 = unit_norm(C);
  block.norm2 = unit_norm(C);
  block.attn.qkv = random_linear(3 * C, C, 1, storage);
  block.attn.q_norm = unit_norm(C / heads);
  block.attn.k_norm = unit_norm(C / heads);
  block.attn.proj = random_linear(C, C, 3, storage);
  block.attn.num_heads = heads;
  block.mlp = {random_linear(4 * C, C, 5, storage), random_linear(C, 4 * C, 7, storage)};
  block.ls1 = Tensor<float, 1>(Shape{C});
  block.ls2 = Tensor<float, 1>(Shape{C});
  for (std::int64_t i = 0; i < C; ++i) block.ls1(i) = block.ls2(i) = 0.01f;
  return block;
}

// Patches of rows of 37, as at 518 pixels; the special tokens are at (0, 0).
RopeTable patch_positions(std::int64_t N) {
  Tensor<std::int64_t, 2> positions(Shape{N, std::int64_t{2}});
  for (std::int64_t i = 5; i < N; ++i) {
    positions(i, 0) = (i - 5) / 37 + 1;
    positions(i, 1) = (i - 5) % 37 + 1;
  }
  return make_rope_table(positions, kHeadDim, 100);
}

void block_forward(benchmark::State& state, Storage storage) {
  const std::int64_t N = state.range(0);
  Context ctx(static_cast<int>(state.range(1)));
  const Block block = random_block(kDim, kHeads, storage);
  const RopeTable rope = patch_positions(N);
  const auto attend = [&](View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                          View<const float, 3> v) { attend_within_groups(y, q, k, v, N, ctx); };
  auto x = random_tensor(Shape{N, kDim}, 9);
  const double flops = static_cast<double>(2 * N * kDim * 12 * kDim + 4 * N * N * kDim);
  run_against_peak(state, ctx, flops,
                   [&] { lvggt::block_forward(x, block, {.attend = attend, .rope = &rope}, ctx); });
  LVGGT_CHECK(std::isfinite(x(N - 1, kDim - 1)), "bench_block: the tokens are not finite");
}

void tokens(benchmark::internal::Benchmark* b) {
  b->ArgNames({"N", "threads"})->UseManualTime()->Unit(benchmark::kMillisecond);
  b->Args({kTokens, 0})->Args({kTokensSquare, 0})->Args({kTokens, 1});
}

BENCHMARK_CAPTURE(block_forward, f32, Storage::kF32)->Apply(tokens);
BENCHMARK_CAPTURE(block_forward, bf16, Storage::kBf16)->Apply(tokens);
BENCHMARK_CAPTURE(block_forward, int8, Storage::kI8)->Apply(tokens);

}  // namespace
