// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace lvggt {

// A set of frame numbers such as "1-48,60,72-80", ends included.
class FrameRanges {
 public:
  // `option` opens the message of the kUsage error that text of another form ends in.
  static FrameRanges parse(std::string_view text, std::string_view option);

  bool empty() const { return ranges_.empty(); }
  bool contains(std::int64_t number) const;
  std::string text() const;  // sorted and merged

 private:
  std::vector<std::pair<std::int64_t, std::int64_t>> ranges_;  // ascending, disjoint
};

// Which frames of every scene are trained on and which are held out, by the numbers in their file
// names.
struct SplitOptions {
  FrameRanges train;                // empty: all that are not held out
  FrameRanges held_out;             // empty: none, or every hold_out_every-th
  std::int64_t hold_out_every = 0;  // N > 0: the N-th, 2N-th, ... of a scene's frames are held out
};

enum class Part { kTrain, kHeldOut };

// Positions of frames in a scene, by part; a frame may be in neither.
struct Split {
  std::vector<std::int64_t> train, held_out;
};

// `numbers`: of the scene's frames, ascending; `scene` opens messages. kUsage when a frame would be
// in both parts, when both ways of holding out are given, when the scene has no frame to train on,
// or none of the held-out ranges.
Split split_frames(std::span<const std::int64_t> numbers, const SplitOptions& options,
                   const std::string& scene);

}  // namespace lvggt
