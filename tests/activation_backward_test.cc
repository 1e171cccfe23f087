// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>
#include <limits>
#include <string>

#include "lvggt/kernels/activation.h"
#include "tests/reference/activation.h"
#include "tests/support/compare.h"
#include "tests/support/gradient.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

using Backward = void (*)(View<float, 2>, View<const float, 2>, View<const float, 2>, Context&);
struct Op {
  Activation kind;
  Backward backward;
  bool from_output;
  double limit;  // of the slope
};
// The slope of GELU is good to 5e-7; the others round a handful of times.
constexpr Op kOps[] = {{Activation::kRelu, relu_backward, true, kUnit},
                       {Activation::kSigmoid, sigmoid_backward, true, 4 * kUnit},
                       {Activation::kSilu, silu_backward, false, 16 * kUnit},
                       {Activation::kGelu, gelu_backward, false, 5e-7}};

double slope(double x, Activation kind) {
  const Tensor<float, 1> point =
      random_tensor(Shape{1}, 1, static_cast<float>(x), static_cast<float>(x));
  return central_differences(
      point, [&](const Tensor<double, 1>& v) { return reference::activation(v[0], kind); })[0];
}

}  // namespace

TEST_CASE("activation backward: agrees with central differences, any length, strided, in place") {
  Context ctx(2);
  for_each_target([&] {
    for (const Op& op : kOps) {
      CAPTURE(static_cast<int>(op.kind));
      for (const std::int64_t C : {1, 2, 3, 5, 8, 15, 16, 17, 33}) {
        CAPTURE(C);
        const auto x = random_tensor(Shape{std::int64_t{4}, C}, 1, -12, 12);
        const auto dy = random_tensor(x.shape(), 2);
        Tensor<float, 2> y(x.shape());
        activation_forward(y, x, op.kind, ctx);
        Tensor<double, 2> expected(x.shape());
        for (std::int64_t i = 0; i < x.size(); ++i)
          expected.data()[i] = dy.data()[i] * slope(x.data()[i], op.kind);
        Strided<2> kept(op.from_output ? y.view() : x.view()), sdy(dy.view()), dx(x.shape());
        op.backward(dx.view(), sdy.view(), kept.view(), ctx);
        CHECK_CLOSE(dx.view(), expected, op.limit + 1e-9);  // the differences are good to 1e-9
        CHECK(dx.gaps_untouched());
        op.backward(sdy.view(), sdy.view(), kept.view(), ctx);
        CHECK_SAME_BITS(sdy.view(), dx.view());
        Tensor<float, 2> dense(x.shape());
        op.backward(dense, dy, op.from_output ? y.view() : x.view(), ctx);
        CHECK_SAME_BITS(dense, dx.view());
      }
    }
  });
}

TEST_CASE("gelu_backward, silu_backward: far out the slope is 0 or 1, at 0 a half") {
  Context ctx(1);
  const float inf = std::numeric_limits<float>::infinity();
  for_each_target([&] {
    for (const Backward backward : {gelu_backward, silu_backward}) {
      const float points[] = {-1e4f, -80, 0, 80, 1e4f, 3e38f};
      const float slopes[] = {0, 0, 0.5f, 1, 1, 1};
      Tensor<float, 2> x(Shape{1, 6}), ones(x.shape()), dx(x.shape());
      for (std::int64_t i = 0; i < 6; ++i) {
        x(0, i) = points[i];
        ones(0, i) = 1;
      }
      backward(dx, ones, x, ctx);
      for (std::int64_t i = 0; i < 6; ++i) CHECK(dx(0, i) == doctest::Approx(slopes[i]));
      x(0, 0) = std::numeric_limits<float>::quiet_NaN();
      backward(dx, ones, x, ctx);
      CHECK(std::isnan(dx(0, 0)));
    }
    Tensor<float, 2> x(Shape{1, 1}), one(x.shape()), dx(x.shape());
    one(0, 0) = 1;
    x(0, 0) = inf;
    gelu_backward(dx, one, x, ctx);
    CHECK(dx(0, 0) == 1);
  });
}

TEST_CASE("relu_backward: what was cut off gets exactly 0, whatever comes in") {
  Context ctx(1);
  const float inf = std::numeric_limits<float>::infinity();
  for_each_target([&] {
    Tensor<float, 2> y(Shape{1, 4}), dy(y.shape()), dx(y.shape());
    y(0, 1) = 2;
    y(0, 3) = 1e-40f;  // a denormal output is positive
    dy(0, 0) = inf;
    dy(0, 1) = -inf;
    dy(0, 2) = std::numeric_limits<float>::quiet_NaN();
    dy(0, 3) = 5;
    relu_backward(dx, dy, y, ctx);
    CHECK(dx(0, 0) == 0);
    CHECK(dx(0, 1) == -inf);
    CHECK(dx(0, 2) == 0);
    CHECK(dx(0, 3) == 5);
  });
}

TEST_CASE("activation backward: 1 and 8 threads give the same bits, shapes are checked") {
  Context one(1), eight(8);
  const auto x = random_tensor(Shape{777, 67}, 1), dy = random_tensor(x.shape(), 2);
  Tensor<float, 2> dx1(x.shape()), dx8(x.shape()), wide(Shape{777, 68});
  for (const Op& op : kOps) {
    op.backward(dx1, dy, x, one);
    op.backward(dx8, dy, x, eight);
    CHECK_SAME_BITS(dx8, dx1);
    CHECK_THROWS_WITH_AS(op.backward(wide, dy, x, one), doctest::Contains("[777,68]"), Error);
  }
}
