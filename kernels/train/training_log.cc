// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/training_log.h"

#include <algorithm>
#include <cmath>

#include "lvggt/core/error.h"
#include "lvggt/field/line_plot.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/json_writer.h"

namespace lvggt {
namespace {

// The whole lines of the file, those that are JSON objects with a step.
std::vector<std::pair<std::string, Json>> whole_lines(const std::string& path) {
  std::vector<std::pair<std::string, Json>> lines;
  std::ifstream file(path, std::ios::binary);
  for (std::string line; std::getline(file, line);) {
    if (file.eof()) break;  // no newline: the writer was stopped in the middle
    try {
      Json json = Json::parse(line, path);
      const Json* step = json.find("step");
      if (step == nullptr || !step->is_integer()) continue;
      lines.emplace_back(line, std::move(json));
    } catch (const Error&) {
      // A line that a failing disk left damaged is no line.
    }
  }
  return lines;
}

}  // namespace

void LogLine::add_key(std::string_view key) {
  if (!members_.empty()) members_ += ", ";
  members_ += json_quote(key) + ": ";
}

void LogLine::add(std::string_view key, double value) {
  add_key(key);
  if (std::isfinite(value))
    append_number(members_, value);
  else
    members_ += "null";
}

void LogLine::add(std::string_view key, std::int64_t value) {
  add_key(key);
  append_number(members_, value);
}

void LogLine::add(std::string_view key, std::string_view value) {
  add_key(key);
  members_ += json_quote(value);
}

TrainingLog::TrainingLog(const std::string& path, bool append)
    : path_(path),
      file_(path, append ? std::ios::binary | std::ios::app : std::ios::binary | std::ios::trunc) {
  if (!file_) fail(ErrorKind::kWrite, path, ": cannot be written");
}

TrainingLog TrainingLog::start(const std::string& path) { return {path, false}; }

TrainingLog TrainingLog::resume(const std::string& path, std::int64_t step) {
  std::string kept;
  for (const auto& [text, json] : whole_lines(path))
    if (json.find("step")->as_int64(path) <= step) kept += text + "\n";
  write_file(path, kept);
  return {path, true};
}

void TrainingLog::append(const LogLine& line) {
  file_ << line.text() << '\n';
  if (!file_.flush()) fail(ErrorKind::kWrite, path_, ": cannot be written (is the disk full?)");
}

std::vector<Json> read_log(const std::string& path) {
  std::vector<Json> lines;
  for (auto& [text, json] : whole_lines(path)) lines.push_back(std::move(json));
  return lines;
}

std::vector<std::array<double, 2>> log_curve(const std::vector<Json>& lines, std::string_view key) {
  std::vector<std::array<double, 2>> points;
  for (const Json& line : lines) {
    const Json* value = line.find(key);
    if (value == nullptr || !value->is_number()) continue;
    points.push_back({line.find("step")->as_double("step"), value->as_double(key)});
  }
  return points;
}

std::string log_csv(const std::vector<Json>& lines) {
  std::vector<std::string> columns;
  for (const Json& line : lines)
    for (const auto& [key, value] : line.as_object("log"))
      if (std::find(columns.begin(), columns.end(), key) == columns.end()) columns.push_back(key);
  std::string text;
  for (const std::string& column : columns) text += (text.empty() ? "" : ",") + column;
  text += '\n';
  for (const Json& line : lines) {
    const char* comma = "";
    for (const std::string& column : columns) {
      text += comma;
      comma = ",";
      const Json* value = line.find(column);
      if (value == nullptr) continue;
      if (value->is_integer()) {
        append_number(text, value->as_int64(column));
      } else if (value->is_number()) {
        append_number(text, value->as_double(column));
      } else if (value->is_string()) {
        std::string quoted = "\"";
        for (const char c : value->as_string(column))
          quoted += c == '"' ? "\"\"" : std::string(1, c);
        text += quoted + '"';
      }
    }
    text += '\n';
  }
  return text;
}

Tensor<std::uint8_t, 3> draw_loss_curve(const std::vector<Json>& lines, const std::string& title) {
  struct Line {
    const char* key;
    const char* name;
    Rgb8 color;
  };
  const auto panel = [&](const std::string& heading, const std::vector<Line>& members,
                         bool logarithmic, bool smooth) {
    PlotPanel result{heading, "step", {}, logarithmic};
    for (const auto& [key, name, color] : members) {
      const auto points = log_curve(lines, key);
      if (points.empty()) continue;
      // The line through a fiftieth of the steps shows the course, the raw values their spread.
      const std::size_t window = smooth ? std::max<std::size_t>(5, points.size() / 50) : 1;
      if (smooth) result.curves.push_back({"", color, points, true});
      result.curves.push_back({name, color, moving_average(points, window), false});
    }
    return result;
  };
  constexpr Rgb8 kBlack{30, 30, 30}, kBlue{31, 119, 180}, kOrange{225, 110, 10},
      kGreen{30, 140, 60}, kRed{200, 40, 40}, kViolet{120, 80, 170};
  std::vector<PlotPanel> panels{panel(title + ": loss",
                                      {{"loss", "total", kBlack},
                                       {"l1", "language L1", kBlue},
                                       {"cos", "1 - cosine", kViolet},
                                       {"rgb_l1", "RGB L1", kOrange},
                                       {"rgb_l2", "RGB L2", kRed}},
                                      true, true)};
  for (auto& more :
       {panel("held-out mean IoU", {{"held_out_miou", "mean IoU", kGreen}}, false, false),
        panel("held-out state accuracy", {{"held_out_state_accuracy", "accuracy", kViolet}}, false,
              false),
        panel("held-out PSNR of RGB, dB", {{"held_out_psnr", "PSNR", kOrange}}, false, false),
        panel("learning rate", {{"learning_rate", "", kBlue}}, false, false)})
    if (!more.curves.empty()) panels.push_back(more);
  constexpr std::int64_t kWidth = 840, kPanelHeight = 230;
  return LinePlot(kWidth, kPanelHeight).draw(panels);
}

}  // namespace lvggt
