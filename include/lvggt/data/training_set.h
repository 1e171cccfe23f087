// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/data/scene.h"
#include "lvggt/data/split.h"
#include "lvggt/data/supervision.h"
#include "lvggt/data/token_cache.h"

namespace lvggt {

// The size of the targets, and so of the decoder's output in the loss.
enum class TargetSize {
  kModelFrame,  // the pixels the encoder saw: labels follow the same crop, resize and padding
  kOriginal,    // the picture as it is ("gt" of the release); the output is stretched over it
};

struct TrainingSetOptions {
  std::vector<std::string> scenes;  // folders
  // Folder of the tokens: that of the only scene, or one that holds a folder named as each scene.
  // Empty: <scene>/lvggt_tokens.
  std::string tokens;
  SupervisionSpec supervision;
  SplitOptions split;
  TargetSize target = TargetSize::kModelFrame;
  // Read every label map before training, to find labels that name no feature; otherwise headers
  // and features only, and a bad label is found when its frame comes up.
  bool check_labels = true;
  // What the tokens must have been made with, if given.
  std::optional<ModelConfig> config;            // the decoder's: sizes of the encoder must agree
  std::optional<std::string> encoder_sha256;    // of the weights
  std::optional<PreprocessOptions> preprocess;  // mode, size, turn
};

// One frame to learn from or to test on.
struct Sample {
  std::size_t scene = 0;  // index of the scene
  SceneFrame frame;
  std::string rows_path, codes_path;  // NAME_s.npy and NAME_f.npy
  std::int64_t h = 0, w = 0;          // patches
  std::int64_t H = 0, W = 0;          // of the targets
  std::int64_t labelled = -1;         // labels over all levels, in the files; -1 if not counted
};

// Where a sample's values go; an empty view is left out.
struct SampleViews {
  std::array<View<float, 2>, 4> taps;  // [h*w, 2C]
  View<float, 3> image;                // [H, W, 3], in [0, 1]
  View<float, 4> features;             // [levels, H, W, d]
  View<float, 3> mask;                 // [levels, H, W]
};

// All frames of all scenes with their files checked. Immutable; read() may be called by several
// threads at once.
class TrainingSet {
 public:
  // Checks, before any training time is spent and without decoding a picture: that each frame of
  // both parts has its picture, label map, features and tokens, that their sizes agree with each
  // other, with the tokens' manifest and with the options, that features are finite, and (with
  // check_labels) that each label names one. The first problems are listed in one Error that names
  // scene, frame and reason; its kind is that of the first. Frames of one scene have one size.
  static TrainingSet open(const TrainingSetOptions& options, Context& ctx);

  const std::vector<Sample>& samples(Part part) const {
    return part == Part::kTrain ? train_ : held_out_;
  }
  const std::vector<Scene>& scenes() const { return scenes_; }
  const TokenCache& tokens(const Sample& sample) const { return tokens_[sample.scene]; }
  const SupervisionSpec& supervision() const { return options_.supervision; }
  std::int64_t channels() const { return tokens_.front().manifest().channels(); }  // 2C of the taps
  std::int64_t patch_size() const { return tokens_.front().manifest().settings.config.patch_size; }

  // Reads one sample. Errors name the file and why, as at open().
  void read(const SampleViews& out, const Sample& sample) const;

  // SHA-256 of what was learned about the data: frames of both parts, their files' sizes and
  // shapes, features, labels (if read), the manifests of the tokens, the supervision and the target
  // size. A checkpoint carries it, so that a run is not continued on other data.
  const std::string& manifest_sha256() const { return manifest_sha256_; }

  // Settings and counts for people and for checkpoints, name and value.
  std::vector<std::pair<std::string, std::string>> description() const;

  // Oddities that are no errors, such as gaps in frame numbers or frames without any label.
  const std::vector<std::string>& warnings() const { return warnings_; }

 private:
  TrainingSet() = default;
  struct Finding;
  void add_scene(const std::string& path);
  void check_samples(Context& ctx);
  Finding check_sample(Sample& sample) const;

  TrainingSetOptions options_;
  std::vector<Scene> scenes_;
  std::vector<TokenCache> tokens_;  // one a scene
  std::vector<Sample> train_, held_out_;
  std::string manifest_sha256_;
  std::vector<std::string> warnings_;
};

}  // namespace lvggt
