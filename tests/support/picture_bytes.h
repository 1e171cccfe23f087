// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cstddef>
#include <cstdint>
#include <fstream>
#include <iterator>
#include <stdexcept>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/io/image.h"
#include "tests/support/paths.h"

namespace lvggt::test {

// Picture files are built and damaged as strings.
inline std::string read_file(const std::string& path) {
  std::ifstream file(path, std::ios::binary);
  if (!file) throw std::runtime_error("cannot open " + path);
  return {std::istreambuf_iterator<char>(file), {}};
}

inline void write_file(const std::string& path, std::string_view bytes) {
  std::ofstream file(path, std::ios::binary);
  file.write(bytes.data(), static_cast<std::streamsize>(bytes.size()));
  if (!file.flush()) throw std::runtime_error("cannot write " + path);
}

inline std::string golden(const std::string& name) { return test_data("golden/") + name; }

inline Image decode(std::string_view bytes, const Limits& limits = {}) {
  return load_image(std::as_bytes(std::span(bytes.data(), bytes.size())), "picture", limits);
}

inline std::string big_endian(std::uint32_t value, int num_bytes) {
  std::string text;
  for (int shift = 8 * (num_bytes - 1); shift >= 0; shift -= 8)
    text += static_cast<char>(value >> shift & 0xff);
  return text;
}

// A chunk with its checksum, computed bit by bit.
inline std::string png_chunk(const std::string& type, const std::string& data) {
  std::uint32_t crc = 0xffffffffu;
  for (const char c : type + data) {
    crc ^= static_cast<unsigned char>(c);
    for (int bit = 0; bit < 8; ++bit) crc = (crc >> 1) ^ ((crc & 1) ? 0xedb88320u : 0);
  }
  return big_endian(static_cast<std::uint32_t>(data.size()), 4) + type + data + big_endian(~crc, 4);
}

// A PNG up to its end chunk: signature, header, and the chunks given.
inline std::string png(std::uint32_t width, std::uint32_t height, const std::string& chunks,
                       int depth = 8, int color_type = 2) {
  using std::string_literals::operator""s;
  const std::string header = big_endian(width, 4) + big_endian(height, 4) +
                             static_cast<char>(depth) + static_cast<char>(color_type) + "\0\0\0"s;
  return "\x89PNG\r\n\x1a\n" + png_chunk("IHDR", header) + chunks + png_chunk("IEND", "");
}

// A damaged PNG as if it had been written that way, so that the damage gets past the checksums.
inline std::string with_right_checksums(const std::string& png) {
  std::string result = png.substr(0, 8);
  for (std::size_t at = 8; at + 12 <= png.size();) {
    std::size_t length = 0;
    for (std::size_t i = 0; i < 4; ++i)
      length = length << 8 | static_cast<unsigned char>(png[at + i]);
    length = std::min(length, png.size() - at - 12);
    result += png_chunk(png.substr(at + 4, 4), png.substr(at + 8, length));
    at += length + 12;
  }
  return result;
}

// The file with a segment put in after the start marker.
inline std::string with_jpeg_segment(const std::string& jpeg, unsigned char marker,
                                     const std::string& data) {
  return jpeg.substr(0, 2) + '\xff' + static_cast<char>(marker) +
         big_endian(static_cast<std::uint32_t>(data.size() + 2), 2) + data + jpeg.substr(2);
}

// An EXIF block whose only entry is the orientation.
inline std::string exif_with_orientation(int orientation) {
  using std::string_literals::operator""s;
  return "Exif\0\0MM\0*\0\0\0\x08\0\x01"s + "\x01\x12\0\x03\0\0\0\x01"s +
         big_endian(static_cast<std::uint32_t>(orientation), 2) + "\0\0\0\0\0\0"s;
}

}  // namespace lvggt::test
