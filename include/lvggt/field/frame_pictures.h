// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/field/color_map.h"
#include "lvggt/field/semantic_colors.h"

namespace lvggt {

// Names of the decoder's language levels, as its tensors have them.
inline std::vector<std::string> level_names(std::int64_t levels) {
  if (levels == 3) return {"small", "middle", "large"};
  if (levels == 1) return {"lang"};
  std::vector<std::string> names;
  for (std::int64_t level = 0; level < levels; ++level) names.push_back(std::to_string(level));
  return names;
}

// Names of the state decoder's levels: "state", or with the names above where there are several.
inline std::vector<std::string> state_level_names(std::int64_t levels) {
  if (levels == 1) return {"state"};
  std::vector<std::string> names = level_names(levels);
  for (std::string& name : names) name = "state_" + name;
  return names;
}

// What is shown of one frame.
struct FrameMaps {
  View<const float, 3> input;        // [H, W, 3] in [0, 1]
  View<const float, 2> depth;        // [H, W]
  View<const float, 2> confidence;   // [H, W]
  View<const float, 3> rgb;          // [H, W, 3] in [0, 1]; may be empty
  View<const float, 4> language;     // [level, H, W, d]; may be empty
  View<const float, 4> states = {};  // the same of the state decoder
};

// The outputs of a frame as 8-bit pictures. Colour ranges and the bases of semantic colours come
// from the first frame given and hold for the whole video: what looks different between frames is
// different. Memory is taken once; pictures live until the next paint().
class FramePictures {
 public:
  void paint(const FrameMaps& maps) {
    if (!fitted_) fit(maps);
    color_bytes(sized(input_, maps.input), maps.input);
    color_values(sized(depth_, maps.depth), maps.depth, depth_range_);
    color_values(sized(confidence_, maps.confidence), maps.confidence, confidence_range_);
    if (maps.rgb) color_bytes(sized(rgb_, maps.rgb), maps.rgb);
    for (std::size_t level = 0; level < semantic_colors_.size(); ++level) {
      const View<const float, 3> features = level_of(maps, static_cast<std::int64_t>(level));
      semantic_colors_[level].apply(sized(semantics_[level], features), features);
    }
  }

  View<const std::uint8_t, 3> input() const { return input_; }  // [H, W, 3], as are all
  View<const std::uint8_t, 3> depth() const { return depth_; }
  View<const std::uint8_t, 3> confidence() const { return confidence_; }
  View<const std::uint8_t, 3> rgb() const { return rgb_; }  // empty without an RGB head
  // Levels of the language, then those of the states.
  std::size_t num_levels() const { return semantics_.size(); }
  View<const std::uint8_t, 3> semantics(std::size_t level) const { return semantics_[level]; }

  const ValueRange& depth_range() const { return depth_range_; }

 private:
  void fit(const FrameMaps& maps) {
    depth_range_ = robust_range(maps.depth);
    confidence_range_ = robust_range(maps.confidence);
    const std::int64_t levels = num_language(maps) + (maps.states ? maps.states.extent(0) : 0);
    semantics_.resize(static_cast<std::size_t>(levels));
    semantic_colors_.resize(static_cast<std::size_t>(levels));
    for (std::int64_t level = 0; level < levels; ++level)
      semantic_colors_[static_cast<std::size_t>(level)].fit(level_of(maps, level));
    fitted_ = true;
  }

  static std::int64_t num_language(const FrameMaps& maps) {
    return maps.language ? maps.language.extent(0) : 0;
  }
  static View<const float, 3> level_of(const FrameMaps& maps, std::int64_t level) {
    const std::int64_t states_from = num_language(maps);
    return level < states_from ? maps.language[level] : maps.states[level - states_from];
  }

  template <int R>
  static View<std::uint8_t, 3> sized(Tensor<std::uint8_t, 3>& picture, View<const float, R> map) {
    const Shape shape{map.extent(0), map.extent(1), std::int64_t{3}};
    if (picture.shape() != shape) picture = Tensor<std::uint8_t, 3>(shape);
    return picture;
  }

  bool fitted_ = false;
  ValueRange depth_range_, confidence_range_;
  std::vector<SemanticColors> semantic_colors_;  // one for each level
  Tensor<std::uint8_t, 3> input_, depth_, confidence_, rgb_;
  std::vector<Tensor<std::uint8_t, 3>> semantics_;
};

}  // namespace lvggt
