// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "lvggt/data/training_set.h"
#include "lvggt/field/contact_sheet.h"
#include "lvggt/field/semantic_colors.h"
#include "lvggt/model/config.h"
#include "lvggt/train/communicator.h"
#include "lvggt/train/decoder_trainer.h"
#include "lvggt/train/scores.h"
#include "lvggt/train/training_log.h"

namespace train_decoder {

// How well the decoder does on the held-out frames.
struct HeldOutScores {
  double l1 = 0;                         // language, as in the loss
  std::optional<double> psnr;            // of the RGB head, mean over frames
  std::optional<double> mean_iou;        // over levels, scenes and classes
  std::optional<double> state_accuracy;  // share of (frame, changing object) with the right state

  struct ClassIou {
    std::string scene, level;
    std::size_t code = 0;
    std::vector<float> values;  // of the code
    std::optional<double> iou;
  };
  std::vector<ClassIou> classes;
  struct State {
    std::string scene, frame;
    std::int64_t object = 0;
    std::optional<std::size_t> predicted, truth;  // codes of the scene
  };
  std::vector<State> states;

  // What decides which checkpoint is the best: larger is better.
  double ranking() const { return mean_iou ? *mean_iou : -l1; }
  std::string text() const;  // one line for people
  void add_to(lvggt::LogLine& line) const;
  std::string json(std::int64_t step) const;
};

// Tests a decoder on the held-out frames: every pixel's vector is taken for the nearest compact
// code of its scene. The frames are divided among the ranks; the contact sheet shows those of rank
// 0.
class HeldOut {
 public:
  // Reads the codes of all frames of the scenes.
  HeldOut(const lvggt::TrainingSet& set, const lvggt::ModelConfig& config, std::int64_t columns);

  bool empty() const { return samples_.empty(); }

  struct Result {
    HeldOutScores scores;
    lvggt::Tensor<std::uint8_t, 3> sheet;  // empty but on rank 0
  };
  Result test(lvggt::DecoderTrainer& trainer, bool averaged, std::int64_t step,
              lvggt::Communicator& communicator);

 private:
  struct Frame;
  struct Sums;
  void predict(Frame& frame, const lvggt::Sample& sample, lvggt::DecoderTrainer& trainer,
               bool averaged) const;
  void count(Sums& sums, std::size_t i, const Frame& frame) const;
  void draw(lvggt::ContactSheet& sheet, const Frame& frame, const lvggt::Sample& sample);
  HeldOutScores scores(const Sums& sums) const;
  void score_classes(HeldOutScores& result, const Sums& sums) const;
  void score_states(HeldOutScores& result, const Sums& sums) const;
  std::vector<std::string> row_names() const;

  const lvggt::TrainingSet& set_;
  lvggt::ModelConfig config_;
  const std::vector<lvggt::Sample>& samples_;
  std::size_t columns_;
  std::vector<lvggt::SceneCodes> codes_;  // of each scene
  std::vector<std::string> levels_;
  lvggt::SemanticColors colors_;
};

}  // namespace train_decoder
