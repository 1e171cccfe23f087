// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/ply.h"

#include <doctest/doctest.h>

#include <cstring>
#include <filesystem>

#include "lvggt/field/point_cloud.h"
#include "tests/support/files.h"
#include "tests/support/temp_dir.h"

using namespace lvggt;

namespace {

float float_at(const std::string& bytes, std::size_t offset) {
  float value;
  std::memcpy(&value, bytes.data() + offset, sizeof value);
  return value;
}

struct Points {
  explicit Points(std::int64_t N)
      : positions(Shape{N, std::int64_t{3}}),
        colors(Shape{N, std::int64_t{3}}),
        confidence(Shape{N}),
        semantics(Shape{N, std::int64_t{2}, std::int64_t{3}}) {
    for (std::int64_t i = 0; i < 3 * N; ++i) {
      positions.data()[i] = 0.1f * static_cast<float>(i);
      colors.data()[i] = static_cast<std::uint8_t>(i);
    }
    for (std::int64_t i = 0; i < N; ++i) confidence.data()[i] = 1 + static_cast<float>(i);
    for (std::int64_t i = 0; i < 6 * N; ++i) semantics.data()[i] = -static_cast<float>(i);
  }
  PlyPoints view() const {
    return {positions, colors, confidence, semantics, {"small", "large"}, 1.5};
  }

  Tensor<float, 2> positions;
  Tensor<std::uint8_t, 2> colors;
  Tensor<float, 1> confidence;
  Tensor<float, 3> semantics;
};

}  // namespace

TEST_CASE("E02: a PLY holds as many records as its header counts, every value in its place") {
  const test::TempDir folder;
  const std::int64_t N = 5;
  const Points points(N);
  write_ply(folder / "x.ply", points.view());
  const std::string bytes = test::read_bytes(folder / "x.ply");
  const std::size_t body = bytes.find("end_header\n") + 11;
  const std::string header = bytes.substr(0, body);
  CHECK(header.starts_with("ply\nformat binary_little_endian 1.0\n"));
  CHECK(header.find(
            "element vertex 5\nproperty float x\nproperty float y\nproperty float z\n"
            "property uchar red\nproperty uchar green\nproperty uchar blue\n"
            "property float conf\nproperty float t\n"
            "property float sem_small_0\nproperty float sem_small_1\nproperty float sem_small_2\n"
            "property float sem_large_0\nproperty float sem_large_1\nproperty float sem_large_2\n"
            "end_header\n") != std::string::npos);
  const std::size_t record = 5 * 4 + 3 + 6 * 4;
  REQUIRE(bytes.size() == body + static_cast<std::size_t>(N) * record);
  for (std::size_t i = 0; i < 5; ++i) {
    const std::size_t at = body + i * record;
    CHECK(float_at(bytes, at + 8) == points.positions.data()[3 * i + 2]);
    CHECK(static_cast<std::uint8_t>(bytes[at + 13]) == points.colors.data()[3 * i + 1]);
    CHECK(float_at(bytes, at + 15) == points.confidence.data()[i]);
    CHECK(float_at(bytes, at + 19) == 1.5f);
    CHECK(float_at(bytes, at + 23 + 4 * 5) == points.semantics.data()[6 * i + 5]);
  }
}

TEST_CASE("E02: a PLY of no points is a header that says so") {
  const test::TempDir folder;
  write_ply(folder / "x.ply", Points(0).view());
  const std::string bytes = test::read_bytes(folder / "x.ply");
  CHECK(bytes.find("element vertex 0\n") != std::string::npos);
  CHECK(bytes.ends_with("end_header\n"));
}

TEST_CASE("write_ply: shapes that do not fit are refused and leave nothing behind") {
  const test::TempDir folder;
  const Points points(2), fewer(1);
  PlyPoints wrong = points.view();
  wrong.confidence = fewer.confidence;
  CHECK_THROWS_WITH_AS(write_ply(folder / "x.ply", wrong), doctest::Contains("[1]"), Error);
  wrong = points.view();
  wrong.level_names.pop_back();
  CHECK_THROWS_WITH_AS(write_ply(folder / "x.ply", wrong), doctest::Contains("1 levels"), Error);
  CHECK(std::filesystem::is_empty(folder.path()));
}

TEST_CASE("PointCloud: keeps what passes the filter, with its colour, pixel and semantics") {
  Context ctx(1);
  const std::int64_t H = 4, W = 5, levels = 2, d = 3;
  Tensor<float, 2> depth(Shape{H, W}), confidence(Shape{H, W});
  Tensor<float, 3> colors(Shape{H, W, std::int64_t{3}});
  Tensor<float, 4> language(Shape{levels, H, W, d});
  for (std::int64_t i = 0; i < H * W; ++i) {
    depth.data()[i] = 2;
    confidence.data()[i] = i == 7 ? 0.5f : 3;
    colors.data()[3 * i + 1] = static_cast<float>(i) / 255;
  }
  for (std::int64_t i = 0; i < language.size(); ++i) language.data()[i] = static_cast<float>(i);
  const Camera camera{Eigen::Matrix<float, 3, 4>::Identity(), 4, 4, 2.5f, 2};
  PointCloud cloud(H, W, levels, d);
  cloud.build({depth, confidence, colors, language, camera}, 3, ctx);
  REQUIRE(cloud.size() == 19);  // pixel 7 falls below the third percentile
  CHECK(cloud.pixels()(7, 0) == 3);
  CHECK(cloud.pixels()(7, 1) == 1);
  CHECK(cloud.colors()(7, 1) == 8);
  CHECK(cloud.positions()(7, 0) == doctest::Approx((3 - 2.5) * 2 / 4));
  CHECK(cloud.positions()(7, 1) == doctest::Approx((1 - 2.0) * 2 / 4));
  CHECK(cloud.positions()(7, 2) == 2);
  CHECK(cloud.semantics()(7, 1, 2) == language(1, 1, 3, 2));

  cloud.build({depth, confidence, colors, {}, camera}, 0, ctx);
  CHECK(cloud.size() == 20);
  CHECK(cloud.semantics().empty());
}
