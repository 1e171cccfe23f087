// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <string>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/data/scene.h"
#include "lvggt/data/supervision.h"
#include "lvggt/language/autoencoder.h"

namespace lvggt {

// A frame's features in full width, and where the same with compact codes belong.
struct FeatureFiles {
  std::string labels, features;
  std::string compact_folder, compact_labels, compact_features;
};

// clip_features or video_features.
std::string raw_feature_folder(Supervision kind);

// The files of a frame; Neu3D ones are found under both spellings. `root` is the folder that the
// compact ones go to, the scene's own if empty. Errors: kRead for a missing file.
FeatureFiles feature_files(const Scene& scene, const SceneFrame& frame, Supervision kind,
                           std::int64_t code_width, const std::string& root);

enum class ExistingCodes {
  kRefuse,   // an error
  kReplace,  // written again
  kKeep,     // those of the same autoencoder stay
};

// Writes the compact codes of frames, all of one folder, with a copy of the label maps, each file
// when it is complete. autoencoder.json beside them tells which autoencoder made them, by its
// SHA-256. Rows of zeros (objects without a sentence) stay zeros. Returns the number of frames
// written; calls progress() after each and stops when it returns false. Errors, before anything is
// written: kUsage for codes that are there already, kMismatch for those of another autoencoder, for
// one without an encoder (`path` is its file) and for features of another width.
std::int64_t write_compact_codes(const std::vector<FeatureFiles>& frames,
                                 const Autoencoder& autoencoder, const std::string& path,
                                 ExistingCodes existing, const std::function<bool()>& progress,
                                 Context& ctx);

}  // namespace lvggt
