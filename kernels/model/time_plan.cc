// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/time_plan.h"

#include <algorithm>
#include <array>
#include <chrono>
#include <limits>
#include <map>
#include <span>
#include <tuple>
#include <utility>

#include "lvggt/model/deterministic_weights.h"
#include "lvggt/model/frame_flops.h"
#include "lvggt/nn/block.h"

namespace lvggt {
namespace {

using StorageOf = FunctionRef<Storage(const std::string& weight)>;

// Largest map of the convolution that is timed; larger ones run at the same rate.
constexpr std::int64_t kMapSide = 84;

// The shorter of two runs: the first also warms up.
template <class Work>
double seconds_of(const Work& work) {
  double best = std::numeric_limits<double>::max();
  for (int run = 0; run < 2; ++run) {
    const auto start = std::chrono::steady_clock::now();
    work();
    const std::chrono::duration<double> elapsed = std::chrono::steady_clock::now() - start;
    best = std::min(best, elapsed.count());
  }
  return best;
}

// Any numbers of about unit size: times do not depend on them.
template <int R>
Tensor<float, R> numbers(Shape<R> shape, Context& ctx) {
  Tensor<float, R> values(shape);
  const std::array<std::int64_t, 1> flat{values.size()};
  deterministic_values("camera_token", flat, 0,
                       std::span(values.data(), static_cast<std::size_t>(values.size())), ctx);
  return values;
}

Linear linear_of(std::int64_t N, std::int64_t K, Storage storage, Context& ctx) {
  return {pack_linear(numbers(Shape{N, K}, ctx), storage), numbers(Shape{N}, ctx)};
}

// qkv, proj, fc1, fc2.
using BlockStorage = std::array<Storage, 4>;

BlockStorage block_storage(StorageOf storage_of, const std::string& blocks) {
  const std::string block = blocks + ".0";
  return {storage_of(block + ".attn.qkv.weight"), storage_of(block + ".attn.proj.weight"),
          storage_of(block + ".mlp.fc1.weight"), storage_of(block + ".mlp.fc2.weight")};
}

double block_seconds(const ModelConfig& c, std::int64_t P, std::int64_t heads,
                     const BlockStorage& storage, Context& ctx) {
  const std::int64_t C = c.embed_dim, hidden = c.mlp_hidden(C);
  const auto norm = [&] {
    return LayerNorm{numbers(Shape{C}, ctx), numbers(Shape{C}, ctx), 1e-5f};
  };
  Block block;
  block.norm1 = norm();
  block.attn.qkv = linear_of(3 * C, C, storage[0], ctx);
  block.attn.proj = linear_of(C, C, storage[1], ctx);
  block.attn.num_heads = heads;
  block.ls1 = numbers(Shape{C}, ctx);
  block.norm2 = norm();
  block.mlp = {linear_of(hidden, C, storage[2], ctx), linear_of(C, hidden, storage[3], ctx)};
  block.ls2 = numbers(Shape{C}, ctx);
  Tensor<float, 2> x = numbers(Shape{P, C}, ctx);
  const auto attend = [&](View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                          View<const float, 3> v) { attend_within_groups(y, q, k, v, P, ctx); };
  return seconds_of([&] { block_forward(x, block, {.attend = attend}, ctx); });
}

// Attention of a frame over one cached frame.
double past_seconds(const ModelConfig& c, std::int64_t P, Storage cache, Context& ctx) {
  const std::int64_t heads = c.agg_heads, D = c.embed_dim / heads;
  const Tensor<float, 3> tokens = numbers(Shape{P, heads, D}, ctx);
  Tensor<float, 3> y(tokens.shape());
  Tensor<std::byte, 1> buffer(Shape{keys_values_layout(cache, heads, P, D).size});
  const PackedKeysValues past{buffer.data(), cache, heads, P, D};
  pack_keys_values(past, tokens, tokens, ctx);
  // What a query costs once is in the block already: the difference of two frames and one is left.
  const std::array<PackedKeysValues, 2> twice{past, past};
  const double one =
      seconds_of([&] { scaled_dot_product_attention(y, tokens, std::span(&past, 1), ctx); });
  const double two =
      seconds_of([&] { scaled_dot_product_attention(y, tokens, std::span(twice), ctx); });
  return std::max(two - one, one / 2);
}

// A 3x3 convolution of the dense heads, in floating-point operations a second.
double conv_rate(const ModelConfig& c, std::int64_t h, std::int64_t w, Storage storage,
                 Context& ctx) {
  const std::int64_t F = c.dpt_features;
  const std::int64_t H = std::min(4 * h, kMapSide), W = std::min(4 * w, kMapSide);
  const Conv2d conv{
      pack_conv2d(numbers(Shape{F, F, std::int64_t{3}, std::int64_t{3}}, ctx), 1, 1, storage),
      numbers(Shape{F}, ctx)};
  const Tensor<float, 3> x = numbers(Shape{H, W, F}, ctx);
  Tensor<float, 3> y(x.shape());
  const double seconds = seconds_of([&] { conv2d_forward(y, x, conv, {}, ctx); });
  return conv_flops(static_cast<double>(H * W), 9, static_cast<double>(F), static_cast<double>(F)) /
         seconds;
}

// The camera head's few tokens: its time is that of reading its weights in every iteration.
double camera_seconds(const ModelConfig& c, Storage storage, Context& ctx) {
  const std::int64_t C = 2 * c.embed_dim, hidden = c.mlp_hidden(C);
  const Linear fc1 = linear_of(hidden, C, storage, ctx);
  const Tensor<float, 2> x = numbers(Shape{std::int64_t{1}, C}, ctx);
  Tensor<float, 2> y(Shape{std::int64_t{1}, hidden});
  const double seconds = seconds_of([&] { linear_forward(y, x, fc1, {}, ctx); });
  const double block = static_cast<double>(4 * C + 2 * hidden) / static_cast<double>(hidden);
  const double modulation = 3.0 * static_cast<double>(C) / static_cast<double>(hidden);
  return static_cast<double>(c.cam_iterations) * seconds *
         (static_cast<double>(c.cam_trunk_depth) * block + modulation);
}

}  // namespace

TimePlan plan_time(const ModelConfig& c, std::int64_t H, std::int64_t W,
                   const StreamOptions& options, StorageOf storage_of, Context& ctx) {
  const std::int64_t h = H / c.patch_size, w = W / c.patch_size;
  const std::int64_t P = c.patch_start_idx() + h * w;
  std::map<std::pair<std::int64_t, BlockStorage>, double> measured;
  double seconds = 0;
  for (const auto& [blocks, depth, heads] :
       {std::tuple{"aggregator.patch_embed.blocks", c.dino_depth, c.dino_heads},
        std::tuple{"aggregator.frame_blocks", c.agg_depth, c.agg_heads},
        std::tuple{"aggregator.global_blocks", c.agg_depth, c.agg_heads}}) {
    const std::pair key(heads, block_storage(storage_of, blocks));
    if (!measured.contains(key)) measured[key] = block_seconds(c, P, heads, key.second, ctx);
    seconds += static_cast<double>(depth) * measured[key];
  }
  const FrameFlops flops = frame_flops(c, H, W, 1);
  const double dense =
      flops.depth * (options.points ? 2 : 1) + (options.decoder ? flops.decoder : 0);
  seconds += dense / conv_rate(c, h, w, storage_of("depth_head.scratch.output_conv1.weight"), ctx);
  seconds += camera_seconds(c, storage_of("camera_head.trunk.0.mlp.fc1.weight"), ctx);
  const double past =
      static_cast<double>(c.agg_depth) * past_seconds(c, P, options.cache_storage, ctx);
  return {seconds, seconds + static_cast<double>(options.max_past_frames) * past};
}

}  // namespace lvggt
