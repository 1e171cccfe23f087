// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/model/config.h"

namespace lvggt {

// One tensor of a checkpoint, by its published name.
struct TensorSpec {
  std::string name;
  std::vector<std::int64_t> shape;

  std::int64_t volume() const {
    std::int64_t n = 1;
    for (const std::int64_t extent : shape) n *= extent;
    return n;
  }
};

// All tensors of the geometry checkpoint: aggregator.*, camera_head.*, point_head.*, depth_head.*,
// without the track head. aggregator.patch_embed.mask_token is listed though it is not used.
std::vector<TensorSpec> geometry_tensors(const ModelConfig& config);

// All tensors of the decoder checkpoint with the running statistics of its batch norms, without
// their num_batches_tracked: feature_extractor.*, lang_encoder.*, rgb_encoder.*,
// lang_decoder_{small,middle, large}.* (or lang_decoder.* for a single level), rgb_decoder.*. Names
// of our own, for the ablations: feature_extractor.project (no DPT: 1x1 over the last tap's tokens)
// and <head>.mlp.0, <head>.mlp.2 (1x1 convolutions through 4 * sbd_hidden_dim channels; no
// encoders).
std::vector<TensorSpec> decoder_tensors(const ModelConfig& config);

// Whether the name is one of a decoder's tensors, by its prefix.
bool is_decoder_tensor(std::string_view name);

// Prefixes of the language decoders, in the order of the levels, without a final dot.
std::vector<std::string> language_decoder_names(const ModelConfig& config);

// What a published checkpoint may hold beyond the lists above: track_head.*, mask_token,
// num_batches_tracked; and train.*, the optimiser's state in a checkpoint of a training.
bool known_unused_tensor(std::string_view name);

}  // namespace lvggt
