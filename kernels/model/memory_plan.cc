// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/memory_plan.h"

#include <algorithm>
#include <string_view>

#include "lvggt/core/error.h"
#include "lvggt/kernels/attention.h"
#include "lvggt/kernels/packed_matrix.h"
#include "lvggt/model/tensor_list.h"

namespace lvggt {
namespace {

// Everything below counts floats, in double: sizes of a mistaken configuration must not overflow.

double padded(std::int64_t n) { return static_cast<double>(num_panels(n) * kPanelWidth); }

bool transposed_conv(std::string_view name) {
  for (const std::string_view suffix : {".resize_layers.0.weight", ".resize_layers.1.weight",
                                        ".up1.weight", ".up2.weight", ".up3.weight"})
    if (name.ends_with(suffix)) return true;
  return false;
}

using StorageOf = FunctionRef<Storage(const std::string& weight)>;

// Floats that one tensor takes once packed; int8 has a scale and a sum for each channel beside it.
// Batch norms are folded away.
double packed_size(const TensorSpec& spec, StorageOf storage_of) {
  const auto& s = spec.shape;
  if (known_unused_tensor(spec.name)) return 0;
  if (spec.name.ends_with(".running_mean") || spec.name.ends_with(".running_var")) return 0;
  if (!spec.name.ends_with(".weight") || s.size() < 2) return static_cast<double>(spec.volume());
  const std::size_t out_axis = transposed_conv(spec.name) ? 1 : 0;
  const Storage storage = storage_of(spec.name);
  const double channels = padded(s[out_axis]);
  return static_cast<double>(spec.volume()) / static_cast<double>(s[out_axis]) * channels *
             static_cast<double>(storage_bytes(storage)) / sizeof(float) +
         (storage == Storage::kI8 ? 2 * channels : 0);
}

double group_size(std::int64_t heads, std::int64_t tokens, std::int64_t head_dim,
                  Storage storage = Storage::kF32) {
  return static_cast<double>(keys_values_layout(storage, heads, tokens, head_dim).size) /
         sizeof(float);
}

// One size of frame, in the letters of the model.
struct Frame {
  double pixels, patches, tokens, C;
};

// Scratch of a transformer block over the frame's tokens.
double block_scratch(const Frame& f, std::int64_t heads, const ModelConfig& c) {
  const auto tokens = static_cast<std::int64_t>(f.tokens);
  const double attention = 3 * f.tokens * f.C + group_size(heads, tokens, c.embed_dim / heads);
  const double mlp = f.tokens * static_cast<double>(c.mlp_hidden(c.embed_dim));
  return f.tokens * f.C + std::max(attention, mlp);
}

// Scratch of a DPT up to its features, which are counted by the caller. The four reassembled maps
// have 16, 4, 1 and 1/4 times the patches, the four fused ones 1, 4, 16 and 64 times.
double dpt_scratch(const Frame& f, std::int64_t features, std::int64_t out) {
  const double F = static_cast<double>(features), Co = static_cast<double>(out);
  return f.patches * (F * (21.25 + 85) + std::max(16 * F, 64 * Co));
}

double unet_scratch(const Frame& f, std::int64_t hidden) {
  const double h = static_cast<double>(hidden);
  const double skips = 2 * h * (1 + 1.0 / 2 + 1.0 / 4) + 8 * h / 64;
  const double pooled = h * (1.0 / 4 + 2.0 / 16 + 4.0 / 64);
  const double refined = h * (1 + 1.0 / 2 + 1.0 / 4), middle = h;
  return f.pixels * (skips + pooled + refined + middle);
}

double decoder_scratch(const Frame& f, const ModelConfig& c) {
  const double features = f.pixels * static_cast<double>(c.sbd_features);
  const double extraction = c.sbd_dpt ? dpt_scratch(f, c.sbd_features, c.sbd_features)
                                      : f.patches * static_cast<double>(c.sbd_features);
  const double head = c.sbd_head == DecoderHead::kUnet
                          ? unet_scratch(f, c.sbd_hidden_dim)
                          : 4 * f.pixels * static_cast<double>(c.sbd_hidden_dim);
  return features + std::max(extraction, head);
}

double output_floats(const Frame& f, const ModelConfig& c, const StreamOptions& options) {
  double floats = 2 * f.pixels + (options.points ? 4 * f.pixels : 0);
  if (options.decoder) {
    const double pixels = options.decoder_height > 0
                              ? static_cast<double>(options.decoder_height * options.decoder_width)
                              : f.pixels;
    floats += pixels *
              static_cast<double>(c.sbd_levels * c.lang_dim + (options.rgb && c.sbd_rgb ? 3 : 0));
  }
  return floats;
}

Frame frame_of(const ModelConfig& c, std::int64_t H, std::int64_t W) {
  LVGGT_CHECK(H > 0 && W > 0 && H <= kMaxSide && W <= kMaxSide, "plan_memory: a frame of ", W,
              " x ", H, " pixels does not lie in [1, ", kMaxSide, "]");
  const std::int64_t patches = (H / c.patch_size) * (W / c.patch_size);
  return {static_cast<double>(H * W), static_cast<double>(patches),
          static_cast<double>(c.patch_start_idx() + patches), static_cast<double>(c.embed_dim)};
}

// Cached keys and values of a frame's tokens in all global blocks.
double token_cache_per_frame(const Frame& f, const ModelConfig& c, const StreamOptions& options) {
  return static_cast<double>(c.agg_depth) *
         group_size(c.agg_heads, static_cast<std::int64_t>(f.tokens), c.embed_dim / c.agg_heads,
                    options.cache_storage);
}

double encoder_scratch(const Frame& f, const ModelConfig& c) {
  return 2 * f.tokens * f.C +
         std::max(block_scratch(f, c.dino_heads, c), block_scratch(f, c.agg_heads, c));
}

// Counts floats like everything here, but the plan is in bytes.
MemoryPlan plan_of(double weights, double cache, double arenas) {
  const auto bytes = [](double floats) {
    return static_cast<std::size_t>(std::min(floats * sizeof(float), 0x1p62));
  };
  MemoryPlan plan{bytes(weights), bytes(cache), bytes(arenas), 0};
  plan.total = plan.weights + plan.cache + plan.arenas;
  return plan;
}

}  // namespace

MemoryPlan plan_memory(const ModelConfig& c, std::int64_t H, std::int64_t W,
                       const StreamOptions& options, const StoragePolicy& storage) {
  return plan_memory(c, H, W, options,
                     [&](const std::string& weight) { return storage.of_weight(weight); });
}

MemoryPlan plan_memory(const ModelConfig& c, std::int64_t H, std::int64_t W,
                       const StreamOptions& options, StorageOf storage_of) {
  const Frame f = frame_of(c, H, W);
  double weights = 0;
  for (const TensorSpec& spec : geometry_tensors(c))
    if (options.points || !spec.name.starts_with("point_head."))
      weights += packed_size(spec, storage_of);
  if (options.decoder)
    for (const TensorSpec& spec : decoder_tensors(c)) weights += packed_size(spec, storage_of);

  double cache_per_frame = token_cache_per_frame(f, c, options);
  if (options.camera_cache == CameraCache::kStream)
    cache_per_frame += static_cast<double>(c.cam_trunk_depth) *
                       group_size(c.cam_heads, c.cam_iterations, 2 * c.embed_dim / c.cam_heads);
  const double cache = cache_per_frame * static_cast<double>(options.max_past_frames + 1);

  const double taps = 8 * f.tokens * f.C;
  const double aggregator = encoder_scratch(f, c);
  const double half = static_cast<double>(c.dpt_features / 2);
  const double dense = f.pixels * (2 + half) + dpt_scratch(f, c.dpt_features, c.dpt_features / 2);
  const double decoder = options.decoder ? decoder_scratch(f, c) : 0;
  const double arenas =
      taps + std::max({aggregator, dense, decoder}) + output_floats(f, c, options);

  return plan_of(weights, cache, arenas);
}

MemoryPlan plan_token_memory(const ModelConfig& c, std::int64_t H, std::int64_t W,
                             const StreamOptions& options, StorageOf storage_of) {
  const Frame f = frame_of(c, H, W);
  double weights = 0;
  for (const TensorSpec& spec : geometry_tensors(c))
    if (spec.name.starts_with("aggregator.")) weights += packed_size(spec, storage_of);
  const double cache =
      token_cache_per_frame(f, c, options) * static_cast<double>(options.max_past_frames + 1);
  return plan_of(weights, cache, 8 * f.tokens * f.C + encoder_scratch(f, c));
}

}  // namespace lvggt
