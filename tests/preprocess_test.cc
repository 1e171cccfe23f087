// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/preprocess.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <string>
#include <vector>

#include "lvggt/io/safetensors.h"
#include "tests/support/picture_bytes.h"

namespace lvggt {
namespace {

using test::golden;

Image flat_image(std::int64_t width, std::int64_t height, std::uint8_t value) {
  Image image{Tensor<std::uint8_t, 3>(Shape{height, width, std::int64_t{3}}), {}};
  std::fill_n(image.pixels.data(), image.pixels.size(), value);
  return image;
}

// Samples that differ, and the largest difference.
struct Difference {
  std::int64_t count = 0;
  int largest = 0;
};

Difference compare(View<const float, 3> frame, const Image& expected) {
  REQUIRE(frame.shape() == expected.pixels.shape());
  Difference difference;
  for (std::int64_t i = 0; i < frame.size(); ++i) {
    const auto ours = static_cast<int>(std::lround(frame.data()[i] * 255.0f));
    const int distance = std::abs(ours - expected.pixels.data()[i]);
    difference.count += distance != 0;
    difference.largest = std::max(difference.largest, distance);
  }
  return difference;
}

std::string error_of(std::int64_t width, std::int64_t height, const PreprocessOptions& options,
                     ErrorKind kind) {
  try {
    plan_frame(width, height, options);
  } catch (const Error& error) {
    CHECK(error.kind() == kind);
    return error.what();
  }
  FAIL("no error");
  return {};
}

// A picture of the reference set and how it is published: [1, 3, H, W], landscape ones turned.
void check_reference(const Safetensors& reference, const std::string& picture,
                     const std::string& mode) {
  CAPTURE(picture);
  CAPTURE(mode);
  const TensorEntry& entry = reference.at(picture + ".image_u8");
  Tensor<std::uint8_t, 3> pixels(Shape<3>{{entry.shape[0], entry.shape[1], entry.shape[2]}});
  reference.read_bytes(entry, std::as_writable_bytes(std::span(pixels.data(), pixels.num_bytes())));
  const PreprocessOptions options{.mode = parse_frame_mode(mode), .rotate_to_portrait = true};
  const PreparedFrame frame = prepare_frame(image_from_pixels(pixels), options);

  const Tensor<float, 4> expected = reference.read<4>(picture + "." + mode + ".tensor");
  REQUIRE(frame.pixels.extent(0) == expected.extent(2));
  REQUIRE(frame.pixels.extent(1) == expected.extent(3));
  std::int64_t num_wrong = 0;
  for (std::int64_t y = 0; y < expected.extent(2); ++y)
    for (std::int64_t x = 0; x < expected.extent(3); ++x)
      for (std::int64_t c = 0; c < 3; ++c)
        num_wrong += !(frame.pixels(y, x, c) == expected(0, c, y, x));
  CHECK(num_wrong == 0);

  if (!reference.find(picture + "." + mode + ".width_height")) return;
  const auto size = reference.read_int64(picture + "." + mode + ".width_height");
  const ImageTransform& t = frame.transform;
  CHECK((t.quarter_turns_ccw ? t.original_height : t.original_width) == size[0]);
  CHECK((t.quarter_turns_ccw ? t.original_width : t.original_height) == size[1]);
}

}  // namespace

TEST_CASE("prepare_frame: original and gt equal the published loader bit for bit") {
  const Safetensors reference = Safetensors::open(golden("preprocess_tiny_seed1.safetensors"));
  for (const char* picture : {"portrait", "landscape"})
    for (const char* mode : {"original", "gt"}) check_reference(reference, picture, mode);
  check_reference(reference, "rgba", "original");
}

TEST_CASE("prepare_frame: crop and pad equal Pillow bit for bit") {
  struct Case {
    const char* picture;
    FrameMode mode;
    int size;
    const char* expected;
  };
  const std::vector<Case> cases{{"wide", FrameMode::kCrop, 28, "wide.crop28"},
                                {"wide", FrameMode::kCrop, 98, "wide.crop98"},
                                {"wide", FrameMode::kPad, 56, "wide.pad56"},
                                {"tall", FrameMode::kCrop, 42, "tall.crop42"},
                                {"tall", FrameMode::kPad, 42, "tall.pad42"}};
  for (const Case& c : cases) {
    CAPTURE(c.expected);
    const Image picture = load_image(golden("preprocess/" + std::string(c.picture) + ".png"));
    const Image expected = load_image(golden("preprocess/" + std::string(c.expected) + ".png"));
    const PreparedFrame frame = prepare_frame(picture, {.mode = c.mode, .size = c.size});
    const Difference difference = compare(frame.pixels, expected);
    CHECK(difference.largest == 0);
    CHECK(difference.count == 0);
  }
}

TEST_CASE("resize_bicubic: changing one side only equals Pillow") {
  const Image picture = load_image(golden("preprocess/wide.png"));
  const Image expected = load_image(golden("preprocess/wide.61x20.png"));
  const Tensor<std::uint8_t, 3> resized = resize_bicubic(picture.pixels, 61, 20, 0, 20);
  CHECK(std::equal(resized.data(), resized.data() + resized.size(), expected.pixels.data()));
  const Tensor<std::uint8_t, 3> rows = resize_bicubic(picture.pixels, 61, 20, 7, 11);
  CHECK(std::equal(rows.data(), rows.data() + rows.size(), &expected.pixels(7, 0, 0)));
}

TEST_CASE("prepare_frame: the published sizes for a 640x480 video") {
  const ImageTransform crop = plan_frame(640, 480, {});
  CHECK(crop.width == 518);
  CHECK(crop.height == 392);  // 388.5 is 27.75 patches, so 28
  CHECK(crop.scale_x == 518.0 / 640.0);
  CHECK(crop.scale_y == 392.0 / 480.0);
  CHECK(crop.offset_y == 0);
  const ImageTransform tall = plan_frame(480, 640, {});
  CHECK(tall.height == 518);
  CHECK(tall.offset_y == -(686 - 518) / 2);  // 690.67 is 49.3 patches: 686 rows, cut to 518
  const ImageTransform pad = plan_frame(480, 640, {.mode = FrameMode::kPad});
  CHECK(pad.width == 518);
  CHECK(pad.height == 518);
  CHECK(pad.offset_x == (518 - 392) / 2);
  const ImageTransform original = plan_frame(640, 480, {.mode = FrameMode::kOriginal});
  CHECK(original.width == 630);
  CHECK(original.height == 476);
  CHECK(original.offset_x == -5);
  CHECK(original.offset_y == -2);
  // 3.5 patches are rounded to the even 4, 2.5 to the even 2, as Python does.
  CHECK(plan_frame(56, 49, {.size = 56}).height == 56);
  CHECK(plan_frame(56, 35, {.size = 56}).height == 28);
}

TEST_CASE("prepare_frame: the transform leads every model pixel to the one it shows") {
  // A single bright pixel is found where the transform says.
  for (const FrameMode mode : {FrameMode::kOriginal, FrameMode::kCrop, FrameMode::kPad}) {
    for (const bool rotate : {false, true}) {
      Image image = flat_image(60, 45, 0);
      const std::int64_t x = 33, y = 20;
      for (int c = 0; c < 3; ++c) image.pixels(y, x, c) = 255;
      const PreparedFrame frame =
          prepare_frame(image, {.mode = mode, .size = 112, .rotate_to_portrait = rotate});
      const ImageTransform& t = frame.transform;
      // Pixel centres; a counter-clockwise turn leads (x, y) to (y, width - x).
      const double u = rotate ? static_cast<double>(y) + 0.5 : static_cast<double>(x) + 0.5;
      const double v = rotate ? 60 - (static_cast<double>(x) + 0.5) : static_cast<double>(y) + 0.5;
      const double model_x = t.scale_x * u + t.offset_x, model_y = t.scale_y * v + t.offset_y;
      CHECK(t.quarter_turns_ccw == (rotate ? 1 : 0));
      CHECK(frame.pixels(static_cast<std::int64_t>(model_y), static_cast<std::int64_t>(model_x),
                         1) > 0.5f);
    }
  }
}

TEST_CASE("C08: pictures below one patch are refused with their size and the minimum") {
  for (const FrameMode mode : {FrameMode::kCrop, FrameMode::kPad, FrameMode::kOriginal}) {
    for (const auto& [width, height] : {std::pair{1, 1}, {13, 13}, {14, 1}, {1, 10000}}) {
      const std::string message = error_of(width, height, {.mode = mode}, ErrorKind::kUnsupported);
      CHECK(message.find(concat(width, "x", height)) != std::string::npos);
      CHECK(message.find("minimum of 14x14") != std::string::npos);
    }
  }
}

TEST_CASE("C08: an aspect of 1:50 works, one that leaves no patch is refused") {
  const PreparedFrame wide = prepare_frame(flat_image(1000, 20, 9), {.size = 518});
  CHECK(wide.pixels.extent(0) == 14);
  const PreparedFrame tall = prepare_frame(flat_image(20, 1000, 9), {.size = 518});
  CHECK(tall.pixels.extent(0) == 518);
  CHECK(tall.transform.offset_y == -(25900 - 518) / 2);
  const std::string message = error_of(2000, 20, {.size = 518}, ErrorKind::kUnsupported);
  CHECK(message.find("2000x20 pixels becomes 518x0") != std::string::npos);
}

TEST_CASE("C18: black and white pictures stay exactly black and white") {
  for (const std::uint8_t value : {std::uint8_t{0}, std::uint8_t{255}}) {
    const PreparedFrame frame = prepare_frame(flat_image(64, 48, value), {.size = 126});
    CHECK(std::all_of(frame.pixels.data(), frame.pixels.data() + frame.pixels.size(),
                      [=](float x) { return x == static_cast<float>(value) / 255.0f; }));
  }
}

TEST_CASE("prepare_frame: sizes that are not multiples of 14 and unknown modes are usage errors") {
  for (const int size : {0, -14, 13, 519, kMaxFrameSize + 14})
    CHECK(error_of(64, 48, {.size = size}, ErrorKind::kUsage).find(concat("size: ", size)) == 0);
  CHECK_THROWS_WITH_AS(parse_frame_mode("Crop"),
                       "mode: \"Crop\" is not one of crop, pad, original, gt", Error);
  CHECK(frame_mode_name(parse_frame_mode("pad")) == "pad");
}

}  // namespace lvggt
