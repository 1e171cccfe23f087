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

// The two files of a frame before the autoencoder: label map and features of full width.
struct FeatureFiles {
  std::string labels, features;
  // Where the same frame's files with compact codes belong.
  std::string compact_folder, compact_labels, compact_features;
};

// The files of a frame; Neu3D ones are found under both spellings. `root` is the folder that the
// compact ones go to, the scene's own if empty. Errors: kRead for a missing file.
FeatureFiles feature_files(const lvggt::Scene& scene, const lvggt::SceneFrame& frame,
                           lvggt::Supervision kind, std::int64_t code_width,
                           const std::string& root);

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
