// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/rope_backward.h"

#include <doctest/doctest.h>

#include "tests/reference/rope.h"
#include "tests/support/compare.h"
#include "tests/support/gradient.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

Tensor<std::int64_t, 2> five_positions() {
  Tensor<std::int64_t, 2> positions(Shape{5, 2});  // a special token, then patches
  for (std::int64_t p = 1; p < 5; ++p) {
    positions(p, 0) = p;
    positions(p, 1) = 3 * p - 2;
  }
  return positions;
}

}  // namespace

TEST_CASE("rope_2d_backward: agrees with central differences for every head size, in place") {
  Context ctx(2);
  const auto positions = five_positions();
  for (const std::int64_t D : {4, 12, 16, 24, 64}) {
    CAPTURE(D);
    const RopeTable table = make_rope_table(positions, D, 100);
    const auto x = random_tensor(Shape{std::int64_t{10}, std::int64_t{2}, D}, 1);
    const auto dy = random_tensor(x.shape(), 2);
    // Linear in x, so the differences have no error but rounding.
    const auto expected = central_differences(x, [&](const Tensor<double, 3>& v) {
      return weighted_sum(dy, reference::rope_2d(v, positions, 100.0));
    });
    for_each_target([&] {
      Strided<3> sdy(dy.view()), dx(x.shape());
      rope_2d_backward(dx.view(), sdy.view(), table, ctx);
      CHECK_CLOSE(dx.view(), expected, 6 * kUnit + 1e-8);
      CHECK(dx.gaps_untouched());
      rope_2d_backward(sdy.view(), sdy.view(), table, ctx);
      CHECK_SAME_BITS(sdy.view(), dx.view());
    });
  }
}

TEST_CASE("rope_2d_backward: turns back what the forward pass turned; shapes are checked") {
  Context one(1), eight(8);
  const RopeTable table = make_rope_table(five_positions(), 64, 100);
  const auto x = random_tensor(Shape{500, 4, 64}, 3);
  Tensor<float, 3> y(x.shape()), back1(x.shape()), back8(x.shape()), wide(Shape{500, 4, 68});
  rope_2d_forward(y, x, table, one);
  rope_2d_backward(back1, y, table, one);
  rope_2d_backward(back8, y, table, eight);
  CHECK_CLOSE(back1, x, 12 * kUnit);
  CHECK_SAME_BITS(back8, back1);
  CHECK_THROWS_WITH_AS(rope_2d_backward(wide, x, table, one), doctest::Contains("[500,4,68]"),
                       Error);
  CHECK_THROWS_WITH_AS(rope_2d_backward(wide, wide, table, one),
                       doctest::Contains("rope_2d_backward"), Error);
}
