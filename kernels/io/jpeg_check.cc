// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <string_view>
#include <utility>

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
  kDac = 0xcc,
  kSof15 = 0xcf,
  kRst0 = 0xd0,
  kRst7 = 0xd7,
  kSoi = 0xd8,
  kEoi = 0xd9,
  kSos = 0xda,
  kDqt = 0xdb,
  kDri = 0xdd,
  kApp1 = 0xe1,
  kApp2 = 0xe2,
  kApp14 = 0xee,
};

bool is_frame_header(std::uint32_t marker) {
  return marker >= kSof0 && marker <= kSof15 && marker != kDht && marker != kJpg && marker != kDac;
}

bool is_restart(std::uint32_t marker) { return marker >= kRst0 && marker <= kRst7; }

bool starts_with(std::span<const std::byte> data, std::string_view text) {
  return data.size() >= text.size() &&
         std::string_view(reinterpret_cast<const char*>(data.data()), text.size()) == text;
}

std::int64_t ceil_div(std::int64_t a, std::int64_t b) { return (a + b - 1) / b; }

struct Component {
  std::uint32_t id = 0;
  std::int64_t h = 1, v = 1;  // sampling factors
  std::uint32_t quantization = 0;
  bool has_pixels = false;  // named by a scan that carries its mean values
};

// Reads a JPEG marker by marker. Everything the decoder takes from a table is checked to have been
// defined, and every table to have a possible size: the decoder relies on both.
class JpegWalk {
 public:
  JpegWalk(std::span<const std::byte> bytes, const std::string& name)
      : bytes_(bytes), name_(name) {}

  ImageHeader run() {
    at_ = 2;  // after the start marker
    while (true) {
      const std::uint32_t marker = next_marker();
      if (marker == kEoi) break;
      if (marker == kTem || marker == kSoi || is_restart(marker)) continue;
      segment(marker, next_segment());
    }
    if (components_.empty()) damaged("it has no frame header");
    for (const Component& component : components_)
      if (!component.has_pixels) damaged("component ", component.id, " has no pixels");
    if (components_.size() == 4 && !has_adobe_)
      fail(ErrorKind::kUnsupported, name_,
           ": is a JPEG of four components without Adobe's marker, so that its colours are not "
           "defined");
    return std::move(header_);
  }

 private:
  template <class... Args>
  [[noreturn]] void damaged(const Args&... args) const {
    fail(ErrorKind::kFormat, name_, ": the JPEG is damaged: ", args...);
  }

  [[noreturn]] void truncated() const {
    fail(ErrorKind::kFormat, name_, ": the JPEG is truncated: its ", bytes_.size(), " bytes end ",
         num_scans_ == 0 ? concat("before the pixels")
                         : concat("in scan ", num_scans_, ", without the end marker"));
  }

  std::uint32_t next_marker() {
    if (at_ >= bytes_.size()) truncated();
    if (byte_at(bytes_, at_) != 0xff) damaged("no marker at byte ", at_);
    while (at_ < bytes_.size() && byte_at(bytes_, at_) == 0xff) ++at_;  // fill bytes are allowed
    if (at_ >= bytes_.size()) truncated();
    return byte_at(bytes_, at_++);
  }

  std::span<const std::byte> next_segment() {
    if (bytes_.size() - at_ < 2) truncated();
    const std::size_t length = big_endian16(bytes_, at_);
    if (length < 2) damaged("the segment at byte ", at_, " has length ", length);
    if (bytes_.size() - at_ < length) truncated();
    const auto data = bytes_.subspan(at_ + 2, length - 2);
    at_ += length;
    return data;
  }

