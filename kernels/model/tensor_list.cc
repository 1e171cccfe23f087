// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/tensor_list.h"

#include <string_view>
#include <tuple>
#include <utility>

namespace lvggt {
namespace {

using Dims = std::vector<std::int64_t>;

// Builds the list; every method takes the names' prefix without a final dot.
class List {
 public:
  void add(const std::string& name, Dims shape) { specs_.push_back({name, std::move(shape)}); }
  void weight_bias(const std::string& prefix, Dims weight_shape, std::int64_t bias_size) {
    add(prefix + ".weight", std::move(weight_shape));
    add(prefix + ".bias", {bias_size});
  }
  void linear(const std::string& prefix, std::int64_t in, std::int64_t out) {
    weight_bias(prefix, {out, in}, out);
  }
  void norm(const std::string& prefix, std::int64_t dim) { weight_bias(prefix, {dim}, dim); }
  void conv(const std::string& prefix, std::int64_t in, std::int64_t out, std::int64_t kernel) {
    weight_bias(prefix, {out, in, kernel, kernel}, out);
  }
  void conv_transpose(const std::string& prefix, std::int64_t in, std::int64_t out,
                      std::int64_t kernel) {
    weight_bias(prefix, {in, out, kernel, kernel}, out);
  }

  void block(const std::string& prefix, std::int64_t dim, std::int64_t hidden,
             std::int64_t head_dim, bool qk_norm) {
    norm(prefix + ".norm1", dim);
    linear(prefix + ".attn.qkv", dim, 3 * dim);
    if (qk_norm) {
      norm(prefix + ".attn.q_norm", head_dim);
      norm(prefix + ".attn.k_norm", head_dim);
    }
    linear(prefix + ".attn.proj", dim, dim);
    add(prefix + ".ls1.gamma", {dim});
    norm(prefix + ".norm2", dim);
    linear(prefix + ".mlp.fc1", dim, hidden);
    linear(prefix + ".mlp.fc2", hidden, dim);
    add(prefix + ".ls2.gamma", {dim});
  }

  // [conv3x3, BatchNorm, ReLU] x 2, as a sequence with indices 0, 1 and 3, 4.
  void double_conv(const std::string& prefix, std::int64_t in, std::int64_t out) {
    for (const auto& [conv_idx, norm_idx, channels] :
         {std::tuple{".0", ".1", in}, std::tuple{".3", ".4", out}}) {
      conv(prefix + conv_idx, channels, out, 3);
      norm(prefix + norm_idx, out);
      add(prefix + norm_idx + ".running_mean", {out});
      add(prefix + norm_idx + ".running_var", {out});
    }
  }

  // A fusion block; the coarsest one has no skip and so no resConfUnit1.
  void fusion_block(const std::string& prefix, std::int64_t features, bool with_skip) {
    conv(prefix + ".out_conv", features, features, 1);
    for (const char* unit : {".resConfUnit1", ".resConfUnit2"}) {
      if (!with_skip && std::string_view(unit) == ".resConfUnit1") continue;
      conv(prefix + unit + ".conv1", features, features, 3);
      conv(prefix + unit + ".conv2", features, features, 3);
    }
  }

  // out_channels 0: a feature extractor, which ends at output_conv1 with all its features.
  void dpt(const std::string& prefix, const ModelConfig& c, std::int64_t features,
           const std::array<std::int64_t, 4>& reassembled, std::int64_t out_channels) {
    norm(prefix + ".norm", 2 * c.embed_dim);
    for (std::size_t i = 0; i < 4; ++i)
      conv(prefix + ".projects." + std::to_string(i), 2 * c.embed_dim, reassembled[i], 1);
    conv_transpose(prefix + ".resize_layers.0", reassembled[0], reassembled[0], 4);
    conv_transpose(prefix + ".resize_layers.1", reassembled[1], reassembled[1], 2);
    conv(prefix + ".resize_layers.3", reassembled[3], reassembled[3], 3);
    const std::string scratch = prefix + ".scratch";
    for (std::size_t i = 0; i < 4; ++i)
      add(scratch + ".layer" + std::to_string(i + 1) + "_rn.weight",
          {features, reassembled[i], 3, 3});
    for (int i = 1; i <= 4; ++i)
      fusion_block(scratch + ".refinenet" + std::to_string(i), features, i < 4);
    if (out_channels == 0) {
      conv(scratch + ".output_conv1", features, features, 3);
    } else {
      conv(scratch + ".output_conv1", features, features / 2, 3);
      conv(scratch + ".output_conv2.0", features / 2, c.dpt_head_features_2, 3);
      conv(scratch + ".output_conv2.2", c.dpt_head_features_2, out_channels, 1);
    }
  }

  void unet_encoder(const std::string& prefix, std::int64_t features, std::int64_t hidden) {
    std::int64_t in = features;
    for (int i = 1; i <= 4; ++i) {
      const std::int64_t out = hidden << (i - 1);
      double_conv(prefix + ".down" + std::to_string(i), in, out);
      if (i < 4) conv(prefix + ".pool" + std::to_string(i), out, out, 2);
      in = out;
    }
  }

