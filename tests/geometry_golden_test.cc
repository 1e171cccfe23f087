// SPDX-License-Identifier: Apache-2.0
// Cameras and unprojection against the authors' implementation.
#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>

#include "lvggt/geometry/camera.h"
#include "lvggt/geometry/unproject.h"
#include "lvggt/io/safetensors.h"
#include "tests/support/paths.h"

using namespace lvggt;

namespace {

Safetensors golden() {
  return Safetensors::open(lvggt::test::test_data("golden/ops_tiny_seed1.safetensors"));
}

// Rounding of the reference itself, which computes in float: a few units in the last place of
// values up to 2.
constexpr double kTolerance = 2e-6;

}  // namespace

TEST_CASE("decode_pose_encoding: agrees with the reference on hard rotations") {
  const Safetensors file = golden();
  const auto encodings = file.read<2>("camera.pose_enc");
  const auto extrinsics = file.read<3>("camera.extrinsics");
  const auto intrinsics = file.read<3>("camera.intrinsics");
  const auto size = file.read_int64("camera.image_size_hw");
  for (std::int64_t i = 0; i < encodings.extent(0); ++i) {
    const Camera camera = decode_pose_encoding(encodings[i], size[0], size[1]);
    for (int row = 0; row < 3; ++row)
      for (int column = 0; column < 4; ++column)
        CHECK(std::abs(camera.cam_from_world(row, column) - extrinsics(i, row, column)) <=
              kTolerance);
    CHECK(camera.fx == doctest::Approx(intrinsics(i, 0, 0)).epsilon(kTolerance));
    CHECK(camera.fy == doctest::Approx(intrinsics(i, 1, 1)).epsilon(kTolerance));
    CHECK(camera.cx == intrinsics(i, 0, 2));
    CHECK(camera.cy == intrinsics(i, 1, 2));
  }
}

TEST_CASE("encode_pose: agrees with the reference, the sign of the quaternion included") {
  const Safetensors file = golden();
  const auto encodings = file.read<2>("camera.pose_enc");
  const auto quaternions = file.read<2>("camera.quat_from_matrix");
  const auto round_trips = file.read<2>("camera.pose_enc_roundtrip");
  const auto size = file.read_int64("camera.image_size_hw");
  for (std::int64_t i = 0; i < encodings.extent(0); ++i) {
    const auto again =
        encode_pose(decode_pose_encoding(encodings[i], size[0], size[1]), size[0], size[1]);
    for (std::int64_t k = 0; k < 9; ++k)
      CHECK(std::abs(again[static_cast<std::size_t>(k)] - round_trips(i, k)) <= kTolerance);
    for (std::int64_t k = 0; k < 4; ++k)
      CHECK(std::abs(again[static_cast<std::size_t>(3 + k)] - quaternions(i, k)) <= kTolerance);
  }
}

TEST_CASE("unproject: agrees with the reference, on one thread and on several") {
  const Safetensors file = golden();
  const auto depth = file.read<3>("unproject.depth");
  const auto expected = file.read<4>("unproject.y");
  const auto extrinsics = file.read<3>("camera.extrinsics");
  const auto intrinsics = file.read<3>("camera.intrinsics");
  for (const int threads : {1, 3}) {
    Context ctx(threads);
    Tensor<float, 3> points(Shape{depth.extent(1), depth.extent(2), std::int64_t{3}});
    for (std::int64_t i = 0; i < depth.extent(0); ++i) {
      Camera camera{Eigen::Matrix<float, 3, 4>::Zero(), intrinsics(i, 0, 0), intrinsics(i, 1, 1),
                    intrinsics(i, 0, 2), intrinsics(i, 1, 2)};
      for (int row = 0; row < 3; ++row)
        for (int column = 0; column < 4; ++column)
          camera.cam_from_world(row, column) = extrinsics(i, row, column);
      unproject(points, depth[i], camera, ctx);
      for (std::int64_t k = 0; k < points.size(); ++k) {
        const float want = expected[i].data()[k];
        CHECK(std::abs(points.data()[k] - want) <= kTolerance * std::max(1.0f, std::abs(want)));
      }
    }
  }
}
