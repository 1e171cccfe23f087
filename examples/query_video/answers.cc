// SPDX-License-Identifier: Apache-2.0
#include "examples/query_video/answers.h"

#include <algorithm>

#include "lvggt/io/png.h"

namespace query_video {

using namespace lvggt;

namespace {

std::vector<bool> packed(View<const std::uint8_t, 2> mask) {
  std::vector<bool> bits;
  bits.reserve(static_cast<std::size_t>(mask.size()));
  for (std::int64_t y = 0; y < mask.extent(0); ++y)
    for (std::int64_t x = 0; x < mask.extent(1); ++x) bits.push_back(mask(y, x) != 0);
  return bits;
}

void unpack(Tensor<std::uint8_t, 2>& mask, const std::vector<bool>& bits) {
  for (std::int64_t i = 0; i < mask.size(); ++i)
    mask.data()[i] = bits[static_cast<std::size_t>(i)] ? 1 : 0;
}

std::vector<Result> open_results(const Questions& questions, bool folders) {
  std::vector<Result> results;
  for (const std::string& text : questions.all()) {
    Result result;
    result.text = text;
    result.state = results.size() >= questions.phrases.size();
    if (folders) result.folder = folder_name(results.size() + 1, text);
    results.push_back(std::move(result));
  }
  return results;
}

}  // namespace

Answers::Answers(const Clip& clip, const LiftedField& field, const Questions& questions,
                 const AnswerTarget& target, ReadInputs read_inputs)
    : clip_(clip),
      target_(target),
      read_inputs_(std::move(read_inputs)),
      results_(open_results(questions, target.per_frame())),
      num_phrases_(questions.phrases.size()),
      files_(target.out, target.outputs, field),
      sheet_(clip.frames.size(), results_),
      title_(field.path()),
      nothing_(Shape{clip.height, clip.width}) {
  if (target_.per_frame())
    for (const Result& result : results_) files_.open(result.folder);
}

void Answers::start_frame() {
  if (target_.needs_pictures()) {
    frame_ = read_inputs_(num_frames_);
    if (target_.outputs.sheet) sheet_.add_frame(num_frames_, frame_);
  }
  ++num_frames_;
}

void Answers::take(const FrameAnswer& given, Context& ctx) {
  FrameAnswer answer = given;
  const auto question = static_cast<std::size_t>(answer.question);
  Result& result = results_[question];
  FrameResult found;
  found.level = answer.level;
  found.score = answer.score;
  found.similarity = answer.similarity;
  found.found = static_cast<double>(answer.score) > clip_.min_score;
  if (!result.state && !found.found) answer.mask = nothing_;
  measure(found, answer.mask);
  result.frames.push_back(found);
  if (target_.needs_pictures() && target_.outputs.sheet)
    sheet_.add_answer(num_frames_ - 1, question, frame_, answer);
  if (!target_.per_frame()) return;
  files_.write_heat(result.folder, frame_, answer);
  if (result.state)
    state_masks_.push_back(packed(answer.mask));
  else
    files_.write_answer(result.folder, frame_, answer.relevancy, answer.mask, ctx);
}

std::vector<Result> Answers::finish(Context& ctx) {
  for (Result& result : results_) conclude(result);
  if (target_.per_frame()) write_states(ctx);
  if (target_.needs_pictures() && target_.outputs.sheet) write_overview();
  return std::move(results_);
}

// A state's answer in a frame is its object's mask where the state holds, and nothing elsewhere.
void Answers::write_states(Context& ctx) {
  const std::size_t num_states = results_.size() - num_phrases_;
  Tensor<std::uint8_t, 2> mask(nothing_.shape());
  for (std::size_t i = 0; num_states > 0 && i < num_frames_; ++i) {
    const FrameInputs frame = read_inputs_(i);
    for (std::size_t s = 0; s < num_states; ++s) {
      const Result& result = results_[num_phrases_ + s];
      unpack(mask, state_masks_[i * num_states + s]);
      files_.write_answer(result.folder, frame, {}, result.positive[i] != 0 ? mask : nothing_, ctx);
    }
  }
}

void Answers::write_overview() const {
  constexpr std::size_t kMostPanels = 12;
  if (!target_.sheet.empty())
    write_png(target_.out + "/" + target_.sheet, sheet_.render(results_, title_));
  if (target_.time_lines.empty()) return;
  std::vector<TimeLine> lines;
  for (std::size_t i = 0; i < std::min(results_.size(), kMostPanels); ++i)
    lines.push_back(time_line_of(results_[i], clip_));
  write_png(target_.out + "/" + target_.time_lines, draw_time_lines(lines));
}

}  // namespace query_video
