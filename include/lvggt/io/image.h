// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/io/limits.h"

namespace lvggt {

// Above this many pixels a file must have at least one byte for every kMaxPixelsPerByte of them.
// The emptiest JPEG has about 170 pixels a byte; only a picture made to exhaust memory has more.
inline constexpr std::int64_t kUncheckedPixels = std::int64_t{1} << 24;
inline constexpr std::int64_t kMaxPixelsPerByte = 256;

// Largest picture file that is read into memory.
inline constexpr std::int64_t kMaxImageBytes = std::int64_t{1} << 30;

// A progressive JPEG with more scans than this is refused: each one costs a pass over all pixels,
// while encoders write about ten.
inline constexpr int kMaxJpegScans = 100;

// An 8-bit RGB picture, upright and opaque.
struct Image {
  Tensor<std::uint8_t, 3> pixels;  // [H, W, 3]
  std::vector<std::string> notes;  // sentences on what the file says that was not followed

  std::int64_t width() const { return pixels.extent(1); }
  std::int64_t height() const { return pixels.extent(0); }
};

// What the first bytes of a file say it is, as far as pictures and videos are concerned.
enum class FileKind { kPng, kJpeg, kUnsupportedImage, kPlaylist, kOther };
struct FileGuess {
  FileKind kind;
  std::string name;  // "PNG", "HEIC", "an HLS playlist", ...; empty for kOther
};
// 64 bytes are enough; fewer are fine.
FileGuess guess_file(std::span<const std::byte> head);

// Reads a PNG or JPEG; the content decides which, not the name. 16-bit samples keep their upper
// byte, grey and palettes become RGB, transparency is composited on white with Pillow's rounding,
// CMYK and YCCK are converted when Adobe's marker defines them, and the EXIF orientation is
// applied. Colour profiles are ignored with a note.
//
// Errors: kRead (missing, not a regular file), kFormat (not an image, empty, truncated, wrong
// checksum), kUnsupported (another image format by name, animation, 12-bit, arithmetic coding),
// kLimit (too many pixels for the limits or for the size of the file, too many scans). Sizes are
// checked before decoding.
Image load_image(const std::string& path, const Limits& limits = {});

// The same from memory; `name` stands for the file in messages.
Image load_image(std::span<const std::byte> bytes, const std::string& name,
                 const Limits& limits = {});

// Width and height of the picture that load_image() would give, from a walk over the whole file:
// structure, checksums and limits are checked as there, but no pixel is decoded.
struct ImageSize {
  std::int64_t width = 0, height = 0;
  friend bool operator==(const ImageSize&, const ImageSize&) = default;
};
ImageSize check_image(std::span<const std::byte> bytes, const std::string& name,
                      const Limits& limits = {});

// An Image of pixels already decoded: grey, grey + alpha, RGB or RGBA by the number of channels.
Image image_from_pixels(View<const std::uint8_t, 3> pixels);  // [H, W, 1 to 4]

}  // namespace lvggt
