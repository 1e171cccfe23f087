// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>
#include <vector>

#include "examples/check_reference/comparison.h"

namespace check_reference {

// Collects outputs frame by frame, in the layout of the reference dumps and under their names, and
// keeps only what the file holds. As an observer it does the same with intermediate values.
class Recorder : public lvggt::Observer {
 public:
  explicit Recorder(const Comparison& comparison) : comparison_(comparison) {}

  // H, W of the frames; needed before maps are observed.
  void set_frame_size(std::int64_t H, std::int64_t W) { H_ = H, W_ = W; }
  void set_heads(std::int64_t num_heads) { num_heads_ = num_heads; }

  // Adds the running frame's part of `name`: appended to the whole, and alone as NAME.fN.
  void add(const std::string& name, std::span<const float> values);
  template <int R>
  void add(const std::string& name, lvggt::View<const float, R> values) {
    add(name, {values.data(), static_cast<std::size_t>(values.size())});
  }
  // The same for a map, which the dumps store plane by plane.   map: [H, W, C], pixels may be
  // strided
  void add_planes(const std::string& name, lvggt::View<const float, 3> map);

  void observe(std::string_view name, std::int64_t idx, lvggt::View<const float, 2> rows) override;

  // Compares all that was recorded.
  void compare(Comparison& comparison) const;

  // Keys and values of global block `layer` in the cache after the last frame: [heads, frame,
  // token, D].
  void compare_cache(Comparison& comparison, std::int64_t num_cached) const;

  // Camera tokens of all frames so far: [frame, 2C].
  const std::vector<float>& camera_tokens() const { return camera_tokens_; }

 private:
  struct CachedFrame {
    std::int64_t layer = 0, num_tokens = 0;
    std::vector<float> keys, values;  // [token, heads, D]
  };
  void observe_layer(std::int64_t layer, lvggt::View<const float, 2> global_rows);
  void observe_qkv(std::int64_t layer, lvggt::View<const float, 2> qkv);

  const Comparison& comparison_;
  std::int64_t H_ = 0, W_ = 0, num_heads_ = 1, frame_ = -1;
  std::map<std::string, std::vector<float>> outputs_;
  std::vector<float> frame_rows_;  // tokens after the last frame block
  std::vector<float> camera_tokens_;
  std::vector<CachedFrame> cached_;
};

}  // namespace check_reference
