// SPDX-License-Identifier: Apache-2.0
#include "lvggt/field/cloud_view.h"

#include <doctest/doctest.h>

using namespace lvggt;

namespace {

constexpr std::int64_t kHeight = 21, kWidth = 31;

// A white wall at depth 4 behind a red square at depth 2 in the middle of the frame.
struct Scene {
  Tensor<float, 2> depth{Shape{kHeight, kWidth}}, confidence{Shape{kHeight, kWidth}};
  Tensor<float, 3> colors{Shape{kHeight, kWidth, std::int64_t{3}}};
  Camera camera;
  PointCloud cloud{kHeight, kWidth, 0, 0};
  Context ctx{1};

  Scene() {
    camera.fx = camera.fy = 30;
    camera.cx = (kWidth - 1) / 2.f;
    camera.cy = (kHeight - 1) / 2.f;
    camera.cam_from_world(0, 3) = 0.3f;  // the world is not the camera
    for (std::int64_t y = 0; y < kHeight; ++y)
      for (std::int64_t x = 0; x < kWidth; ++x) {
        const bool near = std::abs(y - 10) <= 3 && std::abs(x - 15) <= 3;
        depth(y, x) = near ? 2.f : 4.f;
        confidence(y, x) = 2;
        for (std::int64_t c = 0; c < 3; ++c) colors(y, x, c) = near && c > 0 ? 0.f : 1.f;
      }
    cloud.build({depth, confidence, colors, {}, camera}, 0, ctx);
  }

  Tensor<std::uint8_t, 3> seen(const CloudViewpoint& from, std::int64_t width = kWidth) const {
    return render_cloud(cloud, camera, depth.shape(), width, from);
  }
};

bool red(View<const std::uint8_t, 1> pixel) { return pixel[0] == 255 && pixel[1] == 0; }
bool white(View<const std::uint8_t, 1> pixel) { return pixel[0] == 255 && pixel[1] == 255; }

// Mean column of the red pixels.
double middle_of_red(const Tensor<std::uint8_t, 3>& picture) {
  double sum = 0, count = 0;
  for (std::int64_t y = 0; y < picture.extent(0); ++y)
    for (std::int64_t x = 0; x < picture.extent(1); ++x)
      if (red(picture.view()[y][x])) {
        sum += static_cast<double>(x);
        ++count;
      }
  REQUIRE(count > 0);
  return sum / count;
}

}  // namespace

TEST_CASE("cloud view: from its own camera a cloud is the picture it was made from") {
  const Scene scene;
  for (const std::int64_t width : {kWidth, 4 * kWidth}) {
    const Tensor<std::uint8_t, 3> picture = scene.seen({}, width);
    const std::int64_t k = width / kWidth;
    CHECK(picture.shape() == Shape{kHeight * k, width, std::int64_t{3}});
    for (std::int64_t y = 0; y < kHeight; ++y)
      for (std::int64_t x = 0; x < kWidth; ++x) {
        // Squares overlap their neighbours by a tenth of a pixel; their middles are their own.
        const auto pixel = picture.view()[y * k + k / 2][x * k + k / 2];
        const bool near = std::abs(y - 10) <= 3 && std::abs(x - 15) <= 3;
        CHECK((near ? red(pixel) : white(pixel)));
      }
  }
}

TEST_CASE("cloud view: from the right, what is near moves to the left before what is far") {
  const Scene scene;  // its median depth is the wall's
  CHECK(middle_of_red(scene.seen({})) == doctest::Approx(15));
  CHECK(middle_of_red(scene.seen({20, 0, 1})) < 10);
  CHECK(middle_of_red(scene.seen({-20, 0, 1})) > 20);
}

TEST_CASE("cloud view: from above, what is near moves down") {
  const Scene scene;
  const Tensor<std::uint8_t, 3> picture = scene.seen({0, 15, 1});
  std::int64_t lowest = 0;
  for (std::int64_t y = 0; y < kHeight; ++y)
    for (std::int64_t x = 0; x < kWidth; ++x)
      if (red(picture.view()[y][x])) lowest = y;
  CHECK(lowest > 15);  // 13 from the front
}

TEST_CASE("cloud view: beside the near square the background shows where nothing was seen") {
  const Tensor<std::uint8_t, 3> picture = Scene().seen({20, 0, 1});
  std::int64_t empty = 0;
  for (std::int64_t x = 0; x < kWidth; ++x) {
    const auto pixel = picture.view()[10][x];
    empty += !red(pixel) && !white(pixel);
  }
  CHECK(empty >= 4);
}

TEST_CASE("cloud view: an empty cloud and points that are no numbers leave the background") {
  Scene scene;
  const PointCloud none(kHeight, kWidth, 0, 0);
  const Tensor<std::uint8_t, 3> empty =
      render_cloud(none, scene.camera, scene.depth.shape(), 10, {});
  CHECK(*std::max_element(empty.data(), empty.data() + empty.size()) == 96);

  std::fill_n(scene.depth.data(), scene.depth.size(), 1e30f);  // their squares overflow
  scene.cloud.build({scene.depth, scene.confidence, scene.colors, {}, scene.camera}, 0, scene.ctx);
  CHECK_NOTHROW(scene.seen({30, 10, 1}));
}

TEST_CASE("cloud view: both sides are the two views beside each other") {
  const Scene scene;
  const Tensor<std::uint8_t, 3> both =
      render_cloud_from_both_sides(scene.cloud, scene.camera, scene.depth.shape(), 62);
  CHECK(both.shape() == Shape{42, 130, 3});
  const Tensor<std::uint8_t, 3> left = scene.seen({-30, 8, 1.1}, 62);
  for (std::int64_t y = 0; y < 42; ++y)
    CHECK(std::equal(left.view()[y].data(), left.view()[y].data() + 3 * 62, both[y].data()));
}
