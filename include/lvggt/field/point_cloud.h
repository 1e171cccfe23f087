// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstdint>

#include "lvggt/core/tensor.h"
#include "lvggt/field/color_map.h"
#include "lvggt/geometry/confidence.h"
#include "lvggt/geometry/unproject.h"

namespace lvggt {

// What a frame's point cloud is made of.
struct PointCloudInputs {
  View<const float, 2> depth;       // [H, W]
  View<const float, 2> confidence;  // [H, W]
  View<const float, 3> colors;      // [H, W, 3] in [0, 1]: the RGB head's or the input's
  View<const float, 4> language;    // [level, H, W, d]; may be empty
  Camera camera;
};

// A coloured, language-featured point cloud of one frame, for one frame after the other: the memory
// is taken once, for frames of H x W pixels. Views live until the next build().
class PointCloud {
 public:
  PointCloud(std::int64_t H, std::int64_t W, std::int64_t levels, std::int64_t lang_dim)
      : world_(Shape{H, W, std::int64_t{3}}),
        keep_(Shape{H, W}),
        positions_(Shape{H * W, std::int64_t{3}}),
        colors_(Shape{H * W, std::int64_t{3}}),
        confidence_(Shape{H * W}),
        pixels_(Shape{H * W, std::int64_t{2}}),
        semantics_(Shape{H * W, levels, lang_dim}) {}

  // Unprojects the depth and keeps what passes the confidence filter at percentile p, row by row.
  void build(const PointCloudInputs& in, double p, Context& ctx) {
    LVGGT_CHECK(in.depth.shape() == keep_.shape() && in.confidence.shape() == keep_.shape() &&
                    in.colors.shape() == world_.shape(),
                "point cloud: depth is ", in.depth.shape(), ", confidence ", in.confidence.shape(),
                " and colours ", in.colors.shape(), ", expected frames of ", keep_.shape());
    const std::int64_t levels = semantics_.extent(1), d = semantics_.extent(2);
    LVGGT_CHECK(
        !in.language || (in.language.shape() == Shape{levels, keep_.extent(0), keep_.extent(1), d}),
        "point cloud: language is ", in.language.shape(), ", expected ", levels, " levels of ", d,
        " values for frames of ", keep_.shape());
    unproject(world_, in.depth, in.camera, ctx);
    confidence_filter(keep_, in.confidence, p, ctx);
    size_ = 0;
    has_semantics_ = static_cast<bool>(in.language);
    for (std::int64_t y = 0; y < keep_.extent(0); ++y)
      for (std::int64_t x = 0; x < keep_.extent(1); ++x)
        if (keep_(y, x) != 0) append(in, y, x);
  }

  std::int64_t size() const { return size_; }  // N
  View<const float, 2> positions() const {
    return positions_.view().narrow(0, 0, size_);
  }  // [N, 3]
  View<const std::uint8_t, 2> colors() const {
    return colors_.view().narrow(0, 0, size_);
  }  // [N, 3]
  View<const float, 1> confidence() const { return confidence_.view().narrow(0, 0, size_); }  // [N]
  View<const std::int32_t, 2> pixels() const {
    return pixels_.view().narrow(0, 0, size_);
  }  // [N, 2]: u, v
  // [N, level, d]; empty without language features.
  View<const float, 3> semantics() const {
    return has_semantics_ ? semantics_.view().narrow(0, 0, size_) : View<const float, 3>();
  }

 private:
  void append(const PointCloudInputs& in, std::int64_t y, std::int64_t x) {
    std::copy_n(world_.view()[y][x].data(), 3, positions_[size_].data());
    for (std::int64_t c = 0; c < 3; ++c) colors_(size_, c) = to_byte(in.colors(y, x, c));
    confidence_.data()[size_] = in.confidence(y, x);
    pixels_(size_, 0) = static_cast<std::int32_t>(x);
    pixels_(size_, 1) = static_cast<std::int32_t>(y);
    if (has_semantics_)
      for (std::int64_t level = 0; level < semantics_.extent(1); ++level)
        std::copy_n(in.language[level][y][x].data(), semantics_.extent(2),
                    semantics_[size_][level].data());
    ++size_;
  }

  Tensor<float, 3> world_;          // [H, W, 3]
  Tensor<std::uint8_t, 2> keep_;    // [H, W]
  Tensor<float, 2> positions_;      // [H * W, 3]
  Tensor<std::uint8_t, 2> colors_;  // [H * W, 3]
  Tensor<float, 1> confidence_;     // [H * W]
  Tensor<std::int32_t, 2> pixels_;  // [H * W, 2]
  Tensor<float, 3> semantics_;      // [H * W, level, d]
  std::int64_t size_ = 0;
  bool has_semantics_ = false;
};

}  // namespace lvggt
