// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/image.h"

#include <algorithm>
#include <cstdlib>
#include <memory>
#include <string_view>

#include "kernels/io/image_check.h"
#include "kernels/io/orientation.h"
#include "lvggt/io/checked.h"
#include "lvggt/io/input_file.h"
#include "lvggt/io/read_depth_png.h"

// Static, so that a program with its own copy of stb_image still links.
#define STB_IMAGE_STATIC
#define STB_IMAGE_IMPLEMENTATION
#define STBI_ONLY_PNG
#define STBI_ONLY_JPEG
#define STBI_NO_STDIO
#define STBI_NO_LINEAR
#define STBI_FAILURE_USERMSG
#define STBI_ASSERT(condition) \
  ((condition)                 \
       ? static_cast<void>(0)  \
       : ::lvggt::fail(::lvggt::ErrorKind::kFormat, "an image breaks the rule " #condition))
#pragma GCC diagnostic push
#pragma GCC diagnostic ignored "-Wunused-function"
#include <stb_image.h>
#pragma GCC diagnostic pop

namespace lvggt {

namespace {

using DecodedPixels = std::unique_ptr<stbi_uc, void (*)(void*)>;

void check_size(std::int64_t width, std::int64_t height, std::size_t num_bytes,
                const std::string& name, const Limits& limits) {
  const auto num_pixels = checked_mul(width, height);
  if (!num_pixels || *num_pixels > limits.image_pixels)
    fail(ErrorKind::kLimit, name, ": ", width, "x", height, " pixels are more than the limit of ",
         limits.image_pixels);
  if (*num_pixels > kUncheckedPixels &&
      *num_pixels / kMaxPixelsPerByte > static_cast<std::int64_t>(num_bytes))
    fail(ErrorKind::kLimit, name, ": claims ", width, "x", height, " pixels in ", num_bytes,
         " bytes, more than the limit of ", kMaxPixelsPerByte, " a byte");
}

DecodedPixels decode(std::span<const std::byte> bytes, const std::string& name, Shape<3>& shape) {
  int width = 0, height = 0, num_channels = 0;
  DecodedPixels pixels(
      stbi_load_from_memory(reinterpret_cast<const stbi_uc*>(bytes.data()),
                            static_cast<int>(bytes.size()), &width, &height, &num_channels, 0),
      stbi_image_free);
  if (!pixels) {
    const std::string_view reason = stbi_failure_reason();
    fail(reason == "Out of memory" ? ErrorKind::kMemory : ErrorKind::kFormat, name,
         ": its pixels cannot be decoded: ", reason);
  }
  shape = Shape<3>{{height, width, num_channels}};
  return pixels;
}

// The decoder leaves colours beyond the end of a PNG's palette undefined: the file with black ones
// added. It does not look at the checksum.
std::vector<std::byte> with_full_palette(std::span<const std::byte> bytes, std::size_t palette) {
  constexpr std::size_t kFullPalette = 3 * 256;
  const std::size_t length = detail::big_endian32(bytes, palette);
  const std::size_t end = palette + 8 + length;
  std::vector<std::byte> result(bytes.begin(), bytes.begin() + static_cast<std::ptrdiff_t>(end));
  result[palette + 2] = std::byte{kFullPalette >> 8};
  result[palette + 3] = std::byte{kFullPalette & 0xff};
  result.resize(palette + 8 + kFullPalette);
  result.insert(result.end(), bytes.begin() + static_cast<std::ptrdiff_t>(end), bytes.end());
  return result;
}

// A colour sample over white, in the fixed point of Pillow's alpha_composite: 7 fractional bits and
// a division by 255 through shifts.
std::uint8_t over_white(std::uint32_t sample, std::uint32_t alpha) {
  constexpr std::uint32_t kBits = 7;
  const std::uint32_t coverage = alpha << kBits;
  const std::uint32_t sum =
      sample * coverage + 255 * ((255u << kBits) - coverage) + (0x80u << kBits);
  return static_cast<std::uint8_t>((((sum >> 8) + sum) >> 8) >> kBits);
}

// Everything that is checked before pixels are decoded.
detail::ImageHeader check_file(std::span<const std::byte> bytes, const std::string& name,
                               const Limits& limits) {
  if (bytes.empty()) fail(ErrorKind::kFormat, name, ": is empty, expected a PNG or JPEG image");
  if (bytes.size() > static_cast<std::size_t>(kMaxImageBytes))
    fail(ErrorKind::kLimit, name, ": has ", bytes.size(), " bytes, more than the limit of ",
         kMaxImageBytes);
  const FileGuess guess = guess_file(bytes.first(std::min<std::size_t>(bytes.size(), 64)));
  if (guess.kind == FileKind::kUnsupportedImage)
    fail(ErrorKind::kUnsupported, name, ": ", guess.name,
         " images are not supported, convert it to PNG or JPEG");
  if (guess.kind != FileKind::kPng && guess.kind != FileKind::kJpeg) {
    const std::string hint = content_hint(
        {reinterpret_cast<const char*>(bytes.data()), std::min<std::size_t>(bytes.size(), 1024)});
    fail(ErrorKind::kFormat, name, ": is not a PNG or JPEG image", hint.empty() ? "" : "; ", hint);
  }

  detail::ImageHeader header = guess.kind == FileKind::kPng ? detail::check_png(bytes, name)
                                                            : detail::check_jpeg(bytes, name);
  check_size(header.width, header.height, bytes.size(), name, limits);
  return header;
}

std::vector<std::byte> read_image_file(const std::string& path) {
  const InputFile file(path);
  if (file.size() > kMaxImageBytes)
    fail(ErrorKind::kLimit, path, ": has ", file.size(), " bytes, more than the limit of ",
         kMaxImageBytes);
  std::vector<std::byte> bytes(static_cast<std::size_t>(file.size()));
  file.read_at(0, bytes.data(), bytes.size());
  return bytes;
}

}  // namespace

Image image_from_pixels(View<const std::uint8_t, 3> pixels) {
  const auto [H, W, C] = pixels.shape();
  LVGGT_CHECK(H > 0 && W > 0 && C >= 1 && C <= 4, "image_from_pixels: pixels are ", pixels.shape(),
              ", expected [H, W, 1 to 4] and not empty");
  Image image{Tensor<std::uint8_t, 3>(Shape{H, W, std::int64_t{3}}), {}};
  const bool is_grey = C < 3, has_alpha = C == 2 || C == 4;
  std::uint8_t* out = image.pixels.data();
  for (std::int64_t y = 0; y < H; ++y) {
    for (std::int64_t x = 0; x < W; ++x, out += 3) {
      const std::uint8_t* in = pixels.data() + y * pixels.stride(0) + x * pixels.stride(1);
      for (int c = 0; c < 3; ++c) {
        const std::uint8_t sample = in[is_grey ? 0 : c];
        out[c] = has_alpha ? over_white(sample, in[C - 1]) : sample;
      }
    }
  }
  return image;
}

Image load_image(std::span<const std::byte> bytes, const std::string& name, const Limits& limits) {
  detail::ImageHeader header = check_file(bytes, name, limits);
  std::vector<std::byte> completed;
  if (header.short_palette != 0) bytes = completed = with_full_palette(bytes, header.short_palette);
  Shape<3> shape;
  const DecodedPixels decoded = decode(bytes, name, shape);
  Image image = image_from_pixels(View<const std::uint8_t, 3>(decoded.get(), shape));
  if (header.orientation != 1)
    image.pixels = detail::reoriented(image.pixels, detail::from_exif(header.orientation));
  image.notes = std::move(header.notes);
  return image;
}

ImageSize check_image(std::span<const std::byte> bytes, const std::string& name,
                      const Limits& limits) {
  const detail::ImageHeader header = check_file(bytes, name, limits);
  const bool transposed = detail::from_exif(header.orientation).transpose;
  return transposed ? ImageSize{header.height, header.width}
                    : ImageSize{header.width, header.height};
}

Image load_image(const std::string& path, const Limits& limits) {
  return load_image(read_image_file(path), path, limits);
}

Tensor<std::uint16_t, 2> load_grey16(const std::string& path, const Limits& limits) {
  const std::vector<std::byte> bytes = read_image_file(path);
  check_file(bytes, path, limits);
  const auto* data = reinterpret_cast<const stbi_uc*>(bytes.data());
  const auto size = static_cast<int>(bytes.size());
  int width = 0, height = 0, num_channels = 0;
  const std::unique_ptr<stbi_us, void (*)(void*)> values(
      stbi_load_16_from_memory(data, size, &width, &height, &num_channels, 0), stbi_image_free);
  if (!values)
    fail(ErrorKind::kFormat, path, ": its pixels cannot be decoded: ", stbi_failure_reason());
  if (num_channels != 1 || stbi_is_16_bit_from_memory(data, size) == 0)
    fail(ErrorKind::kFormat, path, ": is not a grey picture of 16 bits a pixel");
  Tensor<std::uint16_t, 2> grey(Shape{std::int64_t{height}, std::int64_t{width}});
  std::copy_n(values.get(), grey.size(), grey.data());
  return grey;
}

}  // namespace lvggt
