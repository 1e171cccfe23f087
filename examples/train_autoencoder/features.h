// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/data/scene.h"
#include "lvggt/data/split.h"
#include "lvggt/data/supervision.h"

namespace train_autoencoder {

// Features to learn from and to test on.
struct FeatureSet {
  lvggt::Tensor<float, 2> train, held_out;  // [N, D]
  std::int64_t frames = 0, held_out_frames = 0;
  std::int64_t empty_rows = 0;  // all zero: objects without a sentence, left out
  std::string sha256;           // of the values of both parts
};

// All features of the scenes' frames, split by frame. Errors: those of NpyFile; kMismatch for
// another width than `width`; kNumeric for values that are not finite; kFormat when there is
// nothing to learn from.
FeatureSet read_features(const std::vector<lvggt::Scene>& scenes, lvggt::Supervision kind,
                         std::int64_t width, const lvggt::SplitOptions& split);

// Width of the features of the first frame.
std::int64_t feature_width(const lvggt::Scene& scene, lvggt::Supervision kind);

}  // namespace train_autoencoder
