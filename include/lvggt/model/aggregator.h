// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <vector>

#include "lvggt/kernels/elementwise.h"
#include "lvggt/model/kv_cache.h"
#include "lvggt/model/stage_times.h"
#include "lvggt/nn/vision_transformer.h"

namespace lvggt {

// Alternating attention over the tokens of a video: frame blocks inside of each frame, global
// blocks across frames.
struct Aggregator {
  VisionTransformer patch_embed;    // DINOv2
  Tensor<float, 2> camera_token;    // [2, C]: of the first frame, of every later one
  Tensor<float, 3> register_token;  // [2, R, C]
  std::vector<Block> frame_blocks;
  std::vector<Block> global_blocks;
  std::array<std::int64_t, 4> taps;  // layers that the dense heads read
  float rope_freq = 0;

  std::int64_t embed_dim() const { return camera_token.extent(1); }
  std::int64_t patch_start_idx() const { return 1 + register_token.extent(1); }
};

// What depends on the size of the frames only, made once.
struct FrameGeometry {
  std::int64_t H = 0, W = 0;   // pixels
  std::int64_t h = 0, w = 0;   // patches
  RopeTable rope;              // [P, ...]
  Tensor<float, 2> pos_embed;  // [1 + h*w, C], of the encoder

  std::int64_t num_tokens(const Aggregator& a) const { return a.patch_start_idx() + h * w; }
};

inline FrameGeometry make_frame_geometry(const Aggregator& aggregator, std::int64_t H,
                                         std::int64_t W, Context& ctx) {
  const std::int64_t patch = aggregator.patch_embed.patch_embed.proj.weight.kernel;
  LVGGT_CHECK(H >= patch && W >= patch && H % patch == 0 && W % patch == 0,
              "aggregator: a frame of ", W, " x ", H, " pixels is not made of whole patches of ",
              patch, " x ", patch);
  FrameGeometry geometry{H, W, H / patch, W / patch, {}, {}};
  const std::int64_t start = aggregator.patch_start_idx();
  // Special tokens are at (0, 0), patches at (row + 1, column + 1); the frame's index plays no
  // part.
  Tensor<std::int64_t, 2> positions(Shape{geometry.num_tokens(aggregator), std::int64_t{2}});
  for (std::int64_t i = 0; i < geometry.h * geometry.w; ++i) {
    positions(start + i, 0) = i / geometry.w + 1;
    positions(start + i, 1) = i % geometry.w + 1;
  }
  const std::int64_t head_dim =
      aggregator.embed_dim() / aggregator.frame_blocks.front().attn.num_heads;
  geometry.rope = make_rope_table(positions, head_dim, aggregator.rope_freq);
  const VisionTransformer& vit = aggregator.patch_embed;
  geometry.pos_embed = Tensor<float, 2>(Shape{1 + geometry.h * geometry.w, aggregator.embed_dim()});
  Arena::Scope scope(ctx.arena());
  resize_pos_embed(geometry.pos_embed, vit.pos_embed, geometry.h, geometry.w, vit.pos_embed_side,
                   ctx);
  return geometry;
}

// Outputs of the aggregator for S frames of P tokens: only what the heads read.
struct AggregatedTokens {
  std::array<View<float, 2>, 4>
      taps;               // [S*P, 2C]: after the tap's frame block | after its global block
  View<float, 2> camera;  // [S, 2C], camera tokens of the last layer
};

inline AggregatedTokens alloc_aggregated_tokens(const Aggregator& aggregator, std::int64_t S,
                                                std::int64_t P, Context& ctx) {
  AggregatedTokens out;
  const std::int64_t width = 2 * aggregator.embed_dim();
  for (auto& tap : out.taps) tap = ctx.arena().alloc(Shape{S * P, width});
  out.camera = ctx.arena().alloc(Shape{S, width});
  return out;
}

// The tokens that enter the first frame block: camera, registers, patches.
//   tokens: [P, C]   pixels: [H, W, 3]   frame_idx: 0 for the very first frame of the video
inline void embed_frame(View<float, 2> tokens, View<const float, 3> pixels,
                        const Aggregator& aggregator, std::int64_t frame_idx,
                        const FrameGeometry& geometry, Observer* observer, Context& ctx) {
  const std::int64_t C = aggregator.embed_dim(), start = aggregator.patch_start_idx();
  const std::int64_t which = frame_idx == 0 ? 0 : 1;
  std::copy_n(aggregator.camera_token.data() + which * C, C, tokens.data());
  std::copy_n(aggregator.register_token.data() + which * (start - 1) * C, (start - 1) * C,
              tokens.data() + C);
  vision_transformer_forward(tokens.narrow(0, start, tokens.extent(0)), pixels,
                             aggregator.patch_embed, geometry.pos_embed, observer, ctx);
}

// How the global block of `layer` lets tokens see each other; see Attend for the rest.
using GlobalAttend = FunctionRef<void(std::int64_t layer, View<float, 3> y, View<const float, 3> q,
                                      View<const float, 3> k, View<const float, 3> v)>;

// Writes the tokens after a frame block (half 0) or global block (half 1) to the outputs that want
// them.
inline void keep_tokens(AggregatedTokens& out, View<const float, 2> tokens,
                        const Aggregator& aggregator, std::int64_t layer, std::int64_t half,
                        Context& ctx) {
  const std::int64_t C = tokens.extent(1), S = out.camera.extent(0);
  for (std::size_t i = 0; i < 4; ++i)
    if (aggregator.taps[i] == layer)
      copy_rows(out.taps[i].narrow(1, half * C, (half + 1) * C), tokens, ctx);
  if (layer + 1 == static_cast<std::int64_t>(aggregator.frame_blocks.size())) {
    const std::int64_t P = tokens.extent(0) / S;
    const View<const float, 2> camera(tokens.data(), Shape{S, C}, {P * C, 1});
    copy_rows(out.camera.narrow(1, half * C, (half + 1) * C), camera, ctx);
  }
}

// All frame and global blocks over the tokens of S frames, in place.   tokens: [S*P, C], dense
// The observer sees every "agg.frame_block" and "agg.global_block", and the global blocks' "qkv".
inline void alternating_attention(AggregatedTokens out, View<float, 2> tokens,
                                  const Aggregator& aggregator, const FrameGeometry& geometry,
                                  GlobalAttend attend_globally, StageTimes& times,
                                  Observer* observer, Context& ctx) {
  const std::int64_t P = geometry.num_tokens(aggregator);
  const auto num_layers = static_cast<std::int64_t>(aggregator.frame_blocks.size());
  const auto attend_in_frame = [&](View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                                   View<const float, 3> v) {
    attend_within_groups(y, q, k, v, P, ctx);
  };
  for (std::int64_t layer = 0; layer < num_layers; ++layer) {
    const auto i = static_cast<std::size_t>(layer);
    {
      const StageTimer timer(times.frame_blocks);
      block_forward(tokens, aggregator.frame_blocks[i],
                    {.attend = attend_in_frame, .rope = &geometry.rope}, ctx);
      keep_tokens(out, tokens, aggregator, layer, 0, ctx);
    }
    if (observer) observer->observe("agg.frame_block", layer, tokens);
    {
      const StageTimer timer(times.global_blocks);
      const auto attend = [&](View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                              View<const float, 3> v) { attend_globally(layer, y, q, k, v); };
      block_forward(
          tokens, aggregator.global_blocks[i],
          {.attend = attend, .rope = &geometry.rope, .observer = observer, .block_idx = layer},
          ctx);
      keep_tokens(out, tokens, aggregator, layer, 1, ctx);
    }
    if (observer) observer->observe("agg.global_block", layer, tokens);
  }
}

// Stream: the frame attends to itself and to the cached frames. The caller ends the cache's frame.
inline void aggregate_streamed(AggregatedTokens out, View<float, 2> tokens,
                               const Aggregator& aggregator, const FrameGeometry& geometry,
                               KvCache& cache, StageTimes& times, Observer* observer,
                               Context& ctx) {
  const auto attend = [&](std::int64_t layer, View<float, 3> y, View<const float, 3> q,
                          View<const float, 3> k, View<const float, 3> v) {
    cache.append(layer, k, v, ctx);
    scaled_dot_product_attention(y, q, cache.attended(layer), ctx);
  };
  alternating_attention(out, tokens, aggregator, geometry, attend, times, observer, ctx);
}

// How all frames of a clip, given at once, see each other.
enum class BatchMode {
  kCausal,         // StreamVGGT: a token sees all tokens of its own and of earlier frames
  kBidirectional,  // VGGT: every token sees every token
};

// Attention of S frames of P tokens each in one of the batch modes.   y, q, k, v: [S*P, heads, D]
inline void attend_across_frames(View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                                 View<const float, 3> v, std::int64_t S, BatchMode mode,
                                 Context& ctx) {
  const auto [N, heads, D] = q.shape();
  const std::int64_t P = N / S;
  Arena::Scope scope(ctx.arena());
  const View<PackedKeysValues, 1> groups = ctx.arena().alloc<PackedKeysValues>(Shape{S});
  for (std::int64_t s = 0; s < S; ++s) {
    groups[s] = alloc_keys_values(heads, P, D, ctx);
    pack_keys_values(groups[s], k.narrow(0, s * P, (s + 1) * P), v.narrow(0, s * P, (s + 1) * P),
                     ctx);
  }
  const std::span<const PackedKeysValues> all(groups.data(), static_cast<std::size_t>(S));
  if (mode == BatchMode::kBidirectional) {
    scaled_dot_product_attention(y, q, all, ctx);
    return;
  }
  for (std::int64_t s = 0; s < S; ++s)
    scaled_dot_product_attention(y.narrow(0, s * P, (s + 1) * P), q.narrow(0, s * P, (s + 1) * P),
                                 all.first(static_cast<std::size_t>(s) + 1), ctx);
}

// Batch: S frames at once.   tokens: [S*P, C]
inline void aggregate_batch(AggregatedTokens out, View<float, 2> tokens,
                            const Aggregator& aggregator, const FrameGeometry& geometry,
                            BatchMode mode, StageTimes& times, Observer* observer, Context& ctx) {
  const std::int64_t S = out.camera.extent(0);
  const auto attend = [&](std::int64_t, View<float, 3> y, View<const float, 3> q,
                          View<const float, 3> k, View<const float, 3> v) {
    attend_across_frames(y, q, k, v, S, mode, ctx);
  };
  alternating_attention(out, tokens, aggregator, geometry, attend, times, observer, ctx);
}

}  // namespace lvggt
