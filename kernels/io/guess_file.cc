// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <string_view>

#include "lvggt/io/image.h"

namespace lvggt {

namespace {

using std::string_view_literals::operator""sv;

struct Magic {
  std::string_view bytes;
  std::size_t offset;
  FileKind kind;
  const char* name;
};

// The first match decides.
constexpr std::array kMagics{
    Magic{"\x89PNG\r\n\x1a\n"sv, 0, FileKind::kPng, "PNG"},
    Magic{"\xff\xd8\xff"sv, 0, FileKind::kJpeg, "JPEG"},
    Magic{"GIF8"sv, 0, FileKind::kUnsupportedImage, "GIF"},
    Magic{"WEBP"sv, 8, FileKind::kUnsupportedImage, "WebP"},
    Magic{"II*\0"sv, 0, FileKind::kUnsupportedImage, "TIFF"},
    Magic{"MM\0*"sv, 0, FileKind::kUnsupportedImage, "TIFF"},
    Magic{"II+\0"sv, 0, FileKind::kUnsupportedImage, "BigTIFF"},
    Magic{"MM\0+"sv, 0, FileKind::kUnsupportedImage, "BigTIFF"},
    Magic{"ftyphei"sv, 4, FileKind::kUnsupportedImage, "HEIC"},
    Magic{"ftyphev"sv, 4, FileKind::kUnsupportedImage, "HEIC"},
    Magic{"ftypmif1"sv, 4, FileKind::kUnsupportedImage, "HEIC"},
    Magic{"ftypmsf1"sv, 4, FileKind::kUnsupportedImage, "HEIC"},
    Magic{"ftypavi"sv, 4, FileKind::kUnsupportedImage, "AVIF"},
    Magic{"ftypcrx"sv, 4, FileKind::kUnsupportedImage, "Canon CR3"},
    Magic{"\x76\x2f\x31\x01"sv, 0, FileKind::kUnsupportedImage, "OpenEXR"},
    Magic{"\0\0\0\x0cJXL "sv, 0, FileKind::kUnsupportedImage, "JPEG XL"},
    Magic{"\xff\x0a"sv, 0, FileKind::kUnsupportedImage, "JPEG XL"},
    Magic{"\0\0\0\x0cjP  "sv, 0, FileKind::kUnsupportedImage, "JPEG 2000"},
    Magic{"\xff\x4f\xff\x51"sv, 0, FileKind::kUnsupportedImage, "JPEG 2000"},
    Magic{"\xff\xd8\xf7"sv, 0, FileKind::kUnsupportedImage, "JPEG-LS"},
    Magic{"8BPS"sv, 0, FileKind::kUnsupportedImage, "Photoshop"},
    Magic{"#?RADIANCE"sv, 0, FileKind::kUnsupportedImage, "Radiance HDR"},
    Magic{"qoif"sv, 0, FileKind::kUnsupportedImage, "QOI"},
    Magic{"DDS "sv, 0, FileKind::kUnsupportedImage, "DDS"},
    Magic{"\0\0\1\0"sv, 0, FileKind::kUnsupportedImage, "ICO"},
    Magic{"#EXTM3U"sv, 0, FileKind::kPlaylist, "an HLS playlist"},
    Magic{"ffconcat"sv, 0, FileKind::kPlaylist, "a concat playlist"},
    Magic{"[playlist]"sv, 0, FileKind::kPlaylist, "a playlist"},
    Magic{"<MPD"sv, 0, FileKind::kPlaylist, "a DASH playlist"},
    Magic{"<?xml"sv, 0, FileKind::kPlaylist, "an XML file or DASH playlist"},
    Magic{"v=0"sv, 0, FileKind::kPlaylist, "an SDP session description"},
    Magic{"<svg"sv, 0, FileKind::kUnsupportedImage, "SVG"},
};

// "P6\n" and its relatives, and "BM": too short to be trusted without the byte that follows.
std::string_view short_magic(std::string_view head) {
  if (head.size() >= 3 && head[0] == 'P' && head[1] >= '1' && head[1] <= '7' &&
      (head[2] == '\n' || head[2] == ' '))
    return "PNM";
  if (head.size() >= 10 && head.substr(0, 2) == "BM" && head.substr(6, 4) == "\0\0\0\0"sv)
    return "BMP";
  return {};
}

}  // namespace

FileGuess guess_file(std::span<const std::byte> head) {
  const std::string_view text(reinterpret_cast<const char*>(head.data()), head.size());
  for (const Magic& magic : kMagics)
    if (text.size() >= magic.offset && text.substr(magic.offset).starts_with(magic.bytes))
      return {magic.kind, magic.name};
  if (const std::string_view name = short_magic(text); !name.empty())
    return {FileKind::kUnsupportedImage, std::string(name)};
  return {FileKind::kOther, {}};
}

}  // namespace lvggt
