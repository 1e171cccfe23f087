// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/preprocess.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <utility>

#include "kernels/io/orientation.h"

namespace lvggt {

namespace {

constexpr std::array<std::pair<std::string_view, FrameMode>, 4> kModes{{
    {"crop", FrameMode::kCrop},
    {"pad", FrameMode::kPad},
    {"original", FrameMode::kOriginal},
    {"gt", FrameMode::kGt},
}};

// Keeps sizes in int and products of two sides in 63 bits.
constexpr std::int64_t kMaxPictureSide = (std::int64_t{1} << 31) - 1;

// The steps after the turn: resize, cut a window out, put it into the frame.
struct FramePlan {
  std::int64_t resized_width, resized_height;
  std::int64_t crop_x = 0, crop_y = 0;       // corner of the window in the resized picture
  std::int64_t window_width, window_height;  // what is kept of it
  std::int64_t pad_x = 0, pad_y = 0;         // corner of the window in the frame
  std::int64_t width, height;                // of the frame
};

// Python's round(): halves to even, whatever the rounding mode of the process.
std::int64_t round_half_even(double x) {
  const double below = std::floor(x);
  const auto n = static_cast<std::int64_t>(below);
  if (x - below != 0.5) return x - below < 0.5 ? n : n + 1;
  return n % 2 == 0 ? n : n + 1;
}

// `side` scaled by size / reference, in whole patches. In the order of operations of the release,
// so that the same side rounds the same way.
std::int64_t scaled_to_patches(std::int64_t side, std::int64_t size, std::int64_t reference) {
  const double scale = static_cast<double>(size) / static_cast<double>(reference);
  return round_half_even(static_cast<double>(side) * scale / kPatchSize) * kPatchSize;
}

void check_options(const PreprocessOptions& options) {
  const bool uses_size = options.mode == FrameMode::kCrop || options.mode == FrameMode::kPad;
  if (uses_size &&
      (options.size < kPatchSize || options.size > kMaxFrameSize || options.size % kPatchSize != 0))
    fail(ErrorKind::kUsage, "size: ", options.size, " is not a multiple of ", kPatchSize,
         " between ", kPatchSize, " and ", kMaxFrameSize);
}

FramePlan plan_crop(std::int64_t width, std::int64_t height, std::int64_t size) {
  FramePlan plan{};
  plan.resized_width = size;
  plan.resized_height = scaled_to_patches(height, size, width);
  plan.window_width = plan.width = size;
  plan.window_height = plan.height = std::min(plan.resized_height, size);
  plan.crop_y = (plan.resized_height - plan.height) / 2;
  return plan;
}

FramePlan plan_pad(std::int64_t width, std::int64_t height, std::int64_t size) {
  FramePlan plan{};
  plan.resized_width = width >= height ? size : scaled_to_patches(width, size, height);
  plan.resized_height = width >= height ? scaled_to_patches(height, size, width) : size;
  plan.window_width = plan.resized_width;
  plan.window_height = plan.resized_height;
  plan.width = plan.height = size;
  plan.pad_x = (size - plan.window_width) / 2;
  plan.pad_y = (size - plan.window_height) / 2;
  return plan;
}

FramePlan plan_unresized(std::int64_t width, std::int64_t height, std::int64_t multiple) {
  FramePlan plan{};
  plan.resized_width = width;
  plan.resized_height = height;
  plan.window_width = plan.width = width / multiple * multiple;
  plan.window_height = plan.height = height / multiple * multiple;
  plan.crop_x = (width - plan.width) / 2;
  plan.crop_y = (height - plan.height) / 2;
  return plan;
}

// Sizes are after the turn.
FramePlan make_plan(std::int64_t width, std::int64_t height, const PreprocessOptions& options) {
  check_options(options);
  if (options.mode == FrameMode::kGt) return plan_unresized(width, height, 1);
  if (width < kPatchSize || height < kPatchSize)
    fail(ErrorKind::kUnsupported, "a picture of ", width, "x", height,
         " pixels is smaller than the minimum of ", kPatchSize, "x", kPatchSize);
  const FramePlan plan = options.mode == FrameMode::kCrop ? plan_crop(width, height, options.size)
                         : options.mode == FrameMode::kPad
                             ? plan_pad(width, height, options.size)
                             : plan_unresized(width, height, kPatchSize);
  if (plan.window_width == 0 || plan.window_height == 0)
    fail(ErrorKind::kUnsupported, "a picture of ", width, "x", height, " pixels becomes ",
         plan.resized_width, "x", plan.resized_height, " in mode ", frame_mode_name(options.mode),
         " at size ", options.size, ", but the minimum is ", kPatchSize, "x", kPatchSize);
  return plan;
}

bool needs_turn(std::int64_t width, std::int64_t height, const PreprocessOptions& options) {
  return options.rotate_to_portrait && width > height;
}

// The window of the plan, as 8-bit samples.
Tensor<std::uint8_t, 3> cut_window(View<const std::uint8_t, 3> picture, const FramePlan& plan) {
  if (plan.resized_width != picture.extent(1) || plan.resized_height != picture.extent(0))
    return resize_bicubic(picture, plan.resized_width, plan.resized_height, plan.crop_y,
                          plan.crop_y + plan.window_height);
  Tensor<std::uint8_t, 3> window(Shape{plan.window_height, plan.window_width, std::int64_t{3}});
  for (std::int64_t y = 0; y < plan.window_height; ++y)
    std::copy_n(&picture(plan.crop_y + y, plan.crop_x, 0), plan.window_width * 3, &window(y, 0, 0));
  return window;
}

}  // namespace

FrameMode parse_frame_mode(std::string_view name) {
  for (const auto& mode : kModes)
    if (mode.first == name) return mode.second;
  fail(ErrorKind::kUsage, "mode: \"", name, "\" is not one of crop, pad, original, gt");
}

std::string_view frame_mode_name(FrameMode mode) {
  for (const auto& known : kModes)
    if (known.second == mode) return known.first;
  return "unknown";
}

ImageTransform plan_frame(std::int64_t width, std::int64_t height,
                          const PreprocessOptions& options) {
  LVGGT_CHECK(width > 0 && height > 0 && std::max(width, height) <= kMaxPictureSide,
              "plan_frame: the sides of a picture of ", width, "x", height,
              " pixels are not between 1 and ", kMaxPictureSide);
  ImageTransform transform;
  transform.original_width = static_cast<int>(width);
  transform.original_height = static_cast<int>(height);
  if (needs_turn(width, height, options)) {
    transform.quarter_turns_ccw = 1;
    std::swap(width, height);
  }
  const FramePlan plan = make_plan(width, height, options);
  transform.width = static_cast<int>(plan.width);
  transform.height = static_cast<int>(plan.height);
  transform.scale_x = static_cast<double>(plan.resized_width) / static_cast<double>(width);
  transform.scale_y = static_cast<double>(plan.resized_height) / static_cast<double>(height);
  transform.offset_x = static_cast<double>(plan.pad_x - plan.crop_x);
  transform.offset_y = static_cast<double>(plan.pad_y - plan.crop_y);
  return transform;
}

PreparedFrame prepare_frame(const Image& image, const PreprocessOptions& options) {
  PreparedFrame frame;
  frame.transform = plan_frame(image.width(), image.height(), options);
  Tensor<std::uint8_t, 3> turned;
  if (frame.transform.quarter_turns_ccw == 1)
    turned = detail::reoriented(image.pixels, detail::kQuarterTurnCcw);
  const View<const std::uint8_t, 3> picture =
      turned.empty() ? image.pixels.view() : std::as_const(turned).view();
  const FramePlan plan = make_plan(picture.extent(1), picture.extent(0), options);
  const Tensor<std::uint8_t, 3> window = cut_window(picture, plan);

  frame.pixels = Tensor<float, 3>(Shape{plan.height, plan.width, std::int64_t{3}});
  if (plan.window_width != plan.width || plan.window_height != plan.height)
    std::fill_n(frame.pixels.data(), frame.pixels.size(), 1.0f);
  for (std::int64_t y = 0; y < plan.window_height; ++y) {
    const std::uint8_t* in = &window(y, 0, 0);
    float* out = &frame.pixels(plan.pad_y + y, plan.pad_x, 0);
    for (std::int64_t i = 0; i < plan.window_width * 3; ++i)
      out[i] = static_cast<float>(in[i]) / 255.0f;
  }
  return frame;
}

}  // namespace lvggt
