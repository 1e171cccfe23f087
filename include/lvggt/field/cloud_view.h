// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Geometry>
#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <numbers>
#include <vector>

#include "lvggt/field/point_cloud.h"

namespace lvggt {

// Where a cloud is looked at from: its frame's camera, moved on a circle around the point in front
// of it at the cloud's median depth.
struct CloudViewpoint {
  double azimuth = 0;    // degrees; positive: from the right
  double elevation = 0;  // degrees; positive: from above
  double distance = 1;   // of the camera to that point, beside the frame's own
};

namespace cloud_view {

// What is nearest in each pixel.
struct Canvas {
  Tensor<std::uint8_t, 3> pixels;  // [H, W, 3]
  Tensor<float, 2> depth;          // [H, W]

  Canvas(std::int64_t H, std::int64_t W, std::uint8_t background)
      : pixels(Shape{H, W, std::int64_t{3}}), depth(Shape{H, W}) {
    std::fill_n(pixels.data(), pixels.size(), background);
    std::fill_n(depth.data(), depth.size(), std::numeric_limits<float>::infinity());
  }

  // The pixels whose centres lie within `half` of (u, v), at least one.
  void splat(float u, float v, float half, float z, View<const std::uint8_t, 1> color) {
    half = std::max(half, 0.5f);
    const std::int64_t H = depth.extent(0), W = depth.extent(1);
    if (!(u + half >= 0 && v + half >= 0 && u - half <= static_cast<float>(W - 1) &&
          v - half <= static_cast<float>(H - 1)))
      return;  // also when one is not a number
    const auto first = [](float x) {
      return static_cast<std::int64_t>(std::ceil(std::max(x, 0.f)));
    };
    const auto last = [](float x, std::int64_t end) {
      return static_cast<std::int64_t>(std::floor(std::min(x, static_cast<float>(end - 1))));
    };
    for (std::int64_t y = first(v - half); y <= last(v + half, H); ++y)
      for (std::int64_t x = first(u - half); x <= last(u + half, W); ++x) {
        if (!(z < depth(y, x))) continue;
        depth(y, x) = z;
        std::copy_n(color.data(), 3, pixels[y][x].data());
      }
  }
};

}  // namespace cloud_view

// A picture of a frame's cloud. Each point is a square as large as the pixel it was, so that a
// surface seen from the front is closed and gaps show where nothing was seen.
//   camera: the one the cloud was made with, of frames `frame_width` pixels wide
//   width: of the picture; its height is as the frame's   -> [H, width, 3]
inline Tensor<std::uint8_t, 3> render_cloud(const PointCloud& cloud, const Camera& camera,
                                            const Shape<2>& frame, std::int64_t width,
                                            const CloudViewpoint& from) {
  constexpr std::uint8_t kBackground = 96;  // neither dark nor bright things vanish before it
  constexpr float kOverlap = 0.6f;  // of a pixel's side: neighbours touch when turned away
  const float scale = static_cast<float>(width) / static_cast<float>(frame[1]);
  const auto height = std::max<std::int64_t>(
      1, std::lround(static_cast<double>(frame[0] * width) / static_cast<double>(frame[1])));
  cloud_view::Canvas canvas(height, width, kBackground);
  if (cloud.size() == 0) return std::move(canvas.pixels);

  std::vector<Eigen::Vector3f> points(static_cast<std::size_t>(cloud.size()));
  std::vector<float> depths(points.size());
  for (std::size_t i = 0; i < points.size(); ++i) {
    const auto p = cloud.positions()[static_cast<std::int64_t>(i)];
    points[i] = camera.cam_from_world * Eigen::Vector4f(p[0], p[1], p[2], 1);
    depths[i] = points[i].z();
  }
  const auto middle = depths.begin() + static_cast<std::ptrdiff_t>(depths.size() / 2);
  std::nth_element(depths.begin(), middle, depths.end());
  const Eigen::Vector3f pivot(0, 0, *middle);
  const auto radians = [](double degrees) {
    return static_cast<float>(degrees * std::numbers::pi / 180);
  };
  // The scene turns against the camera's way around it.
  const Eigen::Matrix3f turn =
      (Eigen::AngleAxisf(radians(from.elevation), Eigen::Vector3f::UnitX()) *
       Eigen::AngleAxisf(radians(from.azimuth), Eigen::Vector3f::UnitY()))
          .toRotationMatrix();
  const Eigen::Vector3f ahead(0, 0, *middle * static_cast<float>(from.distance));
  for (std::size_t i = 0; i < points.size(); ++i) {
    const Eigen::Vector3f p = turn * (points[i] - pivot) + ahead;
    if (!(p.z() > 0.05f * ahead.z())) continue;  // beside or behind the camera
    const float u = (camera.fx * p.x() / p.z() + camera.cx + 0.5f) * scale - 0.5f;
    const float v = (camera.fy * p.y() / p.z() + camera.cy + 0.5f) * scale - 0.5f;
    canvas.splat(u, v, kOverlap * scale * points[i].z() / p.z(), p.z(),
                 cloud.colors()[static_cast<std::int64_t>(i)]);
  }
  return std::move(canvas.pixels);
}

// The cloud from the left and from the right, side by side: [H, 2 width + gap, 3].
inline Tensor<std::uint8_t, 3> render_cloud_from_both_sides(const PointCloud& cloud,
                                                            const Camera& camera,
                                                            const Shape<2>& frame,
                                                            std::int64_t width) {
  constexpr double kAzimuth = 30, kElevation = 8, kDistance = 1.1;
  constexpr std::int64_t kGap = 6;
  const Tensor<std::uint8_t, 3> left =
      render_cloud(cloud, camera, frame, width, {-kAzimuth, kElevation, kDistance});
  const Tensor<std::uint8_t, 3> right =
      render_cloud(cloud, camera, frame, width, {kAzimuth, kElevation, kDistance});
  Tensor<std::uint8_t, 3> both(Shape{left.extent(0), 2 * width + kGap, std::int64_t{3}});
  std::fill_n(both.data(), both.size(), std::uint8_t{255});
  for (std::int64_t y = 0; y < both.extent(0); ++y) {
    std::copy_n(left.view()[y].data(), 3 * width, both[y].data());
    std::copy_n(right.view()[y].data(), 3 * width, both[y][width + kGap].data());
  }
  return both;
}

}  // namespace lvggt
