// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <string_view>

namespace lvggt {

// The decoder's heads: UNets as published, or the paper's ablation with 1x1 convolutions.
enum class DecoderHead { kUnet, kMlp };

// Every size and constant of the model; the defaults are the published configuration. Field names
// are the keys of the JSON form. parse_config and validate_config refuse values outside of the
// stated ranges.
struct ModelConfig {
  std::string name = "published";  // describes only

  // Input. Frames are multiples of patch_size on both sides.
  std::int64_t img_size =
      518;  // side of the square that pos_embed was made for, a multiple of patch_size
  std::int64_t patch_size = 14;
  std::array<double, 3> image_mean{0.485, 0.456, 0.406};  // of RGB in [0, 1]
  std::array<double, 3> image_std{0.229, 0.224, 0.225};

  // DINOv2 encoder.
  std::int64_t embed_dim = 1024;  // C, of the aggregator too
  std::int64_t dino_depth = 24;
  std::int64_t dino_heads = 16;
  double mlp_ratio = 4.0;                // hidden width of every MLP over its own width
  std::int64_t num_register_tokens = 4;  // of the encoder and of the aggregator
  bool dino_qk_norm = false;
  double dino_ln_eps = 1e-6;

  // Alternating-attention aggregator.
  std::int64_t agg_depth = 24;  // frame blocks, and as many global blocks
  std::int64_t agg_heads = 16;
  bool agg_qk_norm = true;
  double agg_ln_eps = 1e-5;
  double rope_freq = 100.0;                         // base of the rotary embedding
  std::array<std::int64_t, 4> taps{4, 11, 17, 23};  // layers that the dense heads read, ascending

  // Camera head, of width 2 * embed_dim.
  std::int64_t cam_heads = 16;
  std::int64_t cam_trunk_depth = 4;
  std::int64_t cam_iterations = 4;
  bool cam_qk_norm = false;
  double cam_ln_eps = 1e-5;
  double cam_adaln_eps = 1e-6;

  // Depth and point heads.
  std::int64_t dpt_features = 256;
  std::array<std::int64_t, 4> dpt_out_channels{256, 512, 1024, 1024};
  std::int64_t dpt_head_features_2 = 32;  // channels before the last 1x1 convolution
  double dpt_pos_embed_ratio = 0.1;
  double dpt_ln_eps = 1e-5;  // of the decoder's DPT too

  // Semantic Bridging Decoder.
  std::int64_t sbd_features = 128;
  std::array<std::int64_t, 4> sbd_out_channels{256, 512, 1024, 1024};
  std::int64_t sbd_hidden_dim = 32;
  std::int64_t lang_dim = 3;                  // 3: CLIP, 6: dynamic semantics
  std::int64_t sbd_levels = 3;                // 3: small, middle, large; 1: a single `lang_decoder`
  bool sbd_rgb = true;                        // with the RGB head
  DecoderHead sbd_head = DecoderHead::kUnet;  // "unet" or "mlp"
  bool sbd_dpt =
      true;  // false: the last tap's tokens projected by a 1x1 convolution instead of a DPT
  double bn_eps = 1e-5;
  double bn_momentum = 0.1;

  std::int64_t patch_start_idx() const {
    return 1 + num_register_tokens;
  }  // camera token, registers
  std::int64_t pos_embed_side() const { return img_size / patch_size; }
  std::int64_t mlp_hidden(std::int64_t dim) const {
    return static_cast<std::int64_t>(static_cast<double>(dim) * mlp_ratio);
  }
  friend bool operator==(const ModelConfig&, const ModelConfig&) = default;
};

// Reads the JSON form; absent keys keep their default. `source` (a file name) opens every message.
// Throws kFormat for what is not JSON, an unknown key (naming the nearest one), a key given twice
// or a value of the wrong type; kMismatch for values that do not fit together; kUnsupported for a
// published option with a value the engine does not implement. Keys that describe a run only (name,
// seed, ae_*, *_init_values) are accepted and have no effect.
ModelConfig parse_config(std::string_view json, std::string_view source);

// Reads the file at `path` through parse_config; at most 1 MiB.
ModelConfig load_config(const std::string& path);

// The JSON form with every key, in a fixed order; parse_config of it gives the same configuration.
std::string to_json(const ModelConfig& config);

// Throws kMismatch when a value is out of range or two do not fit together.
void validate_config(const ModelConfig& config, std::string_view source);

}  // namespace lvggt
