// SPDX-License-Identifier: Apache-2.0
#include "examples/query_video/pictures.h"

#include <algorithm>
#include <cmath>

#include "lvggt/cli/output_folder.h"
#include "lvggt/cli/progress.h"
#include "lvggt/field/contact_sheet.h"
#include "lvggt/field/frame_files.h"
#include "lvggt/field/heat_map.h"
#include "lvggt/io/ply.h"
#include "lvggt/io/png.h"

namespace query_video {

using namespace lvggt;

namespace {

constexpr std::size_t kColumns = 8, kRows = 8;  // of the sheet, without the frames themselves
constexpr std::size_t kRowName = 26;            // characters of a question beside its row

Tensor<std::uint8_t, 2> copy_of(View<const std::uint8_t, 2> mask) {
  Tensor<std::uint8_t, 2> copy(mask.shape());
  for (std::int64_t y = 0; y < mask.extent(0); ++y)
    std::copy_n(mask[y].data(), mask.extent(1), copy[y].data());
  return copy;
}

}  // namespace

AnswerFiles::AnswerFiles(std::string out, const Outputs& outputs, const LiftedField& field)
    : out_(std::move(out)),
      outputs_(outputs),
      painted_(Shape{field.height(), field.width(), std::int64_t{3}}),
      colors_(Shape{field.height(), field.width(), std::int64_t{3}}),
      scalars_(Shape{std::int64_t{2}, field.height(), field.width(), std::int64_t{1}}),
      cloud_(outputs.points ? field.height() : 1, outputs.points ? field.width() : 1, 2, 1) {}

void AnswerFiles::open(const std::string& folder) const {
  const std::string path = out_ + "/" + folder;
  cli::create_output_folder(path);
  if (outputs_.masks) cli::create_output_folder(path + "/mask");
  if (outputs_.heat) cli::create_output_folder(path + "/heat");
  if (outputs_.points) cli::create_output_folder(path + "/points");
}

void AnswerFiles::write_heat(const std::string& folder, const FrameInputs& frame,
                             const FrameAnswer& answer) {
  if (!outputs_.heat) return;
  paint_heat_map(painted_, frame.picture, answer.relevancy, answer.mask);
  write_png(out_ + "/" + folder + "/heat/" + frame_stem(frame.record.index) + ".png", painted_);
}

void AnswerFiles::write_answer(const std::string& folder, const FrameInputs& frame,
                               View<const float, 2> relevancy, View<const std::uint8_t, 2> mask,
                               Context& ctx) {
  const std::string path = out_ + "/" + folder, stem = frame_stem(frame.record.index);
  if (outputs_.masks) {
    Tensor<std::uint8_t, 3> picture(Shape{mask.extent(0), mask.extent(1), std::int64_t{1}});
    for (std::int64_t y = 0; y < mask.extent(0); ++y)
      for (std::int64_t x = 0; x < mask.extent(1); ++x)
        picture(y, x, 0) = mask(y, x) != 0 ? std::uint8_t{255} : std::uint8_t{0};
    write_png(path + "/mask/" + stem + ".png", picture);
  }
  if (outputs_.points) write_points(path + "/points/" + stem + ".ply", frame, relevancy, mask, ctx);
}

void AnswerFiles::write_points(const std::string& path, const FrameInputs& frame,
                               View<const float, 2> relevancy, View<const std::uint8_t, 2> mask,
                               Context& ctx) {
  paint_answer(painted_, frame.picture, mask);
  for (std::int64_t i = 0; i < colors_.size(); ++i)
    colors_.data()[i] = static_cast<float>(painted_.data()[i]) / 255;
  for (std::int64_t y = 0; y < mask.extent(0); ++y)
    for (std::int64_t x = 0; x < mask.extent(1); ++x) {
      scalars_(0, y, x, 0) = relevancy ? relevancy(y, x) : 0;
      scalars_(1, y, x, 0) = mask(y, x);
    }
  cloud_.build({frame.depth, frame.confidence, colors_, scalars_, frame.record.camera},
               kConfidencePercentile, ctx);
  PlyPoints points{cloud_.positions(), cloud_.colors(),         cloud_.confidence(),
                   cloud_.semantics(), {"relevancy", "answer"}, frame.record.timestamp};
  if (!relevancy) {
    points.semantics = points.semantics.narrow(1, 1, 2);
    points.level_names = {"answer"};
  }
  points.plain_names = true;
  write_ply(path, points);
}

AnswerSheet::AnswerSheet(std::size_t num_frames, const std::vector<Result>& results) {
  for (std::size_t i = 0; i < results.size() && shown_.size() < kRows; ++i) shown_.push_back(i);
  // States come last and are few: the last row is theirs when there are more phrases than rows.
  if (results.size() > kRows && results.back().state && !results[kRows - 1].state)
    shown_.back() = results.size() - 1;
  const std::size_t count = std::min(num_frames, kColumns);
  for (std::size_t i = 0; i < count; ++i) {
    Column column;
    column.frame = count == 1 ? 0 : (i * (num_frames - 1) + (count - 1) / 2) / (count - 1);
    column.heat.resize(shown_.size());
    column.masks.resize(shown_.size());
    columns_.push_back(std::move(column));
  }
}

AnswerSheet::Column* AnswerSheet::column_of(std::size_t i) {
  const auto found = std::find_if(columns_.begin(), columns_.end(),
                                  [&](const Column& column) { return column.frame == i; });
  return found == columns_.end() ? nullptr : &*found;
}

void AnswerSheet::add_frame(std::size_t i, const FrameInputs& frame) {
  Column* column = column_of(i);
  if (column == nullptr) return;
  column->caption =
      concat("#", frame.record.index, "  ", cli::fixed(frame.record.timestamp, 2), " s");
  column->picture = frame.picture.clone();
}

void AnswerSheet::add_answer(std::size_t i, std::size_t question, const FrameInputs& frame,
                             const FrameAnswer& answer) {
  Column* column = column_of(i);
  const auto row = std::find(shown_.begin(), shown_.end(), question);
  if (column == nullptr || row == shown_.end()) return;
  const auto at = static_cast<std::size_t>(row - shown_.begin());
  column->masks[at] = copy_of(answer.mask);
  column->heat[at] = Tensor<std::uint8_t, 3>(frame.picture.shape());
  paint_heat_map(column->heat[at], frame.picture, answer.relevancy, answer.mask);
}

Tensor<std::uint8_t, 3> AnswerSheet::render(const std::vector<Result>& results,
                                            const std::string& title) const {
  std::vector<std::string> rows{"frames"};
  for (const std::size_t question : shown_) {
    const Result& result = results[question];
    rows.push_back(result.text.size() > kRowName ? result.text.substr(0, kRowName - 2) + ".."
                                                 : result.text);
  }
  ContactSheet::Options options;
  options.max_columns = kColumns;
  options.title = title;
  options.footer = "heat: relevancy, blue low, red high, outlined where it is found";
  if (!results.empty() && results.back().state)
    options.footer += "; states: orange where they hold, blue where not";
  ContactSheet sheet(rows, options);
  for (const Column& column : columns_) {
    std::vector<View<const std::uint8_t, 3>> pictures{column.picture};
    std::vector<Tensor<std::uint8_t, 3>> painted;
    painted.reserve(shown_.size());  // views into it stay
    for (std::size_t row = 0; row < shown_.size(); ++row) {
      const Result& result = results[shown_[row]];
      if (!result.state) {
        pictures.push_back(column.heat[row]);
        continue;
      }
      painted.emplace_back(column.picture.shape());
      paint_answer(painted.back(), column.picture, column.masks[row],
                   result.positive[column.frame] != 0 ? kAnswerColor : kNegativeColor);
      pictures.push_back(painted.back());
    }
    sheet.add(column.caption, pictures);
  }
  return sheet.render();
}

}  // namespace query_video
