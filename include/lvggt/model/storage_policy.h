// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string_view>

#include "lvggt/core/storage.h"

namespace lvggt {

// How each kind of layer keeps its packed weights. Norms, tokens and biases are always float32.
struct StoragePolicy {
  Storage dino = Storage::kF32;        // linear layers of the DINOv2 blocks
  Storage aggregator = Storage::kF32;  // of the frame and global blocks
  Storage camera = Storage::kF32;      // of the camera head
  Storage heads = Storage::kF32;       // convolutions of all heads and of the decoder; not int8

  // The policy that a single name stands for. int8 is for the linear layers of the transformer
  // blocks: integer products with activations rounded token by token; poses and dense outputs come
  // from layers too sensitive or of a kind that has no integer product, which keep bf16.
  static constexpr StoragePolicy of(Storage storage) {
    if (storage != Storage::kI8) return {storage, storage, storage, storage};
    return {Storage::kI8, Storage::kI8, Storage::kBf16, Storage::kBf16};
  }

  // For the weight of that name in the checkpoint.
  constexpr Storage linear(std::string_view name) const {
    if (name.starts_with("aggregator.patch_embed.")) return dino;
    if (name.starts_with("aggregator.")) return aggregator;
    if (name.starts_with("camera_head.")) return camera;
    return heads;
  }
  constexpr Storage conv(std::string_view name) const {
    const Storage storage = linear(name);
    return storage == Storage::kI8 ? Storage::kBf16 : storage;
  }
  friend constexpr bool operator==(const StoragePolicy&, const StoragePolicy&) = default;
};

}  // namespace lvggt
