// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/crops.h"

#include <doctest/doctest.h>

#include "lvggt/core/error.h"

using namespace lvggt;

namespace {

// A picture whose pixel (y, x) is (y, x, 100), and a label map of zeros.
Tensor<std::uint8_t, 3> picture(std::int64_t H, std::int64_t W) {
  Tensor<std::uint8_t, 3> rgb(Shape{H, W, std::int64_t{3}});
  for (std::int64_t y = 0; y < H; ++y)
    for (std::int64_t x = 0; x < W; ++x) {
      rgb(y, x, 0) = static_cast<std::uint8_t>(y);
      rgb(y, x, 1) = static_cast<std::uint8_t>(x);
      rgb(y, x, 2) = 100;
    }
  return rgb;
}

}  // namespace

TEST_CASE("find_objects: the box lacks the last column and row, as published") {
  Tensor<std::int32_t, 2> labels(Shape{6, 8});
  labels(1, 2) = labels(1, 5) = labels(4, 3) = 7;
  labels(2, 0) = labels(3, 0) = 2;  // one column: its box has no width
  labels(0, 7) = -1;                // background too
  const auto boxes = find_objects(labels);
  REQUIRE(boxes.size() == 2);
  CHECK(boxes[0].label == 2);
  CHECK(boxes[0].dropped());
  CHECK(boxes[1].label == 7);
  CHECK(boxes[1].x == 2);
  CHECK(boxes[1].y == 1);
  CHECK(boxes[1].width == 3);
  CHECK(boxes[1].height == 3);
}

TEST_CASE("object_crop: other objects are black, and the shorter side is padded, less in front") {
  Tensor<std::int32_t, 2> labels(Shape{5, 9});
  for (std::int64_t x = 1; x <= 5; ++x) labels(2, x) = labels(3, x) = 1;
  labels(2, 3) = 4;
  const auto boxes = find_objects(labels);
  REQUIRE(!boxes.empty());
  const auto rgb = picture(5, 9);
  const auto crop = object_crop(rgb, labels, boxes[0]);  // 4 x 1 becomes 4 x 4: one row, then two
  REQUIRE(crop.extent(0) == 4);
  CHECK(crop(0, 0, 2) == 0);
  CHECK(crop(1, 0, 1) == 1);
  CHECK(crop(1, 0, 2) == 100);
  CHECK(crop(1, 2, 2) == 0);  // the other object
  CHECK(crop(1, 3, 1) == 4);
  CHECK(crop(2, 0, 2) == 0);
  CHECK(crop(3, 3, 2) == 0);
}

TEST_CASE("object_crop: a dropped object, a box outside and another size are refused") {
  Tensor<std::int32_t, 2> labels(Shape{5, 9});
  const auto rgb = picture(5, 9), other = picture(9, 5);
  CHECK_THROWS_AS(object_crop(rgb, labels, {1, 0, 0, 0, 3}), Error);
  CHECK_THROWS_AS(object_crop(rgb, labels, {1, 7, 0, 3, 3}), Error);
  CHECK_THROWS_AS(object_crop(other, labels, {1, 0, 0, 2, 2}), Error);
}

TEST_CASE("resize_linear_u8: the same size is a copy, twice the size an average") {
  const auto rgb = picture(8, 8);
  Tensor<std::uint8_t, 3> same(rgb.shape()), half(Shape{4, 4, 3});
  resize_linear_u8(same, rgb);
  for (std::int64_t i = 0; i < rgb.size(); ++i) CHECK(same.data()[i] == rgb.data()[i]);
  resize_linear_u8(half, rgb);
  CHECK(half(1, 2, 0) == 3);  // (2 + 2 + 3 + 3 + 2) / 4
  CHECK(half(1, 2, 1) == 5);
}

TEST_CASE("clip_object_pixels: several objects on any number of threads have the same bits") {
  Tensor<std::int32_t, 2> labels(Shape{20, 20});
  for (std::int64_t i = 0; i < 400; ++i) labels.data()[i] = static_cast<std::int32_t>(i / 67);
  const auto rgb = picture(20, 20);
  const auto boxes = find_objects(labels);
  const auto n = static_cast<std::int64_t>(boxes.size());
  Tensor<float, 4> one(Shape{n, std::int64_t{16}, std::int64_t{16}, std::int64_t{3}}),
      many(one.shape());
  Context single(1), several(4);
  clip_object_pixels(one, rgb, labels, boxes, single);
  clip_object_pixels(many, rgb, labels, boxes, several);
  CHECK(std::equal(one.data(), one.data() + one.size(), many.data()));
}
