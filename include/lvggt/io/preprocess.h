// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string_view>

#include "lvggt/core/tensor.h"
#include "lvggt/io/image.h"

namespace lvggt {

// Side of a patch; the sides of a model frame are multiples of it.
inline constexpr int kPatchSize = 14;

// Largest PreprocessOptions::size.
inline constexpr int kMaxFrameSize = 1024 * kPatchSize;

// How a picture becomes a model frame, under the published names.
enum class FrameMode {
  kCrop,      // "crop": width to `size`, height in proportion, centre-cropped to at most `size`
  kPad,       // "pad": longest side to `size`, padded with white to `size` x `size`
  kOriginal,  // "original": no resize, centre-cropped to multiples of 14
  kGt,        // "gt": unchanged; for training targets, not for the model
};

// Names as above; an unknown one is a kUsage error that lists them.
FrameMode parse_frame_mode(std::string_view name);
std::string_view frame_mode_name(FrameMode mode);

struct PreprocessOptions {
  FrameMode mode = FrameMode::kCrop;
  int size = 518;  // pixels, a multiple of 14 up to kMaxFrameSize; for kCrop and kPad
  bool rotate_to_portrait = false;  // turn landscape pictures 90 degrees counter-clockwise first
};

// Where a model frame's pixels come from. In pixel edge coordinates (the corner of the first pixel
// is 0, its centre 0.5), with the picture first turned by quarter_turns_ccw:
//   model = scale * turned original + offset
// Crop makes the offset negative, padding positive. "Original" is the upright picture, as image
// viewers show it.
struct ImageTransform {
  int original_width = 0, original_height = 0;  // before the turn
  int quarter_turns_ccw = 0;                    // 0 or 1
  int width = 0, height = 0;                    // of the model frame
  double scale_x = 1, scale_y = 1;
  double offset_x = 0, offset_y = 0;

  friend bool operator==(const ImageTransform&, const ImageTransform&) = default;
};

// The transform prepare_frame() will apply to a picture of this size. Errors: kUsage (options out
// of range), kUnsupported (a side below 14 pixels, or so elongated that no patch is left).
ImageTransform plan_frame(std::int64_t width, std::int64_t height,
                          const PreprocessOptions& options);

struct PreparedFrame {
  Tensor<float, 3> pixels;  // [H, W, 3], RGB in [0, 1], every value k / 255
  ImageTransform transform;
};

// Resizes with Pillow's bicubic, to the bit: a = -0.5, antialiased, 8-bit between the two passes.
PreparedFrame prepare_frame(const Image& image, const PreprocessOptions& options);

// Rows [row_begin, row_end) of an RGB picture resized to width x height, as Pillow's
// Image.resize((width, height), BICUBIC) computes them.
Tensor<std::uint8_t, 3> resize_bicubic(View<const std::uint8_t, 3> image,  // [H, W, 3]
                                       std::int64_t width, std::int64_t height,
                                       std::int64_t row_begin,
                                       std::int64_t row_end);  // [row_end - row_begin, width, 3]

}  // namespace lvggt
