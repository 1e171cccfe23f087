// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

namespace lvggt::detail {

// What a picture file says before its pixels are decoded.
struct ImageHeader {
  std::int64_t width = 0, height = 0;
  int orientation = 1;             // EXIF, 1 to 8
  std::vector<std::string> notes;  // see Image::notes
  std::size_t short_palette = 0;  // where a PNG's palette chunk starts if it has fewer colours than
                                  // samples can name; else 0
};

// Walk a whole file, from the signature to the end marker, without decoding pixels. The decoder is
// lenient about checksums and missing ends; these are not. Errors name `name`, the place and the
// rule.
ImageHeader check_png(std::span<const std::byte> bytes, const std::string& name);
ImageHeader check_jpeg(std::span<const std::byte> bytes, const std::string& name);

// The orientation tag of an EXIF block that starts with "Exif\0\0"; 1 and a note if it holds
// nonsense.
int exif_orientation(std::span<const std::byte> exif, const std::string& name,
                     std::vector<std::string>& notes);

inline std::uint32_t byte_at(std::span<const std::byte> bytes, std::size_t i) {
  return std::to_integer<std::uint32_t>(bytes[i]);
}
inline std::uint32_t big_endian16(std::span<const std::byte> bytes, std::size_t i) {
  return byte_at(bytes, i) << 8 | byte_at(bytes, i + 1);
}
inline std::uint32_t big_endian32(std::span<const std::byte> bytes, std::size_t i) {
  return big_endian16(bytes, i) << 16 | big_endian16(bytes, i + 2);
}

}  // namespace lvggt::detail
