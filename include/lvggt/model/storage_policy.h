// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstddef>
#include <string>
#include <string_view>

#include "lvggt/core/error.h"
#include "lvggt/core/storage.h"

namespace lvggt {

// Layers whose weights are kept alike, MODULE.LAYER or MODULE. Linear layers of the transformer
// blocks come first, four a module; the others of the camera head follow, then convolutions.
inline constexpr std::array<std::string_view, 22> kLayerKinds{
    "dino.qkv",   "dino.proj",   "dino.fc1",    "dino.fc2",    "frame.qkv",   "frame.proj",
    "frame.fc1",  "frame.fc2",   "global.qkv",  "global.proj", "global.fc1",  "global.fc2",
    "camera.qkv", "camera.proj", "camera.fc1",  "camera.fc2",  "camera.pose", "patch_embed",
    "depth",      "points",      "decoder.dpt", "decoder.unet"};
inline constexpr std::size_t kNumLinearKinds = 17;  // they can be int8
inline constexpr std::size_t kDinoProjKind = 1, kFirstCameraKind = 12, kUnetKind = 21;

// The index in kLayerKinds of a weight of that name in the checkpoint; a final ".weight" may be
// missing.
constexpr std::size_t layer_kind(std::string_view name) {
  constexpr std::array<std::string_view, 4> kModules{
      "aggregator.patch_embed.blocks.", "aggregator.frame_blocks.", "aggregator.global_blocks.",
      "camera_head.trunk."};
  constexpr std::array<std::string_view, 4> kLayers{".attn.qkv", ".attn.proj", ".mlp.fc1",
                                                    ".mlp.fc2"};
  for (std::size_t module = 0; module < kModules.size(); ++module)
    for (std::size_t layer = 0; layer < kLayers.size(); ++layer)
      if (name.starts_with(kModules[module]) && name.find(kLayers[layer]) != std::string_view::npos)
        return 4 * module + layer;
  constexpr std::array<std::string_view, 5> kOthers{"camera_head.", "aggregator.", "depth_head.",
                                                    "point_head.", "feature_extractor."};
  for (std::size_t i = 0; i < kOthers.size(); ++i)
    if (name.starts_with(kOthers[i])) return kNumLinearKinds - 1 + i;
  return kUnetKind;
}

// How each kind of layer keeps its packed weights. Norms, tokens and biases are always float32.
struct StoragePolicy {
  std::array<Storage, kLayerKinds.size()> kinds{};  // float32

  // The policy that a single name stands for.
  //
  // The decoder's UNets stay float32 in all: batch norms are folded into their convolutions, they
  // hold half a percent of the weights, and nothing comes after them that would hide a rounding
  // (bf16 in them alone costs 0.7% of the semantics).
  //
  // int8 is for the linear layers of the transformer blocks: integer products with activations
  // rounded token by token. By weights_sensitivity, on the published sizes, each kind of them costs
  // 0.5% to 1.2% of the semantics and the squares add up. dino.proj costs 1.1% for a twelfth of the
  // encoder's products, the most for what it saves, and keeps bf16; so do what has no integer
  // product, and the camera head, which has little work and sets every point of the frame.
  static constexpr StoragePolicy of(Storage storage) {
    StoragePolicy policy;
    for (std::size_t i = 0; i < kUnetKind; ++i)
      policy.kinds[i] = storage == Storage::kI8 && (i == kDinoProjKind || i >= kFirstCameraKind)
                            ? Storage::kBf16
                            : storage;
    return policy;
  }

  // Changes the kinds that `kinds_named` means: one of kLayerKinds, or all of a module ("dino"), or
  // a layer of all modules ("fc2"). `option` opens the message when there is none (kUsage) or when
  // they cannot take the storage (kUnsupported).
  void set(std::string_view kinds_named, Storage storage, std::string_view option) {
    bool found = false;
    for (std::size_t i = 0; i < kLayerKinds.size(); ++i) {
      const std::string_view kind = kLayerKinds[i];
      const std::size_t dot = kind.find('.');
      if (kinds_named != kind && kinds_named != kind.substr(0, dot) &&
          (dot == std::string_view::npos || kinds_named != kind.substr(dot + 1)))
        continue;
      if (storage == Storage::kI8 && i >= kNumLinearKinds)
        fail(ErrorKind::kUnsupported, option, ": ", kind, " cannot be int8: its layers are ",
             "convolutions, which take f32, bf16 or f16");
      kinds[i] = storage;
      found = true;
    }
    if (found) return;
    std::string all;
    for (const std::string_view kind : kLayerKinds)
      all += (all.empty() ? "" : ", ") + std::string(kind);
    fail(ErrorKind::kUsage, option, ": '", kinds_named, "' is none of the kinds of layers (", all,
         "), nor one side of their dots");
  }

  // For the weight of that name in the checkpoint.
  constexpr Storage of_weight(std::string_view name) const { return kinds[layer_kind(name)]; }

  friend constexpr bool operator==(const StoragePolicy&, const StoragePolicy&) = default;
};

}  // namespace lvggt
