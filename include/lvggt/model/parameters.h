// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "lvggt/core/parallel.h"
#include "lvggt/kernels/batch_norm2d.h"
#include "lvggt/model/checkpoint.h"
#include "lvggt/model/semantic_bridging_decoder.h"
#include "lvggt/model/stream_vggt.h"

namespace lvggt {

// From the tensors of a checkpoint to the packed parameters of each module. Every tensor is read,
// packed and let go before the next, so that memory holds the packed model and one tensor (one a
// thread where blocks are read in parallel). `prefix` is the module's name in the checkpoint,
// without a final dot.

// A plain file is kept as float32.
inline Storage storage_of(const Checkpoint& c, const std::string& weight) {
  return c.storage_of(weight);
}
inline Storage storage_of(const Safetensors&, const std::string&) { return Storage::kF32; }
inline PackedMatrix read_linear(const Checkpoint& c, const std::string& weight) {
  return c.read_linear(weight);
}
inline PackedMatrix read_linear(const Safetensors& file, const std::string& weight) {
  return pack_linear(file.read<2>(weight));
}

template <class Source>
Linear load_linear(const Source& c, const std::string& prefix) {
  return {read_linear(c, prefix + ".weight"), c.template read<1>(prefix + ".bias")};
}

template <class Source>
LayerNorm load_layer_norm(const Source& c, const std::string& prefix, double eps) {
  return {c.template read<1>(prefix + ".weight"), c.template read<1>(prefix + ".bias"),
          static_cast<float>(eps)};
}

template <class Source>
Conv2d load_conv2d(const Source& c, const std::string& prefix, std::int64_t stride,
                   std::int64_t padding) {
  return {pack_conv2d(c.template read<4>(prefix + ".weight"), stride, padding,
                      storage_of(c, prefix + ".weight")),
          c.template read<1>(prefix + ".bias")};
}

template <class Source>
ConvTranspose2d load_conv_transpose2d(const Source& c, const std::string& prefix) {
  return {pack_conv_transpose2d(c.template read<4>(prefix + ".weight"),
                                storage_of(c, prefix + ".weight")),
          c.template read<1>(prefix + ".bias")};
}

// A 1x1 convolution as a linear layer over pixels.
template <class Source>
Linear load_pixel_linear(const Source& c, const std::string& prefix) {
  const Tensor<float, 4> weight = c.template read<4>(prefix + ".weight");
  const Shape<2> shape{weight.extent(0), weight.extent(1)};
  return {pack_linear(weight.view().reshaped(shape), storage_of(c, prefix + ".weight")),
          c.template read<1>(prefix + ".bias")};
}

// A convolution with the batch norm that follows it folded in.
template <class Source>
Conv2d load_normed_conv2d(const Source& c, const std::string& conv, const std::string& norm,
                          double eps) {
  Tensor<float, 4> weight = c.template read<4>(conv + ".weight");
  Tensor<float, 1> bias = c.template read<1>(conv + ".bias");
  batch_norm2d_fold(weight, bias, c.template read<1>(norm + ".weight"),
                    c.template read<1>(norm + ".bias"), c.template read<1>(norm + ".running_mean"),
                    c.template read<1>(norm + ".running_var"), static_cast<float>(eps));
  return {pack_conv2d(weight, 1, 1, storage_of(c, conv + ".weight")), std::move(bias)};
}

template <class Source>
DoubleConv load_double_conv(const Source& c, const std::string& prefix, double eps) {
  return {load_normed_conv2d(c, prefix + ".0", prefix + ".1", eps),
          load_normed_conv2d(c, prefix + ".3", prefix + ".4", eps)};
}

template <class Source>
Block load_block(const Source& c, const std::string& prefix, std::int64_t num_heads, bool qk_norm,
                 double eps) {
  Block block;
  block.norm1 = load_layer_norm(c, prefix + ".norm1", eps);
  block.attn.qkv = load_linear(c, prefix + ".attn.qkv");
  if (qk_norm) {
    block.attn.q_norm = load_layer_norm(c, prefix + ".attn.q_norm", eps);
    block.attn.k_norm = load_layer_norm(c, prefix + ".attn.k_norm", eps);
  }
  block.attn.proj = load_linear(c, prefix + ".attn.proj");
  block.attn.num_heads = num_heads;
  block.ls1 = c.template read<1>(prefix + ".ls1.gamma");
  block.norm2 = load_layer_norm(c, prefix + ".norm2", eps);
  block.mlp = {load_linear(c, prefix + ".mlp.fc1"), load_linear(c, prefix + ".mlp.fc2")};
  block.ls2 = c.template read<1>(prefix + ".ls2.gamma");
  return block;
}

inline std::vector<Block> load_blocks(const Checkpoint& c, const std::string& prefix,
                                      std::int64_t depth, std::int64_t num_heads, bool qk_norm,
                                      double eps, Context& ctx) {
  std::vector<Block> blocks(static_cast<std::size_t>(depth));
  parallel_chunks(
      depth,
      [&](std::int64_t i, int) {
        blocks[static_cast<std::size_t>(i)] =
            load_block(c, prefix + "." + std::to_string(i), num_heads, qk_norm, eps);
      },
      ctx);
  return blocks;
}

inline VisionTransformer load_vision_transformer(const Checkpoint& c, const std::string& prefix,
                                                 Context& ctx) {
  const ModelConfig& config = c.config();
  const std::int64_t C = config.embed_dim, side = config.pos_embed_side();
  VisionTransformer vit;
  vit.patch_embed.proj = load_conv2d(c, prefix + ".patch_embed.proj", config.patch_size, 0);
  for (std::size_t i = 0; i < 3; ++i) {
    vit.patch_embed.mean[i] = static_cast<float>(config.image_mean[i]);
    vit.patch_embed.std[i] = static_cast<float>(config.image_std[i]);
  }
  vit.cls_token = c.read_as(prefix + ".cls_token", Shape{std::int64_t{1}, C});
  vit.register_tokens =
      c.read_as(prefix + ".register_tokens", Shape{config.num_register_tokens, C});
  vit.pos_embed = c.read_as(prefix + ".pos_embed", Shape{1 + side * side, C});
  vit.pos_embed_side = side;
  vit.blocks = load_blocks(c, prefix + ".blocks", config.dino_depth, config.dino_heads,
                           config.dino_qk_norm, config.dino_ln_eps, ctx);
  vit.norm = load_layer_norm(c, prefix + ".norm", config.dino_ln_eps);
  return vit;
}

inline Aggregator load_aggregator(const Checkpoint& c, Context& ctx) {
  const ModelConfig& config = c.config();
  const std::int64_t C = config.embed_dim;
  Aggregator aggregator;
  aggregator.patch_embed = load_vision_transformer(c, "aggregator.patch_embed", ctx);
  aggregator.camera_token = c.read_as("aggregator.camera_token", Shape{std::int64_t{2}, C});
  aggregator.register_token =
      c.read_as("aggregator.register_token", Shape{std::int64_t{2}, config.num_register_tokens, C});
  for (auto* blocks : {&aggregator.frame_blocks, &aggregator.global_blocks})
    *blocks = load_blocks(
        c,
        blocks == &aggregator.frame_blocks ? "aggregator.frame_blocks" : "aggregator.global_blocks",
        config.agg_depth, config.agg_heads, config.agg_qk_norm, config.agg_ln_eps, ctx);
  aggregator.taps = config.taps;
  aggregator.rope_freq = static_cast<float>(config.rope_freq);
  return aggregator;
}

inline CameraHead load_camera_head(const Checkpoint& c, Context& ctx) {
  const ModelConfig& config = c.config();
  CameraHead head;
  head.token_norm = load_layer_norm(c, "camera_head.token_norm", config.cam_ln_eps);
  head.empty_pose_tokens =
      c.read_as("camera_head.empty_pose_tokens", Shape{std::int64_t{1}, kPoseEncodingSize});
  head.embed_pose = load_linear(c, "camera_head.embed_pose");
  head.pose_ln_modulation = load_linear(c, "camera_head.poseLN_modulation.1");
  head.adaln_norm.eps = static_cast<float>(config.cam_adaln_eps);
  head.trunk = load_blocks(c, "camera_head.trunk", config.cam_trunk_depth, config.cam_heads,
                           config.cam_qk_norm, config.cam_ln_eps, ctx);
  head.trunk_norm = load_layer_norm(c, "camera_head.trunk_norm", config.cam_ln_eps);
  head.pose_branch = {load_linear(c, "camera_head.pose_branch.fc1"),
                      load_linear(c, "camera_head.pose_branch.fc2")};
  head.num_iterations = config.cam_iterations;
  return head;
}

template <class Source>
FusionBlock load_fusion_block(const Source& c, const std::string& prefix, bool with_skip) {
  const auto unit = [&](const std::string& name) {
    return ResidualConvUnit{load_conv2d(c, prefix + name + ".conv1", 1, 1),
                            load_conv2d(c, prefix + name + ".conv2", 1, 1)};
  };
  FusionBlock block;
  if (with_skip) block.res_conv_unit1 = unit(".resConfUnit1");
  block.res_conv_unit2 = unit(".resConfUnit2");
  block.out_conv = load_conv2d(c, prefix + ".out_conv", 1, 0);
  return block;
}

// predicts: false for a feature extractor, which ends at output_conv1 and has no position
// embedding.
template <class Source>
DptHead load_dpt_head(const Source& c, const std::string& prefix, bool predicts) {
  const ModelConfig& config = c.config();
  DptHead head;
  Reassemble& reassemble = head.reassemble;
  reassemble.norm = load_layer_norm(c, prefix + ".norm", config.dpt_ln_eps);
  reassemble.resize0 = load_conv_transpose2d(c, prefix + ".resize_layers.0");
  reassemble.resize1 = load_conv_transpose2d(c, prefix + ".resize_layers.1");
  reassemble.resize3 = load_conv2d(c, prefix + ".resize_layers.3", 2, 1);
  const std::string scratch = prefix + ".scratch";
  for (std::size_t i = 0; i < 4; ++i) {
    const std::string number = std::to_string(i + 1);
    reassemble.projects[i] = load_pixel_linear(c, prefix + ".projects." + std::to_string(i));
    const std::string layer_rn = scratch + ".layer" + number + "_rn.weight";
    reassemble.layer_rn[i].weight =
        pack_conv2d(c.template read<4>(layer_rn), 1, 1, storage_of(c, layer_rn));
    head.refinenet[i] = load_fusion_block(c, scratch + ".refinenet" + number, i < 3);
  }
  head.output_conv1 = load_conv2d(c, scratch + ".output_conv1", 1, 1);
  if (!predicts) return head;
  head.output_conv2_0 = load_conv2d(c, scratch + ".output_conv2.0", 1, 1);
  head.output_conv2_2 = load_conv2d(c, scratch + ".output_conv2.2", 1, 0);
  head.pos_embed_ratio = config.dpt_pos_embed_ratio;
  return head;
}

inline StreamVggt load_stream_vggt(const Checkpoint& c, Context& ctx) {
  StreamVggt model;
  model.aggregator = load_aggregator(c, ctx);
  model.camera_head = load_camera_head(c, ctx);
  model.depth_head = load_dpt_head(c, "depth_head", true);
  if (c.has_point_head()) model.point_head = load_dpt_head(c, "point_head", true);
  return model;
}

template <class Source>
UNetEncoder load_unet_encoder(const Source& c, const std::string& prefix) {
  UNetEncoder encoder;
  for (std::size_t i = 0; i < 4; ++i) {
    const std::string number = std::to_string(i + 1);
    encoder.down[i] = load_double_conv(c, prefix + ".down" + number, c.config().bn_eps);
    if (i < 3) encoder.pool[i] = load_conv2d(c, prefix + ".pool" + number, 2, 0);
  }
  return encoder;
}

template <class Source>
PixelHead load_pixel_head(const Source& c, const std::string& prefix) {
  if (c.config().sbd_head == DecoderHead::kMlp)
    return MlpHead{load_conv2d(c, prefix + ".mlp.0", 1, 0),
                   load_conv2d(c, prefix + ".mlp.2", 1, 0)};
  UNetDecoder decoder;
  for (std::size_t i = 0; i < 3; ++i) {
    const std::string number = std::to_string(i + 1);
    decoder.up[i] = load_conv_transpose2d(c, prefix + ".up" + number);
    decoder.conv[i] = load_double_conv(c, prefix + ".conv" + number, c.config().bn_eps);
  }
  decoder.final_conv = load_conv2d(c, prefix + ".final_conv", 1, 1);
  return decoder;
}

template <class Source>
SemanticBridgingDecoder load_semantic_bridging_decoder(const Source& c) {
  const ModelConfig& config = c.config();
  SemanticBridgingDecoder decoder;
  if (config.sbd_dpt) {
    decoder.feature_extractor = load_dpt_head(c, "feature_extractor", false);
  } else {
    decoder.feature_extractor = load_pixel_linear(c, "feature_extractor.project");
  }
  if (config.sbd_head == DecoderHead::kUnet) {
    decoder.lang_encoder = load_unet_encoder(c, "lang_encoder");
    if (config.sbd_rgb) decoder.rgb_encoder = load_unet_encoder(c, "rgb_encoder");
  }
  for (const std::string& name : language_decoder_names(config))
    decoder.lang_decoders.push_back(load_pixel_head(c, name));
  if (config.sbd_rgb) decoder.rgb_decoder = load_pixel_head(c, "rgb_decoder.0");
  decoder.num_features = config.sbd_features;
  decoder.lang_dim = config.lang_dim;
  return decoder;
}

}  // namespace lvggt
