// SPDX-License-Identifier: Apache-2.0
#include <string_view>

#include "kernels/io/image_check.h"
#include "lvggt/core/error.h"
#include "lvggt/io/image.h"

namespace lvggt::detail {

namespace {

enum Marker : std::uint32_t {
  kTem = 0x01,
  kSof0 = 0xc0,
  kSof2 = 0xc2,
  kDht = 0xc4,
  kJpg = 0xc8,
  kSof9 = 0xc9,
  kSof15 = 0xcf,
  kDac = 0xcc,
  kRst0 = 0xd0,
  kRst7 = 0xd7,
  kSoi = 0xd8,
  kEoi = 0xd9,
  kSos = 0xda,
  kApp1 = 0xe1,
  kApp2 = 0xe2,
  kApp14 = 0xee,
};

bool is_frame_header(std::uint32_t marker) {
  return marker >= kSof0 && marker <= kSof15 && marker != kDht && marker != kJpg && marker != kDac;
}

bool starts_with(std::span<const std::byte> data, std::string_view text) {
  return data.size() >= text.size() &&
         std::string_view(reinterpret_cast<const char*>(data.data()), text.size()) == text;
}

// Reads a JPEG marker by marker.
class JpegWalk {
 public:
  JpegWalk(std::span<const std::byte> bytes, const std::string& name)
      : bytes_(bytes), name_(name) {}

  ImageHeader run() {
    at_ = 2;  // after the start marker
    while (true) {
      const std::uint32_t marker = next_marker();
      if (marker == kEoi) break;
      if (marker == kTem || marker == kSoi || (marker >= kRst0 && marker <= kRst7)) continue;
      segment(marker, next_segment());
      if (marker == kSos) skip_scan();
    }
    if (num_components_ == 0 || num_scans_ == 0)
      fail(ErrorKind::kFormat, name_, ": the JPEG holds no ",
           num_components_ == 0 ? "frame header" : "pixels");
    if (num_components_ == 4 && !has_adobe_)
      fail(ErrorKind::kUnsupported, name_,
           ": is a JPEG of four components without Adobe's marker, so that its colours are not "
           "defined");
    return std::move(header_);
  }

 private:
  [[noreturn]] void truncated() const {
    fail(ErrorKind::kFormat, name_, ": the JPEG is truncated: its ", bytes_.size(), " bytes end ",
         num_scans_ == 0 ? concat("before the pixels")
                         : concat("in scan ", num_scans_, ", without the end marker"));
  }

  std::uint32_t next_marker() {
    if (at_ >= bytes_.size()) truncated();
    if (byte_at(bytes_, at_) != 0xff)
      fail(ErrorKind::kFormat, name_, ": the JPEG is damaged: no marker at byte ", at_);
    while (at_ < bytes_.size() && byte_at(bytes_, at_) == 0xff) ++at_;  // fill bytes are allowed
    if (at_ >= bytes_.size()) truncated();
    return byte_at(bytes_, at_++);
  }

  std::span<const std::byte> next_segment() {
    if (bytes_.size() - at_ < 2) truncated();
    const std::size_t length = big_endian16(bytes_, at_);
    if (length < 2)
      fail(ErrorKind::kFormat, name_, ": the JPEG is damaged: the segment at byte ", at_,
           " has length ", length);
    if (bytes_.size() - at_ < length) truncated();
    const auto data = bytes_.subspan(at_ + 2, length - 2);
    at_ += length;
    return data;
  }

  void segment(std::uint32_t marker, std::span<const std::byte> data) {
    if (is_frame_header(marker)) frame_header(marker, data);
    if (marker == kApp1 && !has_exif_ && starts_with(data, {"Exif\0\0", 6})) {
      has_exif_ = true;
      header_.orientation = exif_orientation(data, name_, header_.notes);
    }
    if (marker == kApp2 && !has_profile_ && starts_with(data, {"ICC_PROFILE\0", 12})) {
      has_profile_ = true;
      header_.notes.push_back(concat(name_, ": the colour profile is ignored"));
    }
    if (marker == kApp14 && starts_with(data, "Adobe")) has_adobe_ = true;
    if (marker == kSos && ++num_scans_ > kMaxJpegScans)
      fail(ErrorKind::kLimit, name_, ": the JPEG has more than the limit of ", kMaxJpegScans,
           " scans");
  }

  void frame_header(std::uint32_t marker, std::span<const std::byte> data) {
    if (num_components_ != 0) fail(ErrorKind::kFormat, name_, ": the JPEG has two frame headers");
    if (data.size() < 6) fail(ErrorKind::kFormat, name_, ": the JPEG's frame header is too short");
    if (marker > kSof2)
      fail(ErrorKind::kUnsupported, name_, ": is ",
           marker >= kSof9 ? "an arithmetic-coded" : "a lossless or hierarchical",
           " JPEG; convert it to baseline or progressive JPEG");
    if (byte_at(data, 0) != 8)
      fail(ErrorKind::kUnsupported, name_, ": is a JPEG of ", byte_at(data, 0),
           " bits a sample, only 8 are supported");
    header_.height = big_endian16(data, 1);
    header_.width = big_endian16(data, 3);
    if (header_.width == 0 || header_.height == 0)
      fail(ErrorKind::kFormat, name_, ": the JPEG's frame header gives the size ", header_.width,
           "x", header_.height);
    num_components_ = static_cast<int>(byte_at(data, 5));
    if (num_components_ != 1 && num_components_ != 3 && num_components_ != 4)
      fail(ErrorKind::kUnsupported, name_, ": is a JPEG of ", num_components_,
           " components, only 1, 3 and 4 are supported");
  }

  // Entropy-coded data: a 0xff in it is followed by 0, by a restart marker or by another 0xff.
  void skip_scan() {
    while (at_ + 1 < bytes_.size()) {
      if (byte_at(bytes_, at_) == 0xff) {
        const std::uint32_t next = byte_at(bytes_, at_ + 1);
        if (next != 0 && next != 0xff && (next < kRst0 || next > kRst7)) return;
      }
      ++at_;
    }
    truncated();
  }

  std::span<const std::byte> bytes_;
  const std::string& name_;
  std::size_t at_ = 0;
  ImageHeader header_;
  int num_components_ = 0;
  int num_scans_ = 0;
  bool has_exif_ = false, has_profile_ = false, has_adobe_ = false;
};

}  // namespace

ImageHeader check_jpeg(std::span<const std::byte> bytes, const std::string& name) {
  return JpegWalk(bytes, name).run();
}

}  // namespace lvggt::detail
