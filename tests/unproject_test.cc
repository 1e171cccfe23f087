// SPDX-License-Identifier: Apache-2.0
#include "lvggt/geometry/unproject.h"

#include <doctest/doctest.h>

#include <vector>

#include "lvggt/geometry/confidence.h"

using namespace lvggt;

TEST_CASE("unproject: projecting the points gives back their pixels and depths") {
  Context ctx(2);
  const std::array<float, 9> encoding{0.3f, -0.2f, 0.9f, 0.1f, -0.4f, 0.2f, 0.8f, 0.9f, 1.2f};
  const std::int64_t H = 14, W = 28;
  const Camera camera = decode_pose_encoding({encoding.data(), Shape{std::int64_t{9}}}, H, W);
  Tensor<float, 2> depth(Shape{H, W});
  for (std::int64_t i = 0; i < depth.size(); ++i)
    depth.data()[i] = 1 + 0.01f * static_cast<float>(i);
  Tensor<float, 3> points(Shape{H, W, std::int64_t{3}});
  unproject(points, depth, camera, ctx);
  double worst = 0;
  for (std::int64_t v = 0; v < H; ++v) {
    for (std::int64_t u = 0; u < W; ++u) {
      const auto point = Eigen::Map<const Eigen::Vector3f>(points[v][u].data()).cast<double>();
      const Eigen::Vector3d expected(static_cast<double>(u), static_cast<double>(v), depth(v, u));
      worst = std::max(worst, (project(camera, point) - expected).cwiseAbs().maxCoeff());
    }
  }
  CHECK(worst < 1e-4);  // float32 points a few units from the origin, focal length about 30
}

TEST_CASE("unproject: shapes that do not fit are refused by name") {
  Context ctx(1);
  Tensor<float, 2> depth(Shape{4, 5});
  Tensor<float, 3> points(Shape{5, 4, 3});
  CHECK_THROWS_WITH_AS(unproject(points, depth, Camera{}, ctx), doctest::Contains("[5,4,3]"),
                       Error);
}

TEST_CASE("percentile_in_place: linear between ranks, as numpy.percentile") {
  const auto percentile = [](std::vector<float> values, double p) {
    return percentile_in_place(values, p);
  };
  CHECK(percentile({4, 1, 3, 2}, 0) == 1);
  CHECK(percentile({4, 1, 3, 2}, 100) == 4);
  CHECK(percentile({4, 1, 3, 2}, 50) == 2.5f);
  CHECK(percentile({10, 0, 20, 30, 40}, 3) == doctest::Approx(1.2));
  CHECK(percentile({7}, 3) == 7);
  CHECK_THROWS_WITH_AS(percentile({1, 2}, 101), doctest::Contains("101"), Error);
  CHECK_THROWS_WITH_AS(percentile({1, NAN}, 3), doctest::Contains("NaN"), Error);
  CHECK_THROWS_WITH_AS(percentile({}, 3), doctest::Contains("no values"), Error);
}

TEST_CASE("confidence_filter: keeps what reaches the percentile and the least confidence") {
  Context ctx(1);
  Tensor<float, 2> confidence(Shape{10, 10});
  for (std::int64_t i = 0; i < 100; ++i) confidence.data()[i] = static_cast<float>(i) / 10 + 1;
  Tensor<std::uint8_t, 2> keep(Shape{10, 10});
  CHECK(confidence_filter(keep, confidence, 3, ctx) ==
        97);  // rank 2.97: indices 0, 1, 2 fall below
  CHECK(keep(0, 2) == 0);
  CHECK(keep(0, 3) == 1);

  for (std::int64_t i = 0; i < 100; ++i) confidence.data()[i] = 1;
  CHECK(confidence_filter(keep, confidence, 3, ctx) == 100);  // equal to the percentile is kept
  for (std::int64_t i = 0; i < 100; ++i) confidence.data()[i] = 1e-5f;
  CHECK(confidence_filter(keep, confidence, 3, ctx) == 0);
}
