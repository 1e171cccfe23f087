// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <charconv>
#include <cmath>

#include "lvggt/model/checkpoint.h"

namespace lvggt {
namespace {

// Reads extents of tensors that may be absent or of another rank.
class Shapes {
 public:
  explicit Shapes(const Safetensors& file) : file_(file) {}

  // Sets `field` to one extent of a tensor of the given rank, if it is there and not zero.
  void extent(std::int64_t& field, const std::string& name, std::size_t rank,
              std::size_t axis) const {
    const TensorEntry* entry = file_.find(name);
    if (entry && entry->shape.size() == rank && entry->shape[axis] > 0) field = entry->shape[axis];
  }
  bool has(const std::string& name) const { return file_.find(name) != nullptr; }

  bool has_prefix(std::string_view prefix) const {
    return std::any_of(file_.entries().begin(), file_.entries().end(),
                       [&](const TensorEntry& entry) { return entry.name.starts_with(prefix); });
  }

  // Sets `field` to one more than the largest index that follows the prefix.
  void count(std::int64_t& field, std::string_view prefix) const {
    std::int64_t found = 0;
    for (const TensorEntry& entry : file_.entries()) {
      if (!entry.name.starts_with(prefix)) continue;
      const char* begin = entry.name.data() + prefix.size();
      std::int64_t index = -1;
      std::from_chars(begin, entry.name.data() + entry.name.size(), index);
      found = std::max(found, index + 1);
    }
    if (found > 0) field = found;
  }

 private:
  const Safetensors& file_;
};

void infer_dpt(const Shapes& shapes, const std::string& head, std::int64_t& features,
               std::array<std::int64_t, 4>& out_channels) {
  shapes.extent(features, head + ".scratch.layer1_rn.weight", 4, 0);
  for (std::size_t i = 0; i < 4; ++i)
    shapes.extent(out_channels[i], head + ".projects." + std::to_string(i) + ".weight", 4, 0);
}

void infer_geometry(const Shapes& shapes, ModelConfig& c) {
  const std::string dino = "aggregator.patch_embed.";
  shapes.extent(c.embed_dim, dino + "patch_embed.proj.weight", 4, 0);
  shapes.extent(c.patch_size, dino + "patch_embed.proj.weight", 4, 2);
  std::int64_t positions = 1 + c.pos_embed_side() * c.pos_embed_side();
  shapes.extent(positions, dino + "pos_embed", 3, 1);
  c.img_size = std::llround(std::sqrt(static_cast<double>(positions - 1))) * c.patch_size;
  shapes.extent(c.num_register_tokens, dino + "register_tokens", 3, 1);
  shapes.count(c.dino_depth, dino + "blocks.");
  shapes.count(c.agg_depth, "aggregator.frame_blocks.");
  shapes.count(c.cam_trunk_depth, "camera_head.trunk.");
  c.dino_qk_norm = shapes.has(dino + "blocks.0.attn.q_norm.weight");
  c.agg_qk_norm = shapes.has("aggregator.frame_blocks.0.attn.q_norm.weight");
  c.cam_qk_norm = shapes.has("camera_head.trunk.0.attn.q_norm.weight");

  std::int64_t hidden = 0;
  shapes.extent(hidden, "aggregator.frame_blocks.0.mlp.fc1.weight", 2, 0);
  if (hidden > 0) c.mlp_ratio = static_cast<double>(hidden) / static_cast<double>(c.embed_dim);
  std::int64_t head_dim = 64;
  shapes.extent(head_dim, "aggregator.frame_blocks.0.attn.q_norm.weight", 1, 0);
  c.agg_heads = c.dino_heads = c.cam_heads =
      c.embed_dim % head_dim == 0 ? c.embed_dim / head_dim : 1;

  if (c.agg_depth != ModelConfig{}.agg_depth)
    for (std::int64_t i = 0; i < 4; ++i)
      c.taps[static_cast<std::size_t>(i)] =
          std::max<std::int64_t>((i + 1) * c.agg_depth / 4 - 1, 0);
  infer_dpt(shapes, "depth_head", c.dpt_features, c.dpt_out_channels);
  shapes.extent(c.dpt_head_features_2, "depth_head.scratch.output_conv2.0.weight", 4, 0);
}

void infer_decoder(const Shapes& shapes, ModelConfig& c) {
  c.sbd_dpt = !shapes.has("feature_extractor.project.weight");
  c.sbd_levels = shapes.has_prefix("lang_decoder.") ? 1 : 3;
  c.sbd_rgb = shapes.has_prefix("rgb_decoder.");
  const std::string head = language_decoder_names(c).front();
  c.sbd_head = shapes.has_prefix(head + ".mlp.") ? DecoderHead::kMlp : DecoderHead::kUnet;
  if (c.sbd_dpt) {
    infer_dpt(shapes, "feature_extractor", c.sbd_features, c.sbd_out_channels);
  } else {
    shapes.extent(c.sbd_features, "feature_extractor.project.weight", 4, 0);
  }
  if (c.sbd_head == DecoderHead::kMlp) {
    shapes.extent(c.lang_dim, head + ".mlp.2.weight", 4, 0);
    std::int64_t hidden = 4 * c.sbd_hidden_dim;
    shapes.extent(hidden, head + ".mlp.0.weight", 4, 0);
    c.sbd_hidden_dim = std::max<std::int64_t>(hidden / 4, 1);
  } else {
    shapes.extent(c.lang_dim, head + ".final_conv.weight", 4, 0);
    shapes.extent(c.sbd_hidden_dim, "lang_encoder.down1.0.weight", 4, 0);
  }
}

}  // namespace

ModelConfig infer_config(const Safetensors& geometry, const Safetensors* decoder,
                         const ModelConfig& base) {
  ModelConfig config = base;
  config.name = "inferred";
  infer_geometry(Shapes(geometry), config);
  const Shapes shapes(decoder ? *decoder : geometry);
  if (decoder || shapes.has_prefix("lang_decoder")) infer_decoder(shapes, config);
  return config;
}

ModelConfig infer_decoder_config(const Safetensors& decoder, const ModelConfig& geometry) {
  ModelConfig config = geometry;
  const auto metadata = decoder.metadata().find("config");
  if (metadata == decoder.metadata().end() || !metadata->second.starts_with('{')) {
    infer_decoder(Shapes(decoder), config);
    validate_config(config, decoder.path() + ": the configuration that its shapes tell");
    return config;
  }
  const ModelConfig own = parse_config(metadata->second, decoder.path() + ": metadata \"config\"");
  ModelConfig same_tokens = own;
  same_tokens.embed_dim = geometry.embed_dim;
  same_tokens.patch_size = geometry.patch_size;
  same_tokens.dino_depth = geometry.dino_depth;
  same_tokens.agg_depth = geometry.agg_depth;
  same_tokens.taps = geometry.taps;
  if (!(same_tokens == own))
    fail(ErrorKind::kMismatch, decoder.path(), ": was made for another geometry model: its ",
         config_difference(own, same_tokens));
  config.dpt_ln_eps = own.dpt_ln_eps;
  config.sbd_features = own.sbd_features;
  config.sbd_out_channels = own.sbd_out_channels;
  config.sbd_hidden_dim = own.sbd_hidden_dim;
  config.lang_dim = own.lang_dim;
  config.sbd_levels = own.sbd_levels;
  config.sbd_rgb = own.sbd_rgb;
  config.sbd_head = own.sbd_head;
  config.sbd_dpt = own.sbd_dpt;
  config.bn_eps = own.bn_eps;
  config.bn_momentum = own.bn_momentum;
  return config;
}

}  // namespace lvggt
