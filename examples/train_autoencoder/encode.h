// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/data/scene.h"
#include "lvggt/data/supervision.h"
#include "lvggt/language/autoencoder.h"

namespace train_autoencoder {

struct EncodeOptions {
  lvggt::Supervision kind = lvggt::Supervision::kClip;
  std::string root;      // see feature_files
  std::string sha256;    // of the autoencoder, kept beside the codes
  bool replace = false;  // codes that are there already; else they are an error
  bool resume = false;   // keep those that this autoencoder made
};

// Writes the compact codes of all frames of a scene, with a copy of the label maps, each file when
// it is complete. Rows of zeros (objects without a sentence) stay zeros. Returns the number of
// frames written; calls progress() after each and stops when it returns false. Errors: kUsage for
// codes that are there already, kMismatch for those of another autoencoder.
std::int64_t encode_scene(const lvggt::Scene& scene, const lvggt::Autoencoder& autoencoder,
                          const EncodeOptions& options, const std::function<bool()>& progress,
                          lvggt::Context& ctx);

}  // namespace train_autoencoder
