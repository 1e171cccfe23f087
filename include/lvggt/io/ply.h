// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cstdint>
#include <cstring>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/json_writer.h"

namespace lvggt {

// Points with what each of them carries; borrowed.
struct PlyPoints {
  View<const float, 2> positions;        // [N, 3], in the world
  View<const std::uint8_t, 2> colors;    // [N, 3], red green blue
  View<const float, 1> confidence;       // [N]
  View<const float, 3> semantics;        // [N, level, d]; may be empty
  std::vector<std::string> level_names;  // one for each level
  double timestamp = 0;                  // seconds, the same for all points
  // Each level is one number with a name of its own, not a semantic vector (d is 1).
  bool plain_names = false;
};

namespace ply_detail {

// One record of the file: a copy of the bytes, low byte first.
class Record {
 public:
  explicit Record(std::size_t size) { bytes_.reserve(size); }
  void clear() { bytes_.clear(); }
  void add(std::uint8_t value) { bytes_.push_back(static_cast<char>(value)); }
  void add(float value) {
    const auto bits = std::bit_cast<std::uint32_t>(value);
    for (int shift = 0; shift < 32; shift += 8) bytes_.push_back(static_cast<char>(bits >> shift));
  }
  const std::vector<char>& bytes() const { return bytes_; }

 private:
  std::vector<char> bytes_;
};

inline std::string header(const PlyPoints& points, std::int64_t N) {
  std::string text =
      "ply\nformat binary_little_endian 1.0\n"
      "comment lvggt point cloud, format 1: OpenCV axes (x right, y down, z forward), relative "
      "scale\n"
      "comment timestamp_seconds ";
  append_number(text, points.timestamp);
  text += "\nelement vertex ";
  append_number(text, N);
  text +=
      "\nproperty float x\nproperty float y\nproperty float z\n"
      "property uchar red\nproperty uchar green\nproperty uchar blue\n"
      "property float conf\nproperty float t\n";
  if (points.semantics) {
    for (std::int64_t level = 0; level < points.semantics.extent(1); ++level) {
      for (std::int64_t k = 0; k < points.semantics.extent(2); ++k) {
        const std::string& name = points.level_names[static_cast<std::size_t>(level)];
        text += "property float " + (points.plain_names ? name : "sem_" + name + "_");
        if (!points.plain_names) append_number(text, k);
        text += '\n';
      }
    }
  }
  return text + "end_header\n";
}

}  // namespace ply_detail

// Writes a binary little-endian PLY: x y z (float), red green blue (uchar), conf and t (float),
// then sem_<level>_<k> (float), or <level> where names are plain. t is the timestamp in seconds; it
// is in a comment too, with all its digits. Errors: kMismatch for shapes that do not fit, kWrite.
inline void write_ply(const std::string& path, const PlyPoints& points) {
  const std::int64_t N = points.positions.extent(0);
  const bool has_semantics = static_cast<bool>(points.semantics);
  LVGGT_CHECK(
      (points.positions.shape() == Shape{N, std::int64_t{3}} &&
       points.colors.shape() == points.positions.shape() && points.confidence.extent(0) == N),
      path, ": positions are ", points.positions.shape(), ", colours ", points.colors.shape(),
      " and confidences ", points.confidence.shape());
  LVGGT_CHECK(!has_semantics || (points.semantics.extent(0) == N &&
                                 points.semantics.extent(1) ==
                                     static_cast<std::int64_t>(points.level_names.size())),
              path, ": there are ", N, " points and ", points.level_names.size(),
              " levels, but semantics are ", points.semantics.shape());
  LVGGT_CHECK(!points.plain_names || !has_semantics || points.semantics.extent(2) == 1, path,
              ": numbers with plain names are ", points.semantics.shape());

  AtomicFile file(path);
  file.write(ply_detail::header(points, N));
  const std::int64_t levels = has_semantics ? points.semantics.extent(1) : 0;
  const std::int64_t d = has_semantics ? points.semantics.extent(2) : 0;
  ply_detail::Record record(static_cast<std::size_t>(5 * 4 + 3 + levels * d * 4));
  for (std::int64_t i = 0; i < N; ++i) {
    record.clear();
    for (int axis = 0; axis < 3; ++axis) record.add(points.positions[i][axis]);
    for (int channel = 0; channel < 3; ++channel) record.add(points.colors[i][channel]);
    record.add(points.confidence[i]);
    record.add(static_cast<float>(points.timestamp));
    for (std::int64_t level = 0; level < levels; ++level)
      for (std::int64_t k = 0; k < d; ++k) record.add(points.semantics[i][level][k]);
    file.write(record.bytes().data(), record.bytes().size());
  }
  file.commit();
}

}  // namespace lvggt
