// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <vector>

#include "lvggt/train/decoder_trainer.h"
#include "tests/support/random.h"

namespace lvggt::test {

// A decoder small enough for finite differences.
inline ModelConfig small_decoder_config() {
  ModelConfig config;
  config.embed_dim = 6;
  config.sbd_features = 6;
  config.sbd_out_channels = {4, 5, 6, 7};
  config.sbd_hidden_dim = 4;
  return config;
}

// A batch that owns its tensors; about a fifth of the pixels are holes.
class OwnedBatch {
 public:
  OwnedBatch(const ModelConfig& config, std::int64_t B, std::int64_t h, std::int64_t w,
             std::int64_t H, std::int64_t W, std::uint32_t seed = 1) {
    for (std::size_t i = 0; i < 4; ++i)
      taps[i] = random_tensor(Shape{B, h * w, 2 * config.embed_dim},
                              seed + static_cast<std::uint32_t>(i));
    images = random_tensor(Shape{B, H, W, std::int64_t{3}}, seed + 5, 0, 1);
    features = random_tensor(Shape{B, config.sbd_levels, H, W, config.lang_dim}, seed + 6);
    mask = random_tensor(Shape{B, config.sbd_levels, H, W}, seed + 7, 0, 1);
    for (std::int64_t i = 0; i < mask.size(); ++i) mask.data()[i] = mask.data()[i] < 0.8f ? 1 : 0;
    batch = {h, w, {taps[0], taps[1], taps[2], taps[3]}, images, features, mask};
  }

  std::array<Tensor<float, 3>, 4> taps;
  Tensor<float, 4> images, mask;
  Tensor<float, 5> features;
  DecoderBatch batch;
};

// A store with fresh weights and a trainer over it.
struct TrainingRun {
  explicit TrainingRun(const ModelConfig& config, const TrainOptions& options = {}, int threads = 2,
                       std::uint64_t seed = 3)
      : ctx(threads),
        store(initialised(config, options, seed, ctx)),
        trainer(store, options, alone, ctx) {}

  std::vector<float> copy_of(StoreRole role) const {
    const std::span<const float> block = store.block(role);
    return {block.begin(), block.end()};
  }

  Context ctx;
  SingleProcess alone;
  ParameterStore store;
  DecoderTrainer trainer;

 private:
  static ParameterStore initialised(const ModelConfig& config, const TrainOptions& options,
                                    std::uint64_t seed, Context& ctx) {
    ParameterStore store(config, options.ema_decay > 0);
    store.initialise(seed, ctx);
    return store;
  }
};

}  // namespace lvggt::test
