// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/softmax.h"

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

template <class T>
Tensor<T, 2> definition(const Tensor<T, 2>& x, double scale) {
  Tensor<T, 2> y(x.shape());
  for (std::int64_t n = 0; n < x.extent(0); ++n) {
    T sum = 0;
    for (std::int64_t c = 0; c < x.extent(1); ++c) sum += y(n, c) = std::exp(scale * x(n, c));
    for (std::int64_t c = 0; c < x.extent(1); ++c) y(n, c) /= sum;
  }
  return y;
}

}  // namespace

TEST_CASE("softmax_forward: agrees with the definition for any length, strided and in place") {
  Context ctx(2);
  for_each_target([&] {
    for (const std::int64_t C : {1, 2, 3, 5, 8, 15, 16, 17, 33, 67}) {
      CAPTURE(C);
      const auto x = random_tensor(Shape{std::int64_t{3}, C}, 1, -8, 8);
      Strided<2> strided(x.view()), y(x.shape());
      softmax_forward(y.view(), strided.view(), 0.5f, ctx);
      // Rounding the exponent, 8 u, the exponential, 2 u, and the sum.
      CHECK_CLOSE(y.view(), definition(in_double(x), 0.5), 0, 16 * kUnit);
      CHECK(y.gaps_untouched());
      softmax_forward(strided.view(), strided.view(), 0.5f, ctx);
      CHECK_SAME_BITS(strided.view(), y.view());
    }
  });
}

TEST_CASE("softmax_forward: huge scores do not overflow, NaN stays NaN") {
  Context ctx(1);
  for_each_target([&] {
    Tensor<float, 2> x(Shape{2, 19}), y(x.shape());
    for (std::int64_t c = 0; c < 19; ++c) x(0, c) = x(1, c) = -3e38f;
    x(0, 7) = x(0, 18) = 3e38f;
    x(1, 18) = std::numeric_limits<float>::quiet_NaN();
    softmax_forward(y, x, 1, ctx);
    for (std::int64_t c = 0; c < 19; ++c) {
      CHECK(y(0, c) == (c == 7 || c == 18 ? 0.5f : 0.0f));
      CHECK(std::isnan(y(1, c)));
    }
  });
}

TEST_CASE("softmax_backward: agrees with the complex step, strided and in place") {
  Context ctx(2);
  for_each_target([&] {
    for (const std::int64_t C : {1, 2, 7, 16, 33}) {
      CAPTURE(C);
      const auto x = random_tensor(Shape{std::int64_t{3}, C}, 1, -4, 4);
      const auto dy = random_tensor(x.shape(), 2);
      const auto expected = complex_step(
          x, [&](const Tensor<Complex, 2>& v) { return weighted_sum(dy, definition(v, 0.7)); });
      Tensor<float, 2> y(x.shape());
      softmax_forward(y, x, 0.7f, ctx);
      Strided<2> kept(y.view()), sdy(dy.view()), dx(x.shape());
      softmax_backward(dx.view(), sdy.view(), kept.view(), 0.7f, ctx);
      CHECK_CLOSE(dx.view(), expected, 16 * kUnit);
      CHECK(dx.gaps_untouched());
      softmax_backward(sdy.view(), sdy.view(), kept.view(), 0.7f, ctx);
      CHECK_SAME_BITS(sdy.view(), dx.view());
    }
  });
}

TEST_CASE("softmax: 1 and 8 threads give the same bits, wrong arguments are refused by name") {
  Context one(1), eight(8);
  const auto x = random_tensor(Shape{600, 129}, 1), dy = random_tensor(x.shape(), 2);
  Tensor<float, 2> y1(x.shape()), y8(x.shape()), dx1(x.shape()), dx8(x.shape());
  softmax_forward(y1, x, 1, one);
  softmax_forward(y8, x, 1, eight);
  softmax_backward(dx1, dy, y1, 1, one);
  softmax_backward(dx8, dy, y8, 1, eight);
  CHECK_SAME_BITS(y8, y1);
  CHECK_SAME_BITS(dx8, dx1);
  Tensor<float, 2> wide(Shape{600, 130});
  CHECK_THROWS_WITH_AS(softmax_forward(wide, x, 1, one), doctest::Contains("[600,130]"), Error);
  CHECK_THROWS_WITH_AS(softmax_forward(y1, x, 0, one), doctest::Contains("scale 0"), Error);
  CHECK_THROWS_WITH_AS(softmax_backward(wide, dy, y1, 1, one), doctest::Contains("[600,130]"),
                       Error);
}