  void decoder_head(const std::string& prefix, const ModelConfig& c, std::int64_t out_channels) {
    const std::int64_t hidden = c.sbd_hidden_dim;
    if (c.sbd_head == DecoderHead::kMlp) {
      conv(prefix + ".mlp.0", c.sbd_features, 4 * hidden, 1);
      conv(prefix + ".mlp.2", 4 * hidden, out_channels, 1);
      return;
    }
    for (int k = 1; k <= 3; ++k) {
      const std::int64_t channels = hidden << (3 - k);
      conv_transpose(prefix + ".up" + std::to_string(k), 2 * channels, channels, 2);
      double_conv(prefix + ".conv" + std::to_string(k), 2 * channels, channels);
    }
    conv(prefix + ".final_conv", hidden, out_channels, 3);
  }

  std::vector<TensorSpec> take() { return std::move(specs_); }

 private:
  std::vector<TensorSpec> specs_;
};

void add_aggregator(List& list, const ModelConfig& c) {
  const std::int64_t C = c.embed_dim;
  const std::string a = "aggregator.";
  const std::string dino = a + "patch_embed";
  list.add(a + "camera_token", {1, 2, 1, C});
  list.add(a + "register_token", {1, 2, c.num_register_tokens, C});
  list.add(dino + ".cls_token", {1, 1, C});
  list.add(dino + ".pos_embed", {1, 1 + c.pos_embed_side() * c.pos_embed_side(), C});
  list.add(dino + ".register_tokens", {1, c.num_register_tokens, C});
  list.add(dino + ".mask_token", {1, C});
  list.conv(dino + ".patch_embed.proj", 3, C, c.patch_size);
  for (std::int64_t i = 0; i < c.dino_depth; ++i)
    list.block(dino + ".blocks." + std::to_string(i), C, c.mlp_hidden(C), C / c.dino_heads,
               c.dino_qk_norm);
  list.norm(dino + ".norm", C);
  for (const char* kind : {"frame_blocks.", "global_blocks."})
    for (std::int64_t i = 0; i < c.agg_depth; ++i)
      list.block(a + kind + std::to_string(i), C, c.mlp_hidden(C), C / c.agg_heads, c.agg_qk_norm);
}

void add_camera_head(List& list, const ModelConfig& c) {
  const std::int64_t dim = 2 * c.embed_dim;
  const std::string head = "camera_head.";
  list.add(head + "empty_pose_tokens", {1, 1, 9});
  for (std::int64_t i = 0; i < c.cam_trunk_depth; ++i)
    list.block(head + "trunk." + std::to_string(i), dim, c.mlp_hidden(dim), dim / c.cam_heads,
               c.cam_qk_norm);
  list.norm(head + "token_norm", dim);
  list.norm(head + "trunk_norm", dim);
  list.linear(head + "embed_pose", 9, dim);
  list.linear(head + "poseLN_modulation.1", dim, 3 * dim);
  list.linear(head + "pose_branch.fc1", dim, dim / 2);
  list.linear(head + "pose_branch.fc2", dim / 2, 9);
}

}  // namespace

std::vector<TensorSpec> geometry_tensors(const ModelConfig& config) {
  List list;
  add_aggregator(list, config);
  add_camera_head(list, config);
  list.dpt("point_head", config, config.dpt_features, config.dpt_out_channels, 4);
  list.dpt("depth_head", config, config.dpt_features, config.dpt_out_channels, 2);
  return list.take();
}

std::vector<std::string> language_decoder_names(const ModelConfig& config) {
  if (config.sbd_levels == 1) return {"lang_decoder"};
  return {"lang_decoder_small", "lang_decoder_middle", "lang_decoder_large"};
}

std::vector<TensorSpec> decoder_tensors(const ModelConfig& config) {
  List list;
  if (config.sbd_dpt) {
    list.dpt("feature_extractor", config, config.sbd_features, config.sbd_out_channels, 0);
  } else {
    list.conv("feature_extractor.project", 2 * config.embed_dim, config.sbd_features, 1);
  }
  if (config.sbd_head == DecoderHead::kUnet) {
    list.unet_encoder("lang_encoder", config.sbd_features, config.sbd_hidden_dim);
    if (config.sbd_rgb)
      list.unet_encoder("rgb_encoder", config.sbd_features, config.sbd_hidden_dim);
  }
  for (const std::string& name : language_decoder_names(config))
    list.decoder_head(name, config, config.lang_dim);
  if (config.sbd_rgb) list.decoder_head("rgb_decoder.0", config, 3);
  return list.take();
}

bool is_decoder_tensor(std::string_view name) {
  for (const std::string_view prefix :
       {"feature_extractor.", "lang_encoder.", "lang_decoder", "rgb_encoder.", "rgb_decoder."})
    if (name.starts_with(prefix)) return true;
  return false;
}

bool known_unused_tensor(std::string_view name) {
  return name.starts_with("track_head.") || name.starts_with("train.") ||
         name == "aggregator.patch_embed.mask_token" || name.ends_with(".num_batches_tracked");
}

}  // namespace lvggt
