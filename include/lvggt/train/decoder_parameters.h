// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <optional>
#include <string>
#include <variant>
#include <vector>

#include "lvggt/model/tensor_list.h"
#include "lvggt/train/layer_parameters.h"

namespace lvggt {

// The decoder's parameters, module by module as in the published checkpoint.

template <class T>
struct DoubleConvParameters {
  Conv2dParameters<T> conv1, conv2;
  BatchNormParameters<T> norm1, norm2;
};

template <class T>
struct UNetEncoderParameters {
  std::array<DoubleConvParameters<T>, 4> down;
  std::array<Conv2dParameters<T>, 3> pool;  // 2x2, stride 2
};

template <class T>
struct UNetDecoderParameters {
  std::array<ConvTranspose2dParameters<T>, 3> up;  // 2x2, stride 2
  std::array<DoubleConvParameters<T>, 3> conv;     // of [up, skip]
  Conv2dParameters<T> final_conv;                  // 3x3
};

template <class T>
struct MlpHeadParameters {
  LinearParameters<T> fc1, fc2;
};

template <class T>
using PixelHeadParameters = std::variant<UNetDecoderParameters<T>, MlpHeadParameters<T>>;

// One UNet encoder and the heads that read it: language with one head a level, or RGB.
template <class T>
struct BranchParameters {
  std::optional<UNetEncoderParameters<T>> encoder;  // absent with MLP heads
  std::vector<PixelHeadParameters<T>> heads;
};

template <class T>
struct ResidualConvUnitParameters {
  Conv2dParameters<T> conv1, conv2;
};

template <class T>
struct FusionBlockParameters {
  std::optional<ResidualConvUnitParameters<T>> res_conv_unit1;  // of the skip
  ResidualConvUnitParameters<T> res_conv_unit2;
  LinearParameters<T> out_conv;
};

// Tap i to its feature map.
template <class T>
struct ReassembleParameters {
  NormParameters<T> norm;  // shared by the taps
  LinearParameters<T> project;
  std::variant<std::monostate, ConvTranspose2dParameters<T>, Conv2dParameters<T>> resize;
  Conv2dParameters<T> layer_rn;  // without bias
};

template <class T>
struct DptParameters {
  std::array<ReassembleParameters<T>, 4> reassemble;
  std::array<FusionBlockParameters<T>, 4> refinenet;  // [0] is refinenet1, the finest
  Conv2dParameters<T> output_conv1;
};

// Weights or gradients of the whole decoder.
template <class T>
struct DecoderParameters {
  std::variant<DptParameters<T>, LinearParameters<T>> feature_extractor;
  BranchParameters<T> language;
  std::optional<BranchParameters<T>> rgb;
};

template <class T, class Store>
DoubleConvParameters<T> bind_double_conv(const ParameterBinder<T, Store>& binder,
                                         const std::string& prefix) {
  return {binder.normed_conv2d(prefix + ".0"), binder.normed_conv2d(prefix + ".3"),
          binder.batch_norm(prefix + ".1"), binder.batch_norm(prefix + ".4")};
}

template <class T, class Store>
UNetEncoderParameters<T> bind_unet_encoder(const ParameterBinder<T, Store>& binder,
                                           const std::string& prefix) {
  UNetEncoderParameters<T> encoder;
  for (std::size_t i = 0; i < 4; ++i) {
    const std::string number = std::to_string(i + 1);
    encoder.down[i] = bind_double_conv(binder, prefix + ".down" + number);
    if (i < 3) encoder.pool[i] = binder.conv2d(prefix + ".pool" + number, 2, 0);
  }
  return encoder;
}

template <class T, class Store>
PixelHeadParameters<T> bind_pixel_head(const ParameterBinder<T, Store>& binder,
                                       const std::string& prefix) {
  if (binder.config().sbd_head == DecoderHead::kMlp)
    return MlpHeadParameters<T>{binder.pixel_linear(prefix + ".mlp.0"),
                                binder.pixel_linear(prefix + ".mlp.2")};
  UNetDecoderParameters<T> decoder;
  for (std::size_t k = 0; k < 3; ++k) {
    const std::string number = std::to_string(k + 1);
    decoder.up[k] = binder.conv_transpose2d(prefix + ".up" + number);
    decoder.conv[k] = bind_double_conv(binder, prefix + ".conv" + number);
  }
  decoder.final_conv = binder.conv2d(prefix + ".final_conv", 1, 1);
  return decoder;
}

template <class T, class Store>
BranchParameters<T> bind_branch(const ParameterBinder<T, Store>& binder, const std::string& encoder,
                                const std::vector<std::string>& heads) {
  BranchParameters<T> branch;
  if (binder.config().sbd_head == DecoderHead::kUnet)
    branch.encoder = bind_unet_encoder(binder, encoder);
  for (const std::string& head : heads) branch.heads.push_back(bind_pixel_head(binder, head));
  return branch;
}

template <class T, class Store>
ResidualConvUnitParameters<T> bind_residual_conv_unit(const ParameterBinder<T, Store>& binder,
                                                      const std::string& prefix) {
  return {binder.conv2d(prefix + ".conv1", 1, 1), binder.conv2d(prefix + ".conv2", 1, 1)};
}

template <class T, class Store>
DptParameters<T> bind_dpt(const ParameterBinder<T, Store>& binder, const std::string& prefix) {
  DptParameters<T> dpt;
  const std::string scratch = prefix + ".scratch";
  for (std::size_t i = 0; i < 4; ++i) {
    const std::string resize = prefix + ".resize_layers." + std::to_string(i);
    const std::string number = std::to_string(i + 1);
    ReassembleParameters<T>& tap = dpt.reassemble[i];
    tap.norm = binder.norm(prefix + ".norm");
    tap.project = binder.pixel_linear(prefix + ".projects." + std::to_string(i));
    if (i < 2) tap.resize = binder.conv_transpose2d(resize);
    if (i == 3) tap.resize = binder.conv2d(resize, 2, 1);
    tap.layer_rn = binder.conv2d_without_bias(scratch + ".layer" + number + "_rn", 1, 1);

    const std::string refinenet = scratch + ".refinenet" + number;
    FusionBlockParameters<T>& block = dpt.refinenet[i];
    if (i < 3) block.res_conv_unit1 = bind_residual_conv_unit(binder, refinenet + ".resConfUnit1");
    block.res_conv_unit2 = bind_residual_conv_unit(binder, refinenet + ".resConfUnit2");
    block.out_conv = binder.pixel_linear(refinenet + ".out_conv");
  }
  dpt.output_conv1 = binder.conv2d(scratch + ".output_conv1", 1, 1);
  return dpt;
}

template <class T, class Store>
DecoderParameters<T> bind_decoder(const ParameterBinder<T, Store>& binder) {
  const ModelConfig& config = binder.config();
  DecoderParameters<T> decoder;
  if (config.sbd_dpt) {
    decoder.feature_extractor = bind_dpt(binder, "feature_extractor");
  } else {
    decoder.feature_extractor = binder.pixel_linear("feature_extractor.project");
  }
  decoder.language = bind_branch(binder, "lang_encoder", language_decoder_names(config));
  if (config.sbd_rgb) decoder.rgb = bind_branch(binder, "rgb_encoder", {"rgb_decoder.0"});
  return decoder;
}

}  // namespace lvggt
