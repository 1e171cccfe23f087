// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <vector>

#include "lvggt/geometry/camera.h"
#include "lvggt/kernels/activation.h"
#include "lvggt/kernels/elementwise.h"
#include "lvggt/model/aggregator.h"

namespace lvggt {

// Iterative pose refinement with adaLN modulation, on the camera tokens of the last layer (width D
// = 2C).
struct CameraHead {
  LayerNorm token_norm;                // [D]
  Tensor<float, 2> empty_pose_tokens;  // [1, 9]
  Linear embed_pose;                   // [D, 9]
  Linear pose_ln_modulation;           // [3D, D]: shift, scale, gate
  LayerNorm adaln_norm;                // without affine part
  std::vector<Block> trunk;
  LayerNorm trunk_norm;  // [D]
  Mlp pose_branch;       // D -> D/2 -> 9
  std::int64_t num_iterations = 0;
};

// How the trunk's blocks let camera tokens see each other, by iteration and block.
using CameraAttend =
    FunctionRef<void(std::int64_t iteration, std::int64_t block, View<float, 3> y,
                     View<const float, 3> q, View<const float, 3> k, View<const float, 3> v)>;

// x = gate * (adaln_norm(t) * (1 + scale) + shift) + t, modulated by the encoding so far.
//   x, t: [S, D]   encoding: [S, 9]
inline void modulate_pose_tokens(View<float, 2> x, View<const float, 2> t,
                                 View<const float, 2> encoding, const CameraHead& head,
                                 Context& ctx) {
  const auto [S, D] = t.shape();
  Arena::Scope scope(ctx.arena());
  const View<float, 2> embedded = ctx.arena().alloc(Shape{S, D});
  linear_forward(embedded, encoding, head.embed_pose, {.activation = Activation::kSilu}, ctx);
  const View<float, 2> modulation = ctx.arena().alloc(Shape{S, 3 * D});
  linear_forward(modulation, embedded, head.pose_ln_modulation, {}, ctx);
  layer_norm_forward(x, t, head.adaln_norm, ctx);
  modulate(x, x, modulation.narrow(1, 0, D), modulation.narrow(1, D, 2 * D),
           modulation.narrow(1, 2 * D, 3 * D), t, ctx);
}

// pose_encodings: [iterations, S, 9], after every iteration, the last entries (fields of view)
// rectified camera_tokens: [S, D]
inline void camera_head_forward(View<float, 3> pose_encodings, View<const float, 2> camera_tokens,
                                const CameraHead& head, CameraAttend attend_trunk, Context& ctx) {
  const auto [S, D] = camera_tokens.shape();
  Arena::Scope scope(ctx.arena());
  const View<float, 2> t = ctx.arena().alloc(Shape{S, D});
  layer_norm_forward(t, camera_tokens, head.token_norm, ctx);
  const View<float, 2> x = ctx.arena().alloc(Shape{S, D});
  const View<float, 2> sum = ctx.arena().alloc(Shape{S, kPoseEncodingSize});  // not activated
  for (std::int64_t s = 0; s < S; ++s)
    std::copy_n(head.empty_pose_tokens.data(), kPoseEncodingSize, sum[s].data());

  for (std::int64_t iteration = 0; iteration < head.num_iterations; ++iteration) {
    modulate_pose_tokens(x, t, sum, head, ctx);
    for (std::size_t i = 0; i < head.trunk.size(); ++i) {
      const auto attend = [&](View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                              View<const float, 3> v) {
        attend_trunk(iteration, static_cast<std::int64_t>(i), y, q, k, v);
      };
      block_forward(x, head.trunk[i], {.attend = attend}, ctx);
    }
    layer_norm_forward(x, x, head.trunk_norm, ctx);
    // The first encoding is a sum over nothing: the learnt empty token only starts the modulation.
    const View<const float, 2> before =
        iteration == 0 ? View<const float, 2>() : View<const float, 2>(sum);
    mlp_forward(sum, x, head.pose_branch, {}, before, ctx);
    for (std::int64_t s = 0; s < S; ++s)
      for (std::int64_t c = 0; c < kPoseEncodingSize; ++c)
        pose_encodings(iteration, s, c) = c < 7 ? sum(s, c) : std::max(sum(s, c), 0.0f);
  }
}

// One frame that sees nothing but itself.
inline void camera_head_alone(View<float, 3> pose_encodings, View<const float, 2> camera_token,
                              const CameraHead& head, Context& ctx) {
  const auto attend = [&](std::int64_t, std::int64_t, View<float, 3> y, View<const float, 3> q,
                          View<const float, 3> k,
                          View<const float, 3> v) { attend_within_groups(y, q, k, v, 1, ctx); };
  camera_head_forward(pose_encodings, camera_token, head, attend, ctx);
}

// Keys and values of a frame's iterations so far, before packing.
struct CameraIterations {
  Tensor<float, 4> keys;  // [blocks, iterations, heads, head_dim]
  Tensor<float, 4> values;
};

// Stream: iteration k of a frame attends to all entries of every cached frame and to entries 1..k
// of its own, one entry per iteration. The caller ends the cache's frame.
inline void camera_head_streamed(View<float, 3> pose_encodings, View<const float, 2> camera_token,
                                 const CameraHead& head, KvCache& cache, CameraIterations& own,
                                 Context& ctx) {
  const auto attend = [&](std::int64_t iteration, std::int64_t block, View<float, 3> y,
                          View<const float, 3> q, View<const float, 3> k, View<const float, 3> v) {
    const View<float, 3> keys = own.keys[block], values = own.values[block];
    const std::int64_t entry = k.extent(1) * k.extent(2);
    std::copy_n(k.data(), entry, keys[iteration].data());
    std::copy_n(v.data(), entry, values[iteration].data());
    cache.append(block, keys.narrow(0, 0, iteration + 1), values.narrow(0, 0, iteration + 1), ctx);
    scaled_dot_product_attention(y, q, cache.attended(block), ctx);
  };
  camera_head_forward(pose_encodings, camera_token, head, attend, ctx);
}

// Batch: S frames at once, masked like the aggregator's global blocks.
inline void camera_head_batch(View<float, 3> pose_encodings, View<const float, 2> camera_tokens,
                              const CameraHead& head, BatchMode mode, Context& ctx) {
  const std::int64_t S = camera_tokens.extent(0);
  const auto attend = [&](std::int64_t, std::int64_t, View<float, 3> y, View<const float, 3> q,
                          View<const float, 3> k, View<const float, 3> v) {
    attend_across_frames(y, q, k, v, S, mode, ctx);
  };
  camera_head_forward(pose_encodings, camera_tokens, head, attend, ctx);
}

}  // namespace lvggt
