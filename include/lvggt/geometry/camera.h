// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <Eigen/Geometry>
#include <algorithm>
#include <array>
#include <cmath>
#include <cstdint>
#include <numbers>

#include "lvggt/core/tensor.h"

namespace lvggt {

// A pinhole camera with OpenCV axes (+X right, +Y down, +Z forward); the first frame's camera of a
// stream is close to the world's origin. Scale is relative: the model's unit is not a metre.
//
// fx, fy, cx, cy are in pixel index coordinates, where the centre of the first pixel is (0, 0):
// pixel (u, v) with depth z is the camera point ((u - cx) z / fx, (v - cy) z / fy, z).
struct Camera {
  Eigen::Matrix<float, 3, 4> cam_from_world = Eigen::Matrix<float, 3, 4>::Identity();
  float fx = 1, fy = 1, cx = 0, cy = 0;
};

// Entries of a pose encoding: translation, scalar-last quaternion, vertical and horizontal field of
// view.
inline constexpr std::int64_t kPoseEncodingSize = 9;

// The rotation of a scalar-last quaternion (x, y, z, w) of any length but zero: with s = 2 / |q|^2,
//   R = I + s * (w [v]x + [v]x^2).
// Errors: kNumeric for a zero or non-finite quaternion.
inline Eigen::Matrix3d rotation_from_quaternion(const Eigen::Vector4d& q) {
  const double norm2 = q.squaredNorm();
  if (!(norm2 > 0) || !std::isfinite(2 / norm2) || !std::isfinite(norm2))
    fail(ErrorKind::kNumeric, "camera: the quaternion (", q[0], ", ", q[1], ", ", q[2], ", ", q[3],
         ") has no direction, so it is no rotation");
  const double s = 2 / norm2, x = q[0], y = q[1], z = q[2], w = q[3];
  Eigen::Matrix3d R;
  R << 1 - s * (y * y + z * z), s * (x * y - z * w), s * (x * z + y * w),  //
      s * (x * y + z * w), 1 - s * (x * x + z * z), s * (y * z - x * w),   //
      s * (x * z - y * w), s * (y * z + x * w), 1 - s * (x * x + y * y);
  return R;
}

// The unit quaternion (x, y, z, w) of a rotation, with w >= 0. Of the four ways to divide, the one
// by the largest component is taken; Eigen::Quaternion would do, but leaves the sign open.
inline Eigen::Vector4d quaternion_from_rotation(const Eigen::Matrix3d& R) {
  const double xx = R(0, 0), yy = R(1, 1), zz = R(2, 2);
  // Four times the squared components w, x, y, z.
  const std::array<double, 4> squares{1 + xx + yy + zz, 1 + xx - yy - zz, 1 - xx + yy - zz,
                                      1 - xx - yy + zz};
  Eigen::Vector4d q;
  switch (std::max_element(squares.begin(), squares.end()) - squares.begin()) {
    case 0:
      q << R(2, 1) - R(1, 2), R(0, 2) - R(2, 0), R(1, 0) - R(0, 1), squares[0];
      break;
    case 1:
      q << squares[1], R(1, 0) + R(0, 1), R(0, 2) + R(2, 0), R(2, 1) - R(1, 2);
      break;
    case 2:
      q << R(1, 0) + R(0, 1), squares[2], R(1, 2) + R(2, 1), R(0, 2) - R(2, 0);
      break;
    default:
      q << R(0, 2) + R(2, 0), R(1, 2) + R(2, 1), squares[3], R(1, 0) - R(0, 1);
      break;
  }
  q.normalize();
  return q[3] < 0 ? Eigen::Vector4d(-q) : q;
}

// The camera of a pose encoding [tx ty tz | qx qy qz qw | fov_h fov_w] for a frame of H x W pixels:
//   fy = (H / 2) / tan(fov_h / 2), fx = (W / 2) / tan(fov_w / 2), principal point (W / 2, H / 2).
// Errors: kNumeric when a value is not finite, the quaternion is zero, or a field of view is not
// between 0 and pi, for which there is no focal length.
inline Camera decode_pose_encoding(View<const float, 1> encoding, std::int64_t H, std::int64_t W) {
  LVGGT_CHECK(encoding.extent(0) == kPoseEncodingSize, "camera: a pose encoding has ",
              kPoseEncodingSize, " values, not ", encoding.extent(0));
  for (std::int64_t i = 0; i < kPoseEncodingSize; ++i)
    if (!std::isfinite(encoding[i]))
      fail(ErrorKind::kNumeric, "camera: value ", i, " of the pose encoding is ", encoding[i]);
  const double fov_h = encoding[7], fov_w = encoding[8];
  if (!(fov_h > 0 && fov_h < std::numbers::pi && fov_w > 0 && fov_w < std::numbers::pi))
    fail(ErrorKind::kNumeric, "camera: the fields of view are ", fov_h, " (vertical) and ", fov_w,
         " (horizontal), but only angles between 0 and pi have a focal length");

  Camera camera;
  const Eigen::Vector4d q(encoding[3], encoding[4], encoding[5], encoding[6]);
  camera.cam_from_world.leftCols<3>() = rotation_from_quaternion(q).cast<float>();
  camera.cam_from_world.col(3) << encoding[0], encoding[1], encoding[2];
  camera.fx = static_cast<float>(0.5 * static_cast<double>(W) / std::tan(fov_w / 2));
  camera.fy = static_cast<float>(0.5 * static_cast<double>(H) / std::tan(fov_h / 2));
  camera.cx = 0.5f * static_cast<float>(W);
  camera.cy = 0.5f * static_cast<float>(H);
  if (!std::isfinite(camera.fx) || !std::isfinite(camera.fy))
    fail(ErrorKind::kNumeric, "camera: the fields of view ", fov_h, " and ", fov_w,
         " are so small that the focal length overflows");
  return camera;
}

// The inverse of decode_pose_encoding, with a unit quaternion; the principal point is not encoded.
inline std::array<float, kPoseEncodingSize> encode_pose(const Camera& camera, std::int64_t H,
                                                        std::int64_t W) {
  const Eigen::Vector4d q =
      quaternion_from_rotation(camera.cam_from_world.leftCols<3>().cast<double>());
  const auto& t = camera.cam_from_world.col(3);
  const auto fov = [](std::int64_t extent, float focal) {
    return static_cast<float>(2 * std::atan(0.5 * static_cast<double>(extent) / focal));
  };
  return {t[0],
          t[1],
          t[2],
          static_cast<float>(q[0]),
          static_cast<float>(q[1]),
          static_cast<float>(q[2]),
          static_cast<float>(q[3]),
          fov(H, camera.fy),
          fov(W, camera.fx)};
}

// Where a world point appears, in pixel index coordinates, and its depth: (u, v, z). u and v mean
// something only for z > 0.
inline Eigen::Vector3d project(const Camera& camera, const Eigen::Vector3d& point_in_world) {
  const Eigen::Vector3d p = camera.cam_from_world.cast<double>() * point_in_world.homogeneous();
  return {camera.fx * p[0] / p[2] + camera.cx, camera.fy * p[1] / p[2] + camera.cy, p[2]};
}

}  // namespace lvggt
