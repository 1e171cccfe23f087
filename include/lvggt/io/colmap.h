// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <span>
#include <string>
#include <string_view>

#include "lvggt/core/tensor.h"
#include "lvggt/geometry/camera.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/json_writer.h"

namespace lvggt {

// A point as one image sees it.
struct ColmapPoint {
  std::array<float, 3> position;      // in the world
  std::array<std::uint8_t, 3> color;  // red green blue
  double u = 0, v = 0;                // in that image, pixel index coordinates (first centre at 0)
};

// A file name safe to put into a text model: no folders, no control characters, not empty.
inline std::string colmap_image_name(std::string_view name) {
  std::string safe;
  for (const char c : name.substr(name.find_last_of('/') + 1))
    safe += static_cast<unsigned char>(c) < 0x20 || c == 0x7f || c == '\\' ? '_' : c;
  return safe.empty() || safe == "." || safe == ".." ? "_" : safe;
}

// Streams a COLMAP text model (cameras.txt, images.txt, points3D.txt) into a folder; memory does
// not grow with the number of images, and the files appear only at finish().
//
// Conventions of COLMAP: rotation as qw qx qy qz and translation are world-to-camera, axes as in
// OpenCV, and the centre of the first pixel is (0.5, 0.5). Camera counts it as (0, 0), so 0.5 is
// added to the principal point and to every observation. Each image has a PINHOLE camera of its
// own, as each frame's focal length is estimated anew. There is no matching: every point is seen by
// the one image it comes from.
class ColmapWriter {
 public:
  // `folder` exists. Errors: kWrite.
  explicit ColmapWriter(const std::string& folder)
      : cameras_(folder + "/cameras.txt"),
        images_(folder + "/images.txt"),
        points_(folder + "/points3D.txt") {
    cameras_.write(
        "# Camera list with one line of data per camera:\n"
        "#   CAMERA_ID, MODEL, WIDTH, HEIGHT, PARAMS[] (PINHOLE: fx, fy, cx, cy)\n"
        "# The centre of the first pixel is (0.5, 0.5).\n");
    images_.write(
        "# Image list with two lines of data per image:\n"
        "#   IMAGE_ID, QW, QX, QY, QZ, TX, TY, TZ, CAMERA_ID, NAME (world to camera)\n"
        "#   POINTS2D[] as (X, Y, POINT3D_ID)\n"
        "# The scale of the scene is relative.\n");
    points_.write(
        "# 3D point list with one line of data per point:\n"
        "#   POINT3D_ID, X, Y, Z, R, G, B, ERROR, TRACK[] as (IMAGE_ID, POINT2D_IDX)\n"
        "# Points come from dense depth, not from matching: every track has one image.\n");
  }

  // Adds an image of width x height pixels with its camera and the points that come from it.
  void add_image(std::string_view name, const Camera& camera, std::int64_t width,
                 std::int64_t height, std::span<const ColmapPoint> points) {
    ++num_images_;
    write_camera(camera, width, height);
    write_image(name, camera, points);
    for (std::size_t i = 0; i < points.size(); ++i) write_point(camera, points[i], i);
    num_points_ += static_cast<std::int64_t>(points.size());
  }

  std::int64_t num_images() const { return num_images_; }
  std::int64_t num_points() const { return num_points_; }

  void finish() {
    cameras_.commit();
    images_.commit();
    points_.commit();
  }

 private:
  static constexpr double kPixelCentre = 0.5;

  void write_camera(const Camera& camera, std::int64_t width, std::int64_t height) {
    std::string line;
    append_number(line, num_images_);
    line += " PINHOLE ";
    append_number(line, width);
    line += ' ';
    append_number(line, height);
    for (const double x : {double{camera.fx}, double{camera.fy}, camera.cx + kPixelCentre,
                           camera.cy + kPixelCentre}) {
      line += ' ';
      append_number(line, x);
    }
    cameras_.write(line + '\n');
  }

  void write_image(std::string_view name, const Camera& camera,
                   std::span<const ColmapPoint> points) {
    const Eigen::Vector4d q =
        quaternion_from_rotation(camera.cam_from_world.leftCols<3>().cast<double>());
    const auto& t = camera.cam_from_world.col(3);
    std::string text;
    append_number(text, num_images_);
    for (const double x : {q[3], q[0], q[1], q[2]}) {
      text += ' ';
      append_number(text, x);
    }
    for (const float x : {t[0], t[1], t[2]}) {
      text += ' ';
      append_number(text, x);
    }
    text += ' ';
    append_number(text, num_images_);
    text += ' ' + colmap_image_name(name) + '\n';
    const char* blank = "";
    for (std::size_t i = 0; i < points.size(); ++i) {
      text += blank;
      append_number(text, points[i].u + kPixelCentre);
      text += ' ';
      append_number(text, points[i].v + kPixelCentre);
      text += ' ';
      append_number(text, num_points_ + 1 + static_cast<std::int64_t>(i));
      blank = " ";
    }
    images_.write(text + '\n');
  }

  void write_point(const Camera& camera, const ColmapPoint& point, std::size_t i) {
    const Eigen::Vector3d seen =
        project(camera, Eigen::Vector3d(point.position[0], point.position[1], point.position[2]));
    std::string line;
    append_number(line, num_points_ + 1 + static_cast<std::int64_t>(i));
    for (const float x : point.position) {
      line += ' ';
      append_number(line, x);
    }
    for (const std::uint8_t c : point.color) {
      line += ' ';
      append_number(line, static_cast<int>(c));
    }
    line += ' ';
    append_number(line, static_cast<float>(std::hypot(seen[0] - point.u, seen[1] - point.v)));
    line += ' ';
    append_number(line, num_images_);
    line += ' ';
    append_number(line, i);
    points_.write(line + '\n');
  }

  AtomicFile cameras_, images_, points_;
  std::int64_t num_images_ = 0;
  std::int64_t num_points_ = 0;
};

}  // namespace lvggt
