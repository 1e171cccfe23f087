// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <string>
#include <vector>

#include "examples/query_video/pictures.h"
#include "examples/query_video/results.h"

namespace query_video {

// Where the files of the answers go; without a folder there are none.
struct AnswerTarget {
  std::string out;
  Outputs outputs;
  std::string sheet, time_lines;  // names in the folder; empty: not written

  bool per_frame() const {
    return !out.empty() && (outputs.masks || outputs.heat || outputs.points);
  }
  bool needs_pictures() const { return !out.empty() && (per_frame() || outputs.sheet); }
};

// Collects the answers to some questions, frame by frame, and writes their files on the way.
class Answers {
 public:
  using ReadInputs = std::function<FrameInputs(std::size_t)>;

  // The clip, the field and read_inputs must outlive it. Makes the folders of the questions.
  Answers(const Clip& clip, const lvggt::LiftedField& field, const lvggt::Questions& questions,
          const AnswerTarget& target, ReadInputs read_inputs);

  // Frames come in order, and all answers about one before the next.
  void start_frame();
  void take(const lvggt::FrameAnswer& answer, lvggt::Context& ctx);

  // After the last frame: the series and intervals, the files of states, the overview.
  std::vector<Result> finish(lvggt::Context& ctx);

 private:
  void write_states(lvggt::Context& ctx);
  void write_overview() const;

  const Clip& clip_;
  AnswerTarget target_;
  ReadInputs read_inputs_;
  std::vector<Result> results_;
  std::size_t num_phrases_;
  AnswerFiles files_;
  AnswerSheet sheet_;
  std::string title_;
  std::size_t num_frames_ = 0;  // started
  FrameInputs frame_;           // the last one started
  lvggt::Tensor<std::uint8_t, 2> nothing_;
  // Of states, until it is known where they hold: frame by frame, state by state.
  std::vector<std::vector<bool>> state_masks_;
};

}  // namespace query_video