  void segment(std::uint32_t marker, std::span<const std::byte> data) {
    if (is_frame_header(marker)) frame_header(marker, data);
    if (marker == kDht) huffman_tables(data);
    if (marker == kDqt) quantization_tables(data);
    if (marker == kDri) {
      if (data.size() != 2) damaged("its restart interval has ", data.size(), " bytes");
      restart_interval_ = big_endian16(data, 0);
    }
    if (marker == kSos) scan(data);
    if (marker == kApp1 && !has_exif_ && starts_with(data, {"Exif\0\0", 6})) {
      has_exif_ = true;
      header_.orientation = exif_orientation(data, name_, header_.notes);
    }
    if (marker == kApp2 && !has_profile_ && starts_with(data, {"ICC_PROFILE\0", 12})) {
      has_profile_ = true;
      header_.notes.push_back(concat(name_, ": the colour profile is ignored"));
    }
    if (marker == kApp14 && starts_with(data, "Adobe")) has_adobe_ = true;
  }

  void frame_header(std::uint32_t marker, std::span<const std::byte> data) {
    if (!components_.empty()) damaged("it has two frame headers");
    if (marker > kSof2)
      fail(ErrorKind::kUnsupported, name_, ": is ",
           marker >= kSof9 ? "an arithmetic-coded" : "a lossless or hierarchical",
           " JPEG; convert it to baseline or progressive JPEG");
    is_progressive_ = marker == kSof2;
    if (data.size() < 6) damaged("its frame header is too short");
    if (byte_at(data, 0) != 8)
      fail(ErrorKind::kUnsupported, name_, ": is a JPEG of ", byte_at(data, 0),
           " bits a sample, only 8 are supported");
    header_.height = big_endian16(data, 1);
    header_.width = big_endian16(data, 3);
    if (header_.width == 0 || header_.height == 0)
      damaged("its size is ", header_.width, "x", header_.height);
    const std::size_t num_components = byte_at(data, 5);
    if (num_components != 1 && num_components != 3 && num_components != 4)
      fail(ErrorKind::kUnsupported, name_, ": is a JPEG of ", num_components,
           " components, only 1, 3 and 4 are supported");
    if (data.size() != 6 + 3 * num_components) damaged("its frame header has a wrong length");
    for (std::size_t i = 6; i < data.size(); i += 3) {
      const std::uint32_t sampling = byte_at(data, i + 1);
      Component component{byte_at(data, i), sampling >> 4, sampling & 15, byte_at(data, i + 2)};
      if (component.h < 1 || component.h > 4 || component.v < 1 || component.v > 4)
        damaged("component ", component.id, " has impossible sampling factors");
      components_.push_back(component);
    }
  }

  // Class and number, 16 counts of codes by length, the coded values.
  void huffman_tables(std::span<const std::byte> data) {
    while (!data.empty()) {
      if (data.size() < 17) damaged("a Huffman table is cut short");
      const std::uint32_t which = byte_at(data, 0);
      if (which >> 4 > 1 || (which & 15) > 3) damaged("there is no Huffman table ", which);
      std::size_t num_codes = 0;
      std::size_t num_free = 1;  // codes of the current length that are not taken
      for (std::size_t length = 1; length <= 16; ++length) {
        const std::size_t count = byte_at(data, length);
        num_free *= 2;
        if (count > num_free) damaged("a Huffman table has too many codes of ", length, " bits");
        num_free -= count;
        num_codes += count;
      }
      if (num_codes > 256 || data.size() < 17 + num_codes)
        damaged("a Huffman table claims ", num_codes, " codes");
      has_huffman_[which >> 4][which & 15] = true;
      data = data.subspan(17 + num_codes);
    }
  }

  void quantization_tables(std::span<const std::byte> data) {
    while (!data.empty()) {
      const std::uint32_t which = byte_at(data, 0);
      const std::size_t size = which >> 4 == 0 ? 65 : 129;
      if (which >> 4 > 1 || (which & 15) > 3 || data.size() < size)
        damaged("it has an impossible quantization table");
      has_quantization_[which & 15] = true;
      data = data.subspan(size);
    }
  }

