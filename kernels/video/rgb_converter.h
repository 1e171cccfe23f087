// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "kernels/io/orientation.h"
#include "kernels/video/ffmpeg_handles.h"
#include "lvggt/io/image.h"

namespace lvggt::video {

struct PictureSize {
  std::int64_t width = 0, height = 0;
  friend bool operator==(const PictureSize&, const PictureSize&) = default;
};

// Decoded frames as upright RGB pictures with square pixels.
class RgbConverter {
 public:
  // `name` stands for the video in messages; `pixel_aspect` is width to height of a stored pixel as
  // the container has it, 0 if unknown.
  RgbConverter(std::string name, detail::Orientation orientation, AVRational pixel_aspect)
      : name_(std::move(name)), orientation_(orientation), pixel_aspect_(pixel_aspect) {}

  // Size of the picture that convert() makes of `frame`.
  PictureSize size_of(const AVFrame& frame) const;

  Image convert(const AVFrame& frame);  // pixels: [H, W, 3]

  // What about such a frame is not done justice; sentences without a subject.
  std::vector<std::string> remarks(const AVFrame& frame) const;

 private:
  AVRational aspect_of(const AVFrame& frame) const;
  PictureSize stretched_size(const AVFrame& frame) const;

  std::string name_;
  detail::Orientation orientation_;
  AVRational pixel_aspect_;
  Handle<SwsContext> scaler_;
  Tensor<std::uint8_t, 1> rows_;  // before the orientation is applied, with padding after each row
};

}  // namespace lvggt::video
