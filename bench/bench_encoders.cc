// SPDX-License-Identifier: Apache-2.0
// The encoders of phrases and pictures at their published sizes, with made-up weights: CLIP
// ViT-B/16's two towers, and the matrices of one of e5-mistral-7b's 32 layers in bf16.
#include <cmath>
#include <vector>

#include "bench/peak.h"
#include "bench/shapes.h"
#include "lvggt/core/float16.h"
#include "lvggt/kernels/stored_linear.h"
#include "lvggt/language/clip.h"

namespace {

using namespace lvggt;
using namespace lvggt::bench;

constexpr std::int64_t kMistralDim = 4096, kMistralKeys = 1024, kMistralHidden = 14336;

// Small enough that nothing overflows behind twelve blocks.
Tensor<float, 2> small_weight(std::int64_t N, std::int64_t K) {
  Tensor<float, 2> weight = random_tensor(Shape{N, K}, 5);
  const float scale = 1 / std::sqrt(static_cast<float>(K));
  for (std::int64_t i = 0; i < weight.size(); ++i) weight.data()[i] *= scale;
  return weight;
}
Linear layer(std::int64_t N, std::int64_t K) {
  return {pack_linear(small_weight(N, K)), Tensor<float, 1>(Shape{N})};
}
LayerNorm norm(std::int64_t C) {
  LayerNorm result{Tensor<float, 1>(Shape{C}), Tensor<float, 1>(Shape{C}), 1e-5f};
  for (std::int64_t c = 0; c < C; ++c) result.weight(c) = 1;
  return result;
}

ClipTransformer transformer(std::int64_t C, std::int64_t layers) {
  ClipTransformer result;
  for (std::int64_t i = 0; i < layers; ++i) {
    ClipBlock block;
    block.ln_1 = norm(C);
    block.ln_2 = norm(C);
    block.attn.qkv = layer(3 * C, C);
    block.attn.proj = layer(C, C);
    block.attn.num_heads = C / 64;
    block.mlp.fc1 = layer(4 * C, C);
    block.mlp.fc2 = layer(C, 4 * C);
    result.resblocks.push_back(std::move(block));
  }
  return result;
}

// Phrases of `words` words, one token each.
void clip_text(benchmark::State& state) {
  const std::int64_t n = state.range(0), words = state.range(1), C = 512;
  ClipText clip;
  clip.token_embedding = random_tensor(Shape{49408, C}, 1);
  clip.positional_embedding = random_tensor(Shape{77, C}, 2);
  clip.transformer = transformer(C, 12);
  clip.ln_final = norm(C);
  clip.text_projection.weight = pack_linear(small_weight(512, C));
  Tensor<std::int64_t, 2> tokens(Shape{n, std::int64_t{77}});
  for (std::int64_t i = 0; i < n; ++i) {
    tokens(i, 0) = 49406;
    for (std::int64_t w = 0; w < words; ++w) tokens(i, 1 + w) = (i * 31 + w) % 49406;
    tokens(i, 1 + words) = 49407;
  }
  Context ctx(static_cast<int>(state.range(2)));
  Tensor<float, 2> embeddings(Shape{n, std::int64_t{512}});
  // Products of a block: 3 + 1 + 8 C^2 multiply-adds a token.
  const double flops = 2.0 * 12 * 12 * static_cast<double>(n * (words + 2) * C * C);
  run_against_peak(state, ctx, flops,
                   [&] { clip_text_forward(embeddings, tokens, clip, nullptr, ctx); });
}

void clip_image(benchmark::State& state) {
  const std::int64_t n = state.range(0), C = 768;
  ClipImage clip;
  clip.conv1.weight = pack_conv2d(random_tensor(Shape{C, 3, 16, 16}, 1), 16, 0);
  clip.class_embedding = random_tensor(Shape{C}, 2);
  clip.positional_embedding = random_tensor(Shape{197, C}, 3);
  clip.ln_pre = norm(C);
  clip.transformer = transformer(C, 12);
  clip.ln_post = norm(C);
  clip.proj.weight = pack_linear(small_weight(512, C));
  clip.image_size = 224;
  const auto pixels =
      random_tensor(Shape{n, std::int64_t{224}, std::int64_t{224}, std::int64_t{3}}, 4);
  Context ctx(static_cast<int>(state.range(1)));
  Tensor<float, 2> embeddings(Shape{n, std::int64_t{512}});
  const double flops = 2.0 * 12 * 12 * static_cast<double>(n * 197 * C * C);
  run_against_peak(state, ctx, flops,
                   [&] { clip_image_forward(embeddings, pixels, clip, nullptr, ctx); });
}

// q, k, v, o, gate, up and down of one layer, 436 MB in bf16; times 32 for the model.
void mistral_layer(benchmark::State& state) {
  const std::int64_t M = state.range(0);
  struct Size {
    std::int64_t N, K;
  };
  const Size sizes[] = {{kMistralDim, kMistralDim},    {kMistralKeys, kMistralDim},
                        {kMistralKeys, kMistralDim},   {kMistralDim, kMistralDim},
                        {kMistralHidden, kMistralDim}, {kMistralHidden, kMistralDim},
                        {kMistralDim, kMistralHidden}};
  std::vector<std::vector<bfloat16>> weights;
  double flops = 0;
  for (const Size& size : sizes) {
    weights.emplace_back(static_cast<std::size_t>(size.N * size.K), to_bfloat16(0.01f));
    flops += 2.0 * static_cast<double>(M * size.N * size.K);
  }
  const auto x = random_tensor(Shape{M, kMistralHidden}, 1);
  Tensor<float, 2> y(Shape{M, kMistralHidden});
  Context ctx(static_cast<int>(state.range(1)));
  run_against_peak(state, ctx, flops, [&] {
    for (std::size_t i = 0; i < weights.size(); ++i) {
      const Size size = sizes[i];
      stored_linear_forward(
          y.view().narrow(1, 0, size.N), x.view().narrow(1, 0, size.K),
          {reinterpret_cast<const std::byte*>(weights[i].data()), Storage::kBf16, size.N, size.K},
          {}, ctx);
    }
  });
}

BENCHMARK(clip_text)
    ->ArgNames({"phrases", "words", "threads"})
    ->Args({1, 3, 0})
    ->Args({10, 3, 0})
    ->Args({1000, 3, 0})
    ->Args({1, 75, 0})
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);
BENCHMARK(clip_image)
    ->ArgNames({"pictures", "threads"})
    ->Args({1, 0})
    ->Args({10, 0})
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);
BENCHMARK(mistral_layer)
    ->ArgNames({"tokens", "threads"})
    ->Args({1, 0})
    ->Args({40, 0})
    ->Args({320, 0})
    ->UseManualTime()
    ->Unit(benchmark::kMillisecond);

}  // namespace