  // A scan header and the entropy-coded data after it.
  void scan(std::span<const std::byte> data) {
    if (++num_scans_ > kMaxJpegScans)
      fail(ErrorKind::kLimit, name_, ": the JPEG has more than the limit of ", kMaxJpegScans,
           " scans");
    const std::size_t num_in_scan = data.empty() ? 0 : byte_at(data, 0);
    if (num_in_scan < 1 || num_in_scan > components_.size() || data.size() != 4 + 2 * num_in_scan)
      damaged("the header of scan ", num_scans_, " is not possible");
    const std::uint32_t first = byte_at(data, data.size() - 3),
                        last = byte_at(data, data.size() - 2);
    const bool refines = byte_at(data, data.size() - 1) >> 4 != 0;
    const Component* component = nullptr;
    for (std::size_t i = 0; i < num_in_scan; ++i) {
      const std::uint32_t tables = byte_at(data, 2 + 2 * i);
      component = &scan_component(byte_at(data, 1 + 2 * i), !is_progressive_ || first == 0);
      need_table(0, tables >> 4, !is_progressive_ || (first == 0 && !refines));
      need_table(1, tables & 15, !is_progressive_ || last > 0);
    }
    skip_entropy_coded(num_in_scan > 1 ? nullptr : component);
  }

  Component& scan_component(std::uint32_t id, bool carries_means) {
    const auto found = std::find_if(components_.begin(), components_.end(),
                                    [=](const Component& c) { return c.id == id; });
    if (found == components_.end()) damaged("scan ", num_scans_, " names component ", id);
    if (found->quantization > 3 || !has_quantization_[found->quantization])
      damaged("component ", id, " has no quantization table");
    found->has_pixels = found->has_pixels || carries_means;
    return *found;
  }

  void need_table(std::size_t table_class, std::uint32_t which, bool is_used) const {
    if (is_used && (which > 3 || !has_huffman_[table_class][which]))
      damaged("scan ", num_scans_, " uses a Huffman table that is not defined");
  }

  // A 0xff in the data is followed by 0, by a restart marker or by another 0xff. With restart
  // markers the number of them tells whether the scan is complete; `alone` is the only component of
  // the scan, if so.
  void skip_entropy_coded(const Component* alone) {
    std::int64_t num_restarts = 0;
    bool ended = false;
    while (!ended && at_ + 1 < bytes_.size()) {
      const std::uint32_t next = byte_at(bytes_, at_ + 1);
      if (byte_at(bytes_, at_) != 0xff || next == 0xff) {
        ++at_;
      } else if (next == 0 || is_restart(next)) {
        num_restarts += next != 0;
        at_ += 2;
      } else {
        ended = true;
      }
    }
    if (!ended) truncated();
    if (restart_interval_ == 0) return;
    const std::int64_t expected = ceil_div(num_units(alone), restart_interval_) - 1;
    if (num_restarts < expected)
      damaged("scan ", num_scans_, " has ", num_restarts, " of ", expected, " restart markers");
  }

  // Units of a scan between which restart markers are counted: blocks of 8x8 samples of one
  // component, or groups of blocks that cover the same pixels.
  std::int64_t num_units(const Component* alone) const {
    std::int64_t h = 1, v = 1;
    for (const Component& component : components_) {
      h = std::max(h, component.h);
      v = std::max(v, component.v);
    }
    if (!alone) return ceil_div(header_.width, 8 * h) * ceil_div(header_.height, 8 * v);
    return ceil_div(ceil_div(header_.width * alone->h, h), 8) *
           ceil_div(ceil_div(header_.height * alone->v, v), 8);
  }

  std::span<const std::byte> bytes_;
  const std::string& name_;
  std::size_t at_ = 0;
  ImageHeader header_;
  std::vector<Component> components_;
  std::array<std::array<bool, 4>, 2> has_huffman_{};  // class (0 means, 1 details), number
  std::array<bool, 4> has_quantization_{};
  std::int64_t restart_interval_ = 0;
  int num_scans_ = 0;
  bool is_progressive_ = false;
  bool has_exif_ = false, has_profile_ = false, has_adobe_ = false;
};

}  // namespace

ImageHeader check_jpeg(std::span<const std::byte> bytes, const std::string& name) {
  return JpegWalk(bytes, name).run();
}

}  // namespace lvggt::detail
