// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "lvggt/field/field_query.h"
#include "lvggt/field/time_line.h"
#include "lvggt/io/cameras_json.h"
#include "lvggt/io/json_writer.h"

namespace query_video {

// What was found in one frame.
struct FrameResult {
  std::int64_t level = 0;
  float score = 0, similarity = 0;
  bool found = false;                 // of a phrase: score above the least one
  std::int64_t pixels = 0;            // of the mask; 0 when nothing is found
  std::array<std::int64_t, 4> box{};  // x, y, width, height of the mask
};

// The answer to one question over the whole clip.
struct Result {
  std::string text, folder;  // folder: in the output folder, empty without
  bool state = false;
  std::vector<FrameResult> frames;
  lvggt::TimeAnswer time;                       // of a state
  std::vector<std::uint8_t> positive;           // of either kind, one a frame
  std::vector<lvggt::FrameInterval> intervals;  // positions in the list of frames, inclusive
};

// Where and when the frames were, and how the levels are called.
struct Clip {
  std::vector<lvggt::CameraRecord> frames;
  std::vector<std::string> levels;
  std::int64_t height = 0, width = 0;
  double min_score = 0.5;
};

// "001_the_cup": letters and digits of the text, the rest as underscores, at most 32 of them.
std::string folder_name(std::size_t number, const std::string& text);

// Pixels and box of a mask.
void measure(FrameResult& result, lvggt::View<const std::uint8_t, 2> mask);

// Once all frames are in: the series, the positive frames and the intervals.
void conclude(Result& result);

// One or two lines for people: where it was found, or when the state holds.
std::string sentence_about(const Result& result, const Clip& clip);

lvggt::TimeLine time_line_of(const Result& result, const Clip& clip);

// "results": [...] of the JSON document, everything that is known.
void write_results(lvggt::JsonWriter& json, const std::vector<Result>& results, const Clip& clip);

}  // namespace query_video
