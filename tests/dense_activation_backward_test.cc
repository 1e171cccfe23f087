// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/dense_activation_backward.h"

#include <doctest/doctest.h>

#include <cmath>
#include <limits>

#include "tests/support/compare.h"
#include "tests/support/gradient.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// The sum of all outputs times their gradients; the values before the last channel are a depth, or
// a point.   x, dy: [N, C]
double loss(const Tensor<double, 2>& x, const Tensor<float, 2>& dy) {
  const std::int64_t C = x.extent(1);
  double sum = 0;
  for (std::int64_t n = 0; n < x.extent(0); ++n)
    for (std::int64_t c = 0; c < C; ++c) {
      const double v = x(n, c);
      double y = 1 + std::exp(v);
      if (c < C - 1 && C == 2) y = std::exp(v);
      if (c < C - 1 && C == 4) y = std::copysign(std::expm1(std::abs(v)), v);
      sum += dy(n, c) * y;
    }
  return sum;
}

// dx by the kernel, of x with gaps behind its pixels.
void backward(View<float, 2> dx, View<const float, 2> x, const Tensor<float, 2>& dy, Context& ctx) {
  const auto [N, C] = x.shape();
  Tensor<float, 1> dconfidence(Shape{N}), ddepth(Shape{N});
  Tensor<float, 2> dpoints(Shape{N, std::int64_t{3}});
  for (std::int64_t n = 0; n < N; ++n) {
    dconfidence[n] = dy(n, C - 1);
    ddepth[n] = dy(n, 0);
    for (std::int64_t c = 0; C == 4 && c < 3; ++c) dpoints(n, c) = dy(n, c);
  }
  if (C == 2) return depth_activation_backward(dx, ddepth, dconfidence, x, ctx);
  point_activation_backward(dx, dpoints, dconfidence, x, ctx);
}

}  // namespace

TEST_CASE("depth_, point_activation_backward: agree with central differences, strided") {
  Context ctx(2);
  for (const std::int64_t C : {2, 4}) {
    for (const std::int64_t N : {1, 3, 17, 300}) {
      CAPTURE(C);
      CAPTURE(N);
      const auto x = random_tensor(Shape{N, C}, 1, -2, 2), dy = random_tensor(x.shape(), 2);
      Tensor<double, 2> expected(x.shape());
      for (std::int64_t n = 0; n < N; ++n) {  // pixels do not depend on each other
        Tensor<float, 2> pixel(Shape{std::int64_t{1}, C}), given(pixel.shape());
        std::copy_n(x[n].data(), C, pixel.data());
        std::copy_n(dy[n].data(), C, given.data());
        const auto gradient =
            central_differences(pixel, [&](const Tensor<double, 2>& v) { return loss(v, given); });
        std::copy_n(gradient.data(), C, expected[n].data());
      }
      for_each_target([&] {
        Strided<2> sx(x.view()), dx(x.shape());
        backward(dx.view(), sx.view(), dy, ctx);
        CHECK_CLOSE(dx.view(), expected, 1e-8, 4 * kUnit);
        CHECK(dx.gaps_untouched());
      });
    }
  }
}

TEST_CASE("point_activation_backward: slope 1 at 0, infinite where the point is, NaN stays NaN") {
  Context ctx(1);
  const float inf = std::numeric_limits<float>::infinity();
  for_each_target([&] {
    Tensor<float, 2> x(Shape{1, 4}), dy(x.shape()), dx(x.shape());
    for (std::int64_t c = 0; c < 4; ++c) dy(0, c) = 2;
    x(0, 0) = 0;
    x(0, 1) = -100;
    x(0, 2) = std::numeric_limits<float>::quiet_NaN();
    x(0, 3) = -200;
    backward(dx, x, dy, ctx);
    CHECK(dx(0, 0) == 2);
    CHECK(dx(0, 1) == inf);
    CHECK(std::isnan(dx(0, 2)));
    CHECK(dx(0, 3) == 0);
  });
}

TEST_CASE("depth_, point_activation_backward: same bits for 1 and 8 threads, shapes are checked") {
  Context one(1), eight(8);
  for (const std::int64_t C : {2, 4}) {
    const auto x = random_tensor(Shape{std::int64_t{20000}, C}, 1),
               dy = random_tensor(x.shape(), 2);
    Tensor<float, 2> dx1(x.shape()), dx8(x.shape()), odd(Shape{20000, 3});
    backward(dx1, x, dy, one);
    backward(dx8, x, dy, eight);
    CHECK_SAME_BITS(dx8, dx1);
    CHECK_THROWS_WITH_AS(backward(odd, x, dy, one), doctest::Contains("[20000,3]"), Error);
  }
  const auto x = random_tensor(Shape{5, 2}, 1);
  Tensor<float, 2> dx(x.shape());
  Tensor<float, 1> five(Shape{5}), six(Shape{6});
  CHECK_THROWS_WITH_AS(depth_activation_backward(dx, five, six, x, one), doctest::Contains("[6]"),
                       Error);
}
