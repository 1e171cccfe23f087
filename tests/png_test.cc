// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/png.h"

#include <doctest/doctest.h>
#include <png.h>

#include <cstring>
#include <filesystem>
#include <vector>

#include "lvggt/io/depth_png.h"
#include "tests/support/files.h"
#include "tests/support/temp_dir.h"

using namespace lvggt;

namespace {

// Decodes with libpng's simplified reader into 8-bit or linear 16-bit samples.
template <class T>
std::vector<T> read_png(const std::string& path, unsigned format, std::int64_t& H,
                        std::int64_t& W) {
  png_image image;
  std::memset(&image, 0, sizeof image);
  image.version = PNG_IMAGE_VERSION;
  REQUIRE(png_image_begin_read_from_file(&image, path.c_str()) != 0);
  image.format = format;
  H = image.height;
  W = image.width;
  std::vector<T> samples(PNG_IMAGE_SIZE(image) / sizeof(T));
  REQUIRE(png_image_finish_read(&image, nullptr, samples.data(), 0, nullptr) != 0);
  return samples;
}

// The raw 16-bit grey samples, without colour management.
std::vector<std::uint16_t> read_grey16(const std::string& path) {
  png_structp png = png_create_read_struct(PNG_LIBPNG_VER_STRING, nullptr, nullptr, nullptr);
  png_infop info = png_create_info_struct(png);
  FILE* file = std::fopen(path.c_str(), "rb");
  REQUIRE(file != nullptr);
  png_init_io(png, file);
  png_read_png(png, info, PNG_TRANSFORM_IDENTITY, nullptr);
  CHECK(png_get_bit_depth(png, info) == 16);
  CHECK(png_get_color_type(png, info) == PNG_COLOR_TYPE_GRAY);
  std::vector<std::uint16_t> samples;
  for (png_uint_32 y = 0; y < png_get_image_height(png, info); ++y)
    for (png_uint_32 x = 0; x < png_get_image_width(png, info); ++x) {
      const png_bytep p = png_get_rows(png, info)[y] + 2 * x;
      samples.push_back(static_cast<std::uint16_t>(p[0] << 8 | p[1]));
    }
  std::fclose(file);
  png_destroy_read_struct(&png, &info, nullptr);
  return samples;
}

}  // namespace

TEST_CASE("write_png: RGB and grey pixels read back the same, odd sizes and views of a part") {
  const test::TempDir folder;
  for (const std::int64_t C : {1, 3}) {
    Tensor<std::uint8_t, 3> pixels(Shape{std::int64_t{9}, std::int64_t{11}, C});
    for (std::int64_t i = 0; i < pixels.size(); ++i)
      pixels.data()[i] = static_cast<std::uint8_t>(37 * i);
    const auto part = pixels.view().narrow(0, 2, 7).narrow(1, 3, 10);
    write_png(folder / "x.png", part);
    std::int64_t H = 0, W = 0;
    const auto read =
        read_png<std::uint8_t>(folder / "x.png", C == 3 ? PNG_FORMAT_RGB : PNG_FORMAT_GRAY, H, W);
    REQUIRE(H == 5);
    REQUIRE(W == 7);
    for (std::int64_t y = 0; y < H; ++y)
      for (std::int64_t x = 0; x < W; ++x)
        for (std::int64_t c = 0; c < C; ++c)
          CHECK(read[static_cast<std::size_t>((y * W + x) * C + c)] == part(y, x, c));
  }
}

TEST_CASE("write_png: 16-bit grey keeps every bit") {
  const test::TempDir folder;
  Tensor<std::uint16_t, 2> pixels(Shape{3, 5});
  for (std::int64_t i = 0; i < 15; ++i) pixels.data()[i] = static_cast<std::uint16_t>(4369 * i + 1);
  write_png(folder / "x.png", pixels);
  const auto read = read_grey16(folder / "x.png");
  REQUIRE(read.size() == 15);
  CHECK(std::equal(read.begin(), read.end(), pixels.data()));
}

TEST_CASE("write_png: shapes that are no picture and folders that are not there are refused") {
  const test::TempDir folder;
  CHECK_THROWS_WITH_AS(write_png(folder / "x.png", Tensor<std::uint8_t, 3>(Shape{2, 2, 4})),
                       doctest::Contains("[2,2,4]"), Error);
  CHECK_THROWS_WITH_AS(write_png(folder / "x.png", Tensor<std::uint8_t, 3>(Shape{0, 2, 3})),
                       doctest::Contains("2 x 0 pixels"), Error);
  CHECK_THROWS_WITH_AS(write_png(folder / "no/x.png", Tensor<std::uint8_t, 3>(Shape{1, 1, 3})),
                       doctest::Contains("no"), Error);
  CHECK(std::filesystem::is_empty(folder.path()));
}

TEST_CASE("write_depth_png: value times scale is the depth, to half a step") {
  const test::TempDir folder;
  Tensor<float, 2> depth(Shape{4, 6});
  for (std::int64_t i = 0; i < 24; ++i) depth.data()[i] = 0.7f + 0.31f * static_cast<float>(i);
  const double scale =
      write_depth_png(folder / "d.png", folder / "d.json", depth, "depth", "a test");
  CHECK(scale == std::exp2(std::round(std::log2(scale))));
  CHECK(0.7 + 0.31 * 23 <= 65535 * scale);
  CHECK(0.7 + 0.31 * 23 > 65535 * scale / 2);
  const auto values = read_grey16(folder / "d.png");
  for (std::size_t i = 0; i < 24; ++i)
    CHECK(std::abs(values[i] * scale - depth.data()[i]) <= scale / 2);
  const std::string text = test::read_bytes(folder / "d.json");
  CHECK(text.find("\"formula\": \"depth = value * scale; value 0 means none\"") !=
        std::string::npos);
}

TEST_CASE("quantize_16bit: no number becomes 0, a small positive one does not") {
  Tensor<float, 2> numbers(Shape{1, 5});
  numbers.data()[0] = 1e6f;
  numbers.data()[1] = 1e-6f;
  numbers.data()[2] = NAN;
  numbers.data()[3] = INFINITY;
  numbers.data()[4] = -3;
  const Quantized16 quantized = quantize_16bit(numbers);
  CHECK(quantized.values(0, 0) > 32767);
  CHECK(quantized.values(0, 1) == 1);
  for (const std::int64_t i : {2, 3, 4}) CHECK(quantized.values(0, i) == 0);
  CHECK(quantize_16bit(Tensor<float, 2>(Shape{2, 2})).scale == 1);
}
