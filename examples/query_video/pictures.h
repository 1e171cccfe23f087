// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "examples/query_video/results.h"
#include "lvggt/field/field_query.h"
#include "lvggt/field/lifted_field.h"
#include "lvggt/field/point_cloud.h"

namespace query_video {

// Which pictures and clouds of a question are written.
struct Outputs {
  bool masks = true, heat = true, points = true, sheet = true;
};

// One frame of a field as it was read.
struct FrameInputs {
  lvggt::CameraRecord record;
  lvggt::Tensor<std::uint8_t, 3> picture;     // [H, W, 3]
  lvggt::Tensor<float, 2> depth, confidence;  // [H, W], empty without
};

// The files of every frame in a question's folder: mask/NNNNNN.png, heat/NNNNNN.png,
// points/NNNNNN.ply.
class AnswerFiles {
 public:
  AnswerFiles(std::string out, const Outputs& outputs, const lvggt::LiftedField& field);

  // Makes the folders of a question.
  void open(const std::string& folder) const;

  void write_heat(const std::string& folder, const FrameInputs& frame,
                  const lvggt::FrameAnswer& answer);
  // The answer: an empty mask where nothing is found.
  void write_answer(const std::string& folder, const FrameInputs& frame,
                    lvggt::View<const float, 2> relevancy, lvggt::View<const std::uint8_t, 2> mask,
                    lvggt::Context& ctx);

 private:
  void write_points(const std::string& path, const FrameInputs& frame,
                    lvggt::View<const float, 2> relevancy, lvggt::View<const std::uint8_t, 2> mask,
                    lvggt::Context& ctx);

  std::string out_;
  Outputs outputs_;
  lvggt::Tensor<std::uint8_t, 3> painted_;  // [H, W, 3]
  lvggt::Tensor<float, 3> colors_;          // [H, W, 3]
  lvggt::Tensor<float, 4> scalars_;         // [2, H, W, 1]: relevancy, answer
  lvggt::PointCloud cloud_;
};

// One picture of all answers: some frames side by side, a row of heat maps for each of the first
// phrases, a row of answers for each of the first states. States are painted at the end, when it is
// known which frames are positive.
class AnswerSheet {
 public:
  AnswerSheet(std::size_t num_frames, const std::vector<Result>& results);

  // Of frame i in the order of the clip; `question` in the order of the results.
  void add_frame(std::size_t i, const FrameInputs& frame);
  void add_answer(std::size_t i, std::size_t question, const FrameInputs& frame,
                  const lvggt::FrameAnswer& answer);

  // The sheet, [H, W, 3].
  lvggt::Tensor<std::uint8_t, 3> render(const std::vector<Result>& results,
                                        const std::string& title) const;

 private:
  struct Column {
    std::size_t frame = 0;
    std::string caption;
    lvggt::Tensor<std::uint8_t, 3> picture;
    std::vector<lvggt::Tensor<std::uint8_t, 3>> heat;   // one a shown question, empty for states
    std::vector<lvggt::Tensor<std::uint8_t, 2>> masks;  // one a shown question, empty for phrases
  };
  Column* column_of(std::size_t i);

  std::vector<std::size_t> shown_;  // questions, by row
  std::vector<Column> columns_;
};

}  // namespace query_video
