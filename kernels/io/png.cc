// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/png.h"

#include <png.h>

#include <bit>
#include <csetjmp>
#include <exception>
#include <string>
#include <vector>

#include "lvggt/io/atomic_file.h"

namespace lvggt {
namespace {

// The larger of the two sides PNG_USER_WIDTH_MAX and _HEIGHT_MAX that readers accept by default.
constexpr std::int64_t kMaxSide = 1'000'000;

// What libpng's callbacks share. They must not let an exception cross libpng's C frames: a failure
// is kept here and libpng is left by its own error path.
struct Encoder {
  std::string bytes;
  std::string message;
  std::exception_ptr exception;
};

void append_bytes(png_structp png, png_bytep data, png_size_t size) {
  auto& encoder = *static_cast<Encoder*>(png_get_io_ptr(png));
  try {
    encoder.bytes.append(reinterpret_cast<const char*>(data), size);
    return;
  } catch (...) {
    encoder.exception = std::current_exception();
  }
  png_error(png, "out of memory");
}

void keep_error(png_structp png, png_const_charp message) {
  auto& encoder = *static_cast<Encoder*>(png_get_error_ptr(png));
  try {
    encoder.message = message;
  } catch (...) {
    encoder.exception = std::current_exception();
  }
  png_longjmp(png, 1);
}

void ignore_warning(png_structp, png_const_charp) {}

struct Picture {
  std::int64_t width, height;
  int bit_depth, color_type;
  std::vector<png_const_bytep> rows;
};

// Runs libpng. Nothing with a destructor lives in this frame, which libpng may leave by longjmp.
bool encode(Encoder& encoder, const Picture& picture) {
  png_structp png =
      png_create_write_struct(PNG_LIBPNG_VER_STRING, &encoder, keep_error, ignore_warning);
  if (png == nullptr) return false;
  png_infop info = png_create_info_struct(png);
  if (info == nullptr || setjmp(png_jmpbuf(png)) != 0) {
    png_destroy_write_struct(&png, &info);
    return false;
  }
  png_set_write_fn(png, &encoder, append_bytes, nullptr);
  // Level 3 costs a third of the default's time and gives files a few per cent larger.
  png_set_compression_level(png, 3);
  png_set_IHDR(png, info, static_cast<png_uint_32>(picture.width),
               static_cast<png_uint_32>(picture.height), picture.bit_depth, picture.color_type,
               PNG_INTERLACE_NONE, PNG_COMPRESSION_TYPE_DEFAULT, PNG_FILTER_TYPE_DEFAULT);
  png_write_info(png, info);
  if (picture.bit_depth == 16 && std::endian::native == std::endian::little) png_set_swap(png);
  for (const png_const_bytep row : picture.rows) png_write_row(png, row);
  png_write_end(png, nullptr);
  png_destroy_write_struct(&png, &info);
  return true;
}

void write_picture(const std::string& path, const Picture& picture) {
  LVGGT_CHECK(picture.width >= 1 && picture.height >= 1 && picture.width <= kMaxSide &&
                  picture.height <= kMaxSide,
              path, ": a PNG cannot be ", picture.width, " x ", picture.height, " pixels");
  Encoder encoder;
  if (!encode(encoder, picture)) {
    if (encoder.exception) std::rethrow_exception(encoder.exception);
    fail(ErrorKind::kWrite, path, ": cannot be encoded as PNG: ",
         encoder.message.empty() ? "out of memory" : encoder.message);
  }
  AtomicFile file(path);
  file.write(encoder.bytes);
  file.commit();
}

}  // namespace

void write_png(const std::string& path, View<const std::uint8_t, 3> pixels) {
  const auto [H, W, C] = pixels.shape();
  LVGGT_CHECK((C == 1 || C == 3) && pixels.stride(1) == C, path,
              ": an 8-bit PNG needs dense pixels of 1 or 3 channels, not ", pixels.shape());
  Picture picture{W, H, 8, C == 3 ? PNG_COLOR_TYPE_RGB : PNG_COLOR_TYPE_GRAY, {}};
  for (std::int64_t y = 0; y < H; ++y) picture.rows.push_back(pixels[y].data());
  write_picture(path, picture);
}

void write_png(const std::string& path, View<const std::uint16_t, 2> pixels) {
  const auto [H, W] = pixels.shape();
  Picture picture{W, H, 16, PNG_COLOR_TYPE_GRAY, {}};
  for (std::int64_t y = 0; y < H; ++y)
    picture.rows.push_back(reinterpret_cast<png_const_bytep>(pixels[y].data()));
  write_picture(path, picture);
}

}  // namespace lvggt
