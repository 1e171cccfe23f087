// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <string_view>

#include "kernels/io/image_check.h"
#include "lvggt/core/error.h"

namespace lvggt::detail {

namespace {

// CRC-32 of ISO 3309, as PNG uses it.
constexpr std::array<std::uint32_t, 256> kCrcTable = [] {
  std::array<std::uint32_t, 256> table{};
  for (std::uint32_t n = 0; n < 256; ++n) {
    std::uint32_t c = n;
    for (int bit = 0; bit < 8; ++bit) c = (c & 1) ? 0xedb88320u ^ (c >> 1) : c >> 1;
    table[n] = c;
  }
  return table;
}();

std::uint32_t crc32(std::span<const std::byte> bytes) {
  std::uint32_t c = 0xffffffffu;
  for (const std::byte b : bytes)
    c = kCrcTable[(c ^ std::to_integer<std::uint32_t>(b)) & 0xff] ^ (c >> 8);
  return ~c;
}

bool valid_depth(std::uint32_t depth, std::uint32_t color_type) {
  switch (color_type) {
    case 0:
      return depth == 1 || depth == 2 || depth == 4 || depth == 8 || depth == 16;
    case 3:
      return depth == 1 || depth == 2 || depth == 4 || depth == 8;
    case 2:
    case 4:
    case 6:
      return depth == 8 || depth == 16;
    default:
      return false;
  }
}

// Returns how many colours a sample can name, 0 without a palette.
std::size_t read_ihdr(std::span<const std::byte> data, const std::string& name,
                      ImageHeader& header) {
  if (data.size() != 13)
    fail(ErrorKind::kFormat, name, ": its PNG header has ", data.size(), " bytes instead of 13");
  header.width = big_endian32(data, 0);
  header.height = big_endian32(data, 4);
  if (header.width == 0 || header.height == 0 || header.width > 0x7fffffff ||
      header.height > 0x7fffffff)
    fail(ErrorKind::kFormat, name, ": its PNG header gives the impossible size ", header.width, "x",
         header.height);
  if (!valid_depth(byte_at(data, 8), byte_at(data, 9)))
    fail(ErrorKind::kFormat, name, ": its PNG header combines bit depth ", byte_at(data, 8),
         " with colour type ", byte_at(data, 9), ", which is not defined");
  return byte_at(data, 9) == 3 ? std::size_t{1} << byte_at(data, 8) : 0;
}

void read_chunk(std::string_view type, std::span<const std::byte> data, const std::string& name,
                ImageHeader& header) {
  if (type == "acTL")
    fail(ErrorKind::kUnsupported, name,
         ": is an animated PNG; extract its frames to a folder or a video");
  if (type == "CgBI")
    fail(ErrorKind::kUnsupported, name,
         ": is a PNG in Apple's private CgBI variant; convert it to standard PNG");
  if (type == "iCCP") header.notes.push_back(concat(name, ": the colour profile is ignored"));
  if (type == "eXIf") {
    std::vector<std::byte> exif{
        std::byte{'E'}, std::byte{'x'}, std::byte{'i'}, std::byte{'f'}, {}, {}};
    exif.insert(exif.end(), data.begin(), data.end());
    header.orientation = exif_orientation(exif, name, header.notes);
  }
}

}  // namespace

ImageHeader check_png(std::span<const std::byte> bytes, const std::string& name) {
  ImageHeader header;
  bool has_pixels = false;
  std::size_t num_colors = 0;
  std::size_t at = 8;  // after the signature
  while (true) {
    const std::size_t left = bytes.size() - at;
    const std::size_t length = left >= 4 ? big_endian32(bytes, at) : 0;
    if (left < 12 || length > left - 12)
      fail(ErrorKind::kFormat, name, ": the PNG is truncated: the chunk at byte ", at, " needs ",
           length + 12, " bytes but ", left, " are left");
    const auto data = bytes.subspan(at + 8, length);
    const std::string_view type(reinterpret_cast<const char*>(bytes.data()) + at + 4, 4);
    if (crc32(bytes.subspan(at + 4, length + 4)) != big_endian32(bytes, at + 8 + length))
      fail(ErrorKind::kFormat, name, ": the PNG is damaged: the chunk at byte ", at,
           " has a wrong checksum");
    if (at == 8 && type != "IHDR" && type != "CgBI")
      fail(ErrorKind::kFormat, name, ": the PNG does not start with its header chunk");
    if (type == "IHDR") num_colors = read_ihdr(data, name, header);
    if (type == "PLTE" && data.size() < 3 * num_colors) header.short_palette = at;
    if (type == "IDAT") has_pixels = true;
    if (type == "IEND") break;
    read_chunk(type, data, name, header);
    at += length + 12;
  }
  if (!has_pixels) fail(ErrorKind::kFormat, name, ": the PNG holds no pixels");
  return header;
}

}  // namespace lvggt::detail
