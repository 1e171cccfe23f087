// SPDX-License-Identifier: Apache-2.0
#include "lvggt/geometry/camera.h"

#include <doctest/doctest.h>

#include <limits>

using namespace lvggt;

namespace {

Camera decode(std::array<float, 9> encoding, std::int64_t H = 56, std::int64_t W = 84) {
  return decode_pose_encoding(View<const float, 1>(encoding.data(), Shape{std::int64_t{9}}), H, W);
}

}  // namespace

TEST_CASE("decode_pose_encoding: the quaternion is scalar-last and need not have unit length") {
  // A quarter turn about z, three times too long: x goes to y.
  const float s = 3 * std::sqrt(0.5f);
  const Camera camera = decode({1, 2, 3, 0, 0, s, s, 1, 1});
  const Eigen::Vector3f turned = camera.cam_from_world.leftCols<3>() * Eigen::Vector3f(1, 0, 0);
  CHECK((turned - Eigen::Vector3f(0, 1, 0)).norm() < 1e-6);
  CHECK(camera.cam_from_world.col(3) == Eigen::Vector3f(1, 2, 3));
}

TEST_CASE(
    "decode_pose_encoding: a field of view of 90 degrees has a focal length of half the side") {
  const float right_angle = std::numbers::pi_v<float> / 2;
  const Camera camera = decode({0, 0, 0, 0, 0, 0, 1, right_angle, right_angle}, 56, 84);
  CHECK(camera.fy == doctest::Approx(28));
  CHECK(camera.fx == doctest::Approx(42));
  CHECK(camera.cx == 42);
  CHECK(camera.cy == 28);
}

TEST_CASE("D32: a quaternion of zero norm and a field of view of 0 or pi are refused by name") {
  const float nan = std::numeric_limits<float>::quiet_NaN();
  CHECK_THROWS_WITH_AS(decode({0, 0, 0, 0, 0, 0, 0, 1, 1}), doctest::Contains("quaternion"), Error);
  CHECK_THROWS_WITH_AS(decode({0, 0, 0, 0, 0, 0, 1, 0, 1}),
                       doctest::Contains("fields of view are 0"), Error);
  CHECK_THROWS_WITH_AS(decode({0, 0, 0, 0, 0, 0, 1, 1, 3.15f}), doctest::Contains("fields of view"),
                       Error);
  CHECK_THROWS_WITH_AS(decode({0, 0, 0, 0, 0, 0, 1, 1e-40f, 1}), doctest::Contains("overflow"),
                       Error);
  CHECK_THROWS_WITH_AS(decode({0, nan, 0, 0, 0, 0, 1, 1, 1}), doctest::Contains("value 1"), Error);
  try {
    decode({0, 0, 0, 0, 0, 0, 1, 0, 1});
  } catch (const Error& error) {
    CHECK(error.kind() == ErrorKind::kNumeric);
  }
}

TEST_CASE("encode_pose: gives back what was decoded, with a unit quaternion of positive scalar") {
  const std::array<float, 9> encoding{0.5f, -1, 2, -0.48f, 0.36f, -0.48f, -0.64f, 0.8f, 1.1f};
  const auto again = encode_pose(decode(encoding), 56, 84);
  for (std::size_t i = 0; i < 9; ++i)
    CHECK(again[i] == doctest::Approx(i >= 3 && i < 7 ? -encoding[i] : encoding[i]).epsilon(1e-5));
}

TEST_CASE("quaternion_from_rotation: half turns about each axis, where the scalar is zero") {
  for (int axis = 0; axis < 3; ++axis) {
    Eigen::Matrix3d R = -Eigen::Matrix3d::Identity();
    R(axis, axis) = 1;
    Eigen::Vector4d expected = Eigen::Vector4d::Zero();
    expected[axis] = 1;
    CHECK((quaternion_from_rotation(R) - expected).norm() < 1e-12);
    CHECK((rotation_from_quaternion(expected) - R).norm() < 1e-12);
  }
}
