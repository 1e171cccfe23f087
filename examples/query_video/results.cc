// SPDX-License-Identifier: Apache-2.0
#include "examples/query_video/results.h"

#include <algorithm>
#include <numeric>

#include "lvggt/cli/progress.h"

namespace query_video {

using namespace lvggt;
using cli::fixed;

namespace {

// Position of the frame that answers best.
std::size_t best_frame(const Result& result) {
  const auto value = [&](const FrameResult& frame) {
    return result.state ? frame.similarity : frame.score;
  };
  return static_cast<std::size_t>(std::max_element(result.frames.begin(), result.frames.end(),
                                                   [&](const FrameResult& a, const FrameResult& b) {
                                                     return value(a) < value(b);
                                                   }) -
                                  result.frames.begin());
}

std::string interval_text(const FrameInterval& interval, const Clip& clip) {
  const CameraRecord& first = clip.frames[static_cast<std::size_t>(interval.first)];
  const CameraRecord& last = clip.frames[static_cast<std::size_t>(interval.second)];
  if (interval.first == interval.second)
    return concat("frame ", first.index, " (", fixed(first.timestamp, 2), " s)");
  return concat("frames ", first.index, "-", last.index, " (", fixed(first.timestamp, 2), "-",
                fixed(last.timestamp, 2), " s)");
}

void write_frames(JsonWriter& json, const Result& result, const Clip& clip) {
  json.key("frames");
  json.begin_array();
  for (std::size_t i = 0; i < result.frames.size(); ++i) {
    const FrameResult& frame = result.frames[i];
    json.begin_object();
    json.field("index", clip.frames[i].index);
    json.field("timestamp", clip.frames[i].timestamp);
    if (result.state) {
      json.field("similarity", frame.similarity);
      json.field("smoothed", result.time.smoothed[i]);
    }
    json.field(result.state ? "positive" : "found", result.positive[i] != 0);
    json.field("score", frame.score);
    json.field("level", clip.levels[static_cast<std::size_t>(frame.level)]);
    json.field("pixels", frame.pixels);
    json.key("box");
    if (frame.pixels == 0)
      json.null();
    else
      json.numbers(frame.box);
    json.end_object();
  }
  json.end_array();
}

}  // namespace

std::string folder_name(std::size_t number, const std::string& text) {
  constexpr std::size_t kLongest = 32;
  std::string name = std::to_string(number);
  name.insert(0, name.size() < 3 ? 3 - name.size() : 0, '0');
  name += '_';
  const std::size_t start = name.size();
  for (const char c : text) {
    const char lower = c >= 'A' && c <= 'Z' ? static_cast<char>(c - 'A' + 'a') : c;
    const bool plain = (lower >= 'a' && lower <= 'z') || (lower >= '0' && lower <= '9');
    if (plain)
      name += lower;
    else if (name.back() != '_')
      name += '_';
    if (name.size() == start + kLongest) break;
  }
  while (name.back() == '_') name.pop_back();
  return name;
}

void measure(FrameResult& result, View<const std::uint8_t, 2> mask) {
  const auto [H, W] = mask.shape();
  std::int64_t left = W, right = -1, top = H, bottom = -1;
  result.pixels = 0;
  for (std::int64_t y = 0; y < H; ++y) {
    for (std::int64_t x = 0; x < W; ++x) {
      if (mask(y, x) == 0) continue;
      ++result.pixels;
      left = std::min(left, x);
      right = std::max(right, x);
      top = std::min(top, y);
      bottom = std::max(bottom, y);
    }
  }
  if (result.pixels > 0) result.box = {left, top, right - left + 1, bottom - top + 1};
}

void conclude(Result& result) {
  if (result.state) {
    std::vector<float> series;
    for (const FrameResult& frame : result.frames) series.push_back(frame.similarity);
    result.time = answer_over_time(series);
    result.positive = result.time.positive;
  } else {
    for (const FrameResult& frame : result.frames) result.positive.push_back(frame.found);
  }
  std::vector<std::int64_t> positions(result.frames.size());
  std::iota(positions.begin(), positions.end(), 0);
  result.intervals = positive_intervals(result.positive, positions);
}

std::string sentence_about(const Result& result, const Clip& clip) {
  const std::size_t best = best_frame(result);
  const FrameResult& frame = result.frames[best];
  std::string text = "\"" + result.text + "\": ";
  if (!result.state) {
    const auto count = std::count(result.positive.begin(), result.positive.end(), 1);
    if (count == 0)
      return text + concat("not found: its relevancy reaches ", fixed(frame.score, 2),
                           ", and more than ", fixed(clip.min_score, 2), " is asked for");
    return text + concat("found in ", count, " of ", result.frames.size(),
                         " frames, best in frame ", clip.frames[best].index, " (",
                         fixed(clip.frames[best].timestamp, 2), " s): relevancy ",
                         fixed(frame.score, 2), ", level ",
                         clip.levels[static_cast<std::size_t>(frame.level)], ", ", frame.pixels,
                         " pixels");
  }
  text += result.intervals.empty() ? "never holds" : "holds in ";
  for (std::size_t i = 0; i < result.intervals.size(); ++i)
    text += (i == 0 ? "" : ", ") + interval_text(result.intervals[i], clip);
  return text + concat("; similarity up to ", fixed(frame.similarity, 3), " against the mean ",
                       fixed(result.time.threshold, 3));
}

TimeLine time_line_of(const Result& result, const Clip& clip) {
  TimeLine line;
  line.title = (result.state ? "state: " : "") + result.text;
  line.value_name = result.state ? "similarity" : "relevancy";
  line.smoothed_name = "smoothed";
  for (const CameraRecord& frame : clip.frames) line.seconds.push_back(frame.timestamp);
  for (const FrameResult& frame : result.frames)
    line.values.push_back(result.state ? frame.similarity : frame.score);
  line.smoothed = result.time.smoothed;
  line.threshold = result.state ? result.time.threshold : static_cast<float>(clip.min_score);
  line.positive = result.positive;
  return line;
}

void write_results(JsonWriter& json, const std::vector<Result>& results, const Clip& clip) {
  json.key("results");
  json.begin_array();
  for (const Result& result : results) {
    json.begin_object();
    json.field(result.state ? "state" : "phrase", result.text);
    if (!result.folder.empty()) json.field("folder", result.folder);
    const std::size_t best = best_frame(result);
    json.field("best_frame", clip.frames[best].index);
    json.field("frames_positive", std::count(result.positive.begin(), result.positive.end(), 1));
    json.field("threshold",
               result.state ? static_cast<double>(result.time.threshold) : clip.min_score);
    json.key("intervals");
    json.begin_array();
    for (const FrameInterval& interval : result.intervals) {
      const CameraRecord& first = clip.frames[static_cast<std::size_t>(interval.first)];
      const CameraRecord& last = clip.frames[static_cast<std::size_t>(interval.second)];
      json.begin_object();
      json.field("first", first.index);
      json.field("last", last.index);
      json.field("first_seconds", first.timestamp);
      json.field("last_seconds", last.timestamp);
      json.end_object();
    }
    json.end_array();
    write_frames(json, result, clip);
    json.end_object();
  }
  json.end_array();
}

}  // namespace query_video
