// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/rope.h"

#include <doctest/doctest.h>

#include <cmath>

#include "tests/reference/rope.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// Special tokens at (0, 0), then a grid of patches, as in the aggregator.
Tensor<std::int64_t, 2> grid_positions(std::int64_t special, std::int64_t h, std::int64_t w) {
  Tensor<std::int64_t, 2> positions(Shape{special + h * w, std::int64_t{2}});
  for (std::int64_t i = 0; i < h * w; ++i) {
    positions(special + i, 0) = i / w + 1;
    positions(special + i, 1) = i % w + 1;
  }
  return positions;
}

}  // namespace

TEST_CASE("rope_2d_forward: agrees with the definition for every head size, strided and in place") {
  Context ctx(2);
  const auto positions = grid_positions(2, 3, 4);
  for_each_target([&] {
    for (const std::int64_t D : {4, 8, 16, 20, 24, 32, 64, 68, 128}) {
      CAPTURE(D);
      const RopeTable table = make_rope_table(positions, D, 100);
      for (const std::int64_t frames : {0, 1, 3}) {
        const auto x = random_tensor(Shape{14 * frames, std::int64_t{3}, D}, 1);
        Strided<3> strided(x.view()), y(x.shape());
        rope_2d_forward(y.view(), strided.view(), table, ctx);
        // |x| < 1: two products of a value with a rounded cosine or sine, 2 u each, and their sum.
        CHECK_CLOSE(y.view(), reference::rope_2d(in_double(x), positions, 100.0), 6 * kUnit);
        CHECK(y.gaps_untouched());
        rope_2d_forward(strided.view(), strided.view(), table, ctx);
        CHECK_SAME_BITS(strided.view(), y.view());
      }
    }
  });
}

TEST_CASE("make_rope_table: cosines and sines are rounded once, also far from the origin") {
  Tensor<std::int64_t, 2> positions(Shape{1, 2});
  positions(0, 0) = 37;
  positions(0, 1) = 4001;
  const RopeTable table = make_rope_table(positions, 64, 100);
  for (std::int64_t axis = 0; axis < 2; ++axis)
    for (std::int64_t j = 0; j < 16; ++j) {
      const double angle = static_cast<double>(positions(0, axis)) *
                           std::pow(100.0, -2.0 * static_cast<double>(j) / 32.0);
      CHECK(table.cos(0, axis * 16 + j) == static_cast<float>(std::cos(angle)));
      CHECK(table.sin(0, axis * 16 + j) == static_cast<float>(std::sin(angle)));
    }
}

TEST_CASE("rope_2d_forward: tokens at (0, 0) are left as they are") {
  Context ctx(1);
  const auto x = random_tensor(Shape{2, 2, 64}, 1);
  Tensor<float, 3> y(x.shape());
  rope_2d_forward(y, x, make_rope_table(grid_positions(2, 0, 0), 64, 100), ctx);
  CHECK_CLOSE(y, x, 0.0);
}

TEST_CASE("rope_2d_forward: 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  const auto table = make_rope_table(grid_positions(5, 21, 37), 64, 100);
  const auto x = random_tensor(Shape{782, 16, 64}, 1);
  Tensor<float, 3> y1(x.shape()), y8(x.shape());
  rope_2d_forward(y1, x, table, one);
  rope_2d_forward(y8, x, table, eight);
  CHECK_SAME_BITS(y8, y1);
}

TEST_CASE("rope_2d: wrong shapes are refused by name") {
  Context ctx(1);
  const auto positions = grid_positions(1, 1, 2);
  CHECK_THROWS_WITH_AS(make_rope_table(positions, 6, 100), doctest::Contains("head_dim 6"), Error);
  CHECK_THROWS_WITH_AS(make_rope_table(Tensor<std::int64_t, 2>(Shape{3, 3}), 8, 100),
                       doctest::Contains("[3,3]"), Error);
  const auto table = make_rope_table(positions, 8, 100);
  Tensor<float, 3> x(Shape{3, 1, 16}), part(Shape{4, 1, 8});
  CHECK_THROWS_WITH_AS(rope_2d_forward(x, x, table, ctx), doctest::Contains("[3,1,16]"), Error);
  CHECK_THROWS_WITH_AS(rope_2d_forward(part, part, table, ctx), doctest::Contains("4 tokens"),
                       Error);
}
