// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/image.h"

#include <doctest/doctest.h>
#include <sys/stat.h>

#include <algorithm>
#include <array>
#include <cstdlib>

#include "tests/support/picture_bytes.h"
#include "tests/support/temp_dir.h"

namespace lvggt {
namespace {

using std::string_literals::operator""s;
using test::decode;
using test::golden;
using test::png;
using test::png_chunk;
using test::read_file;

// The kind and message of the Error that `load` ends with.
template <class Load>
std::pair<ErrorKind, std::string> error_of(Load&& load) {
  try {
    load();
  } catch (const Error& error) {
    return {error.kind(), error.what()};
  }
  FAIL("no error");
  return {};
}

void check_refused(const std::string& bytes, ErrorKind kind, const std::string& reason) {
  const std::pair<ErrorKind, std::string> error = error_of([&] { decode(bytes); });
  CHECK(error.first == kind);
  CHECK_MESSAGE(error.second.find(reason) != std::string::npos, error.second);
}

using Rgb = std::array<int, 3>;

Rgb pixel(const Image& image, std::int64_t x, std::int64_t y) {
  return {image.pixels(y, x, 0), image.pixels(y, x, 1), image.pixels(y, x, 2)};
}

bool near(const Rgb& a, const Rgb& b, int tolerance) {
  return std::equal(a.begin(), a.end(), b.begin(),
                    [=](int x, int y) { return std::abs(x - y) <= tolerance; });
}

constexpr Rgb kRed{255, 0, 0}, kGreen{0, 255, 0}, kBlue{0, 0, 255}, kYellow{255, 255, 0};

// The centres of the four quadrants, row by row.
std::array<Rgb, 4> quadrants(const Image& image) {
  const std::int64_t x = image.width() / 4, y = image.height() / 4;
  return {pixel(image, x, y), pixel(image, 3 * x, y), pixel(image, x, 3 * y),
          pixel(image, 3 * x, 3 * y)};
}

void check_quadrants(const Image& image, const std::array<Rgb, 4>& expected, int tolerance) {
  for (std::size_t i = 0; i < 4; ++i) {
    CAPTURE(i);
    CHECK(near(quadrants(image)[i], expected[i], tolerance));
  }
}

}  // namespace

TEST_CASE("C01: an empty picture is refused") {
  check_refused("", ErrorKind::kFormat, "picture: is empty");
}

TEST_CASE("C02: a JPEG cut at any point is refused") {
  for (const char* name : {"image/rgb.jpg", "image/progressive.jpg"}) {
    const std::string jpeg = read_file(golden(name));
    for (std::size_t length = 3; length < jpeg.size(); length += 7)
      check_refused(jpeg.substr(0, length), ErrorKind::kFormat, "truncated");
    check_refused(jpeg.substr(0, jpeg.size() - 1), ErrorKind::kFormat, "truncated");
  }
}

TEST_CASE("C03: a PNG cut at any point is refused") {
  const std::string file = read_file(golden("image/rgba.png"));
  for (std::size_t length = 8; length < file.size(); length += 7)
    check_refused(file.substr(0, length), ErrorKind::kFormat, "truncated");
}

TEST_CASE("C03: a PNG whose compressed pixels end early is refused") {
  // A complete zlib stream of nothing.
  check_refused(png(8, 6, png_chunk("IDAT", "\x78\x9c\x03\0\0\0\0\x01"s)), ErrorKind::kFormat,
                "cannot be decoded");
  check_refused(png(8, 6, ""), ErrorKind::kFormat, "holds no pixels");
}

TEST_CASE("C04: a wrong checksum in any PNG chunk is refused") {
  const std::string file = read_file(golden("image/rgb.png"));
  for (const std::size_t at : {20u, 32u, 45u, static_cast<unsigned>(file.size() - 1)}) {
    std::string damaged = file;
    damaged[at] = static_cast<char>(damaged[at] ^ 1);
    CAPTURE(at);
    check_refused(damaged, ErrorKind::kFormat, "wrong checksum");
  }
}

TEST_CASE("C04: JPEG tables and scans that cannot be are refused") {
  const std::string jpeg = read_file(golden("image/rgb.jpg"));
  const std::size_t table = jpeg.find("\xff\xc4"s);
  std::string changed = jpeg;
  changed.replace(table + 5, 3, "\0\0\xff"s);
  check_refused(changed, ErrorKind::kFormat, "too many codes of 3 bits");
  changed = jpeg;
  changed[table + 4] = 0x03;
  check_refused(changed, ErrorKind::kFormat, "Huffman table that is not defined");
  changed = jpeg;
  changed.insert(table, "\xff\xdd\0\4\0\1"s);
  check_refused(changed, ErrorKind::kFormat, "has 0 of 23 restart markers");
}

TEST_CASE("C05: a small file that claims 65500x65500 pixels is refused") {
  check_refused(png(65500, 65500, png_chunk("IDAT", std::string(40, 'x'))), ErrorKind::kLimit,
                "65500x65500 pixels are more than the limit of 268435456");
  std::string jpeg = read_file(golden("image/rgb.jpg"));
  const std::size_t frame_header = jpeg.find("\xff\xc0"s);
  jpeg.replace(frame_header + 5, 4, "\xff\xdc\xff\xdc");
  check_refused(jpeg, ErrorKind::kLimit, "65500x65500");
}

TEST_CASE("C06: a PNG with far more pixels than its size can explain is refused") {
  check_refused(png(30000, 30000, png_chunk("IDAT", std::string(1000, 'x'))), ErrorKind::kLimit,
                "30000x30000");
  check_refused(png(16000, 16000, png_chunk("IDAT", std::string(1000, 'x'))), ErrorKind::kLimit,
                "claims 16000x16000 pixels in 10");
}

TEST_CASE("C06: the limit on pixels is an option") {
  const std::string file = read_file(golden("image/rgb.png"));
  Limits limits;
  limits.image_pixels = 47;
  CHECK(error_of([&] { decode(file, limits); }).first == ErrorKind::kLimit);
  limits.image_pixels = 48;
  CHECK(decode(file, limits).width() == 8);
}

TEST_CASE("C07: a progressive JPEG with 10,000 scans is refused") {
  const std::string jpeg = read_file(golden("image/progressive.jpg"));
  const std::size_t last_scan = jpeg.rfind("\xff\xda"s);
  const std::string scan = jpeg.substr(last_scan, jpeg.size() - 2 - last_scan);
  std::string many = jpeg.substr(0, jpeg.size() - 2);
  for (int i = 0; i < 10'000; ++i) many += scan;
  check_refused(many + "\xff\xd9", ErrorKind::kLimit, "more than the limit of 100 scans");
}

TEST_CASE("C09: grey, grey with alpha, palette and 16-bit PNG give the right colours") {
  const Image grey = decode(read_file(golden("image/grey.png")));
  CHECK(pixel(grey, 7, 5) == Rgb{235, 235, 235});
  const Image half = decode(read_file(golden("image/grey_alpha.png")));
  CHECK(pixel(half, 0, 0) == Rgb{153, 153, 153});  // 0.4 black on white
  check_quadrants(decode(read_file(golden("image/rgb.png"))), {kRed, kGreen, kBlue, kYellow}, 0);
  check_quadrants(decode(read_file(golden("image/palette.png"))), {kRed, kGreen, kBlue, kYellow},
                  0);
  check_quadrants(decode(read_file(golden("image/palette_transparent.png"))),
                  {Rgb{255, 255, 255}, kGreen, kBlue, kYellow}, 0);
  const Image deep = decode(read_file(golden("image/grey16.png")));
  CHECK(pixel(deep, 7, 5) == Rgb{238, 238, 238});  // 61100 >> 8
}

TEST_CASE("C09: colour, grey, progressive and CMYK JPEG give the right colours") {
  for (const char* name : {"image/rgb.jpg", "image/progressive.jpg", "image/cmyk.jpg"}) {
    CAPTURE(name);
    check_quadrants(decode(read_file(golden(name))), {kRed, kGreen, kBlue, kYellow}, 4);
  }
  const Image grey = decode(read_file(golden("image/grey.jpg")));
  CHECK(near(pixel(grey, 31, 23), {240, 240, 240}, 1));
}

TEST_CASE("C09: 12-bit, arithmetic-coded and undefined CMYK JPEG are refused by name") {
  const std::string jpeg = read_file(golden("image/rgb.jpg"));
  const std::size_t frame_header = jpeg.find("\xff\xc0"s);
  std::string changed = jpeg;
  changed[frame_header + 4] = 12;
  check_refused(changed, ErrorKind::kUnsupported, "12 bits a sample");
  changed = jpeg;
  changed[frame_header + 1] = '\xc9';
  check_refused(changed, ErrorKind::kUnsupported, "arithmetic-coded");
  std::string cmyk = read_file(golden("image/cmyk.jpg"));
  cmyk.replace(cmyk.find("Adobe"), 5, "Other");
  check_refused(cmyk, ErrorKind::kUnsupported, "without Adobe's marker");
}

TEST_CASE("C09: samples beyond the end of a PNG palette are black") {
  const Image image = decode(png(2, 1,
                                 png_chunk("PLTE", "abc") + png_chunk("IDAT", std::string("\x78"
                                                                                          "\x9c"
                                                                                          "\x63"
                                                                                          "\x60"
                                                                                          "\xf8"
                                                                                          "\x0f"
                                                                                          "\x00"
                                                                                          "\x01"
                                                                                          "\x02"
                                                                                          "\x01"
                                                                                          "\x00",
                                                                                          11)),
                                 8, 3));
  CHECK(pixel(image, 0, 0) == Rgb{'a', 'b', 'c'});
  CHECK(pixel(image, 1, 0) == Rgb{0, 0, 0});
}

TEST_CASE("C10: RGBA is composited on white as Pillow does, to the bit") {
  const Image image = decode(read_file(golden("image/rgba.png")));
  const Image expected = decode(read_file(golden("image/rgba_on_white.png")));
  REQUIRE(image.pixels.shape() == expected.pixels.shape());
  CHECK(std::equal(image.pixels.data(), image.pixels.data() + image.pixels.size(),
                   expected.pixels.data()));
}

TEST_CASE("C11: each of the eight EXIF orientations is applied, in JPEG and PNG") {
  // Where the quadrants of the stored picture (0 1 / 2 3) are seen.
  const std::array<std::array<std::size_t, 4>, 8> shown{{{0, 1, 2, 3},
                                                         {1, 0, 3, 2},
                                                         {3, 2, 1, 0},
                                                         {2, 3, 0, 1},
                                                         {0, 2, 1, 3},
                                                         {2, 0, 3, 1},
                                                         {3, 1, 2, 0},
                                                         {1, 3, 0, 2}}};
  const std::array<Rgb, 4> colors{kRed, kGreen, kBlue, kYellow};
  const std::string jpeg = read_file(golden("image/rgb.jpg"));
  std::string png_file = read_file(golden("image/rgb.png"));
  for (int orientation = 1; orientation <= 8; ++orientation) {
    CAPTURE(orientation);
    std::array<Rgb, 4> expected;
    for (std::size_t i = 0; i < 4; ++i)
      expected[i] = colors[shown[static_cast<std::size_t>(orientation - 1)][i]];
    const std::string exif = test::exif_with_orientation(orientation);
    const Image from_jpeg = decode(test::with_jpeg_segment(jpeg, 0xe1, exif));
    check_quadrants(from_jpeg, expected, 4);
    CHECK(from_jpeg.width() == (orientation < 5 ? 32 : 48));
    CHECK(from_jpeg.height() == (orientation < 5 ? 48 : 32));
    const std::string chunk = png_chunk("eXIf", exif.substr(6));
    check_quadrants(decode(png_file.substr(0, 33) + chunk + png_file.substr(33)), expected, 0);
  }
}

TEST_CASE("C12: 60 kB of garbage as EXIF data do no harm") {
  const std::string jpeg = read_file(golden("image/rgb.jpg"));
  std::uint32_t state = 1;
  for (int round = 0; round < 20; ++round) {
    std::string exif = test::exif_with_orientation(1).substr(0, round % 2 == 0 ? 6 : 24);
    while (exif.size() < 60'000) {
      state = state * 1664525u + 1013904223u;
      exif += static_cast<char>(state >> 24);
    }
    CHECK(decode(test::with_jpeg_segment(jpeg, 0xe1, exif)).pixels.size() == 32 * 48 * 3);
  }
  const Image image = decode(test::with_jpeg_segment(jpeg, 0xe1, test::exif_with_orientation(77)));
  REQUIRE(image.notes.size() == 1);
  CHECK(image.notes[0] == "picture: the EXIF orientation 77 is not between 1 and 8 and is ignored");
}

TEST_CASE("C13: a colour profile is ignored and that is said") {
  const Image image = decode(
      test::with_jpeg_segment(read_file(golden("image/rgb.jpg")), 0xe2, "ICC_PROFILE\0\1\1abc"s));
  REQUIRE(image.notes.size() == 1);
  CHECK(image.notes[0] == "picture: the colour profile is ignored");
}

TEST_CASE("C14: the content decides what a picture is, not its name") {
  const test::TempDir folder;
  test::write_file(folder / "a.png", read_file(golden("image/rgb.jpg")));
  CHECK(load_image(folder / "a.png").width() == 32);
  test::write_file(folder / "b.jpg", "<!doctype html><html>");
  const auto [kind, message] = error_of([&] { load_image(folder / "b.jpg"); });
  CHECK(kind == ErrorKind::kFormat);
  CHECK(message.find("b.jpg: is not a PNG or JPEG image; it looks like an HTML page") !=
        std::string::npos);
}

TEST_CASE("C15: animated pictures are refused by name") {
  const std::string control = png_chunk("acTL", "\0\0\0\2\0\0\0\0"s);
  check_refused(png(8, 6, control), ErrorKind::kUnsupported, "animated PNG");
  check_refused("GIF89a......", ErrorKind::kUnsupported, "GIF images are not supported");
  check_refused("RIFF\x10\0\0\0WEBPVP8X"s, ErrorKind::kUnsupported, "WebP images");
}

TEST_CASE("C16: HEIC, AVIF, TIFF and OpenEXR are refused by name") {
  check_refused(
      "\0\0\0\x18"
      "ftypheic"s,
      ErrorKind::kUnsupported, "HEIC images are not supported");
  check_refused(
      "\0\0\0\x18"
      "ftypavif"s,
      ErrorKind::kUnsupported, "AVIF images");
  check_refused("II*\0\x08\0\0\0"s, ErrorKind::kUnsupported, "TIFF images");
  check_refused("\x76\x2f\x31\x01\2\0\0\0"s, ErrorKind::kUnsupported, "OpenEXR images");
  check_refused("BM\x40\0\0\0\0\0\0\0\x36\0"s, ErrorKind::kUnsupported, "BMP images");
}

TEST_CASE("load_image: a missing file, a folder and a pipe are refused without waiting") {
  const test::TempDir folder;
  CHECK(error_of([&] { load_image(folder / "none.png"); }).first == ErrorKind::kRead);
  CHECK(error_of([&] { load_image(folder.path()); }).first == ErrorKind::kRead);
  REQUIRE(::mkfifo((folder / "pipe.png").c_str(), 0600) == 0);
  CHECK(error_of([&] { load_image(folder / "pipe.png"); }).first == ErrorKind::kRead);
}

TEST_CASE("load_image: changed bytes give a picture or an Error, nothing else") {
  for (const char* name :
       {"image/rgb.jpg", "image/progressive.jpg", "image/cmyk.jpg", "image/grey.jpg",
        "image/rgba.png", "image/palette.png", "image/palette_transparent.png"}) {
    const std::string file = read_file(golden(name));
    std::uint32_t state = 7;
    for (int round = 0; round < 300; ++round) {
      std::string changed = file;
      for (int i = 0; i < 2; ++i) {
        state = state * 1664525u + 1013904223u;
        changed[8 + (state >> 8) % (changed.size() - 8)] = static_cast<char>(state >> 24);
      }
      if (file[0] == '\x89') changed = test::with_right_checksums(changed);
      try {
        const Image image = decode(changed);
        CHECK(image.pixels.size() == image.width() * image.height() * 3);
      } catch (const Error& error) {
        CHECK(std::string(error.what()).find("picture: ") == 0);
      }
    }
  }
}

TEST_CASE("image_from_pixels: another number of channels is an error that shows the shape") {
  const Tensor<std::uint8_t, 3> pixels(Shape{2, 3, 5});
  CHECK(error_of([&] { image_from_pixels(pixels); }).second.find("[2,3,5]") != std::string::npos);
}

}  // namespace lvggt
