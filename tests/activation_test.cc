// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/activation.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <limits>

#include "tests/reference/activation.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr float kInfinity = std::numeric_limits<float>::infinity();
constexpr Activation kAll[] = {Activation::kNone, Activation::kRelu, Activation::kGelu,
                               Activation::kSilu, Activation::kSigmoid};

// gelu: the documented error of the vector function. silu and sigmoid: exp to 2.2 u (u = 2^-24), a
// sum and a quotient to 1 u each, and what is below the smallest normal number may become 0.
double limit_of(Activation kind, double x, double expected) {
  if (kind == Activation::kGelu) return 1.8e-7 * std::max(1.0, std::abs(x));
  if (kind == Activation::kSilu) return 4.3 * kUnit * std::abs(expected) + 1.1e-36;
  if (kind == Activation::kSigmoid) return 4.3 * kUnit * std::abs(expected) + 1.2e-38;
  return 0;
}

Comparison compare_activation(View<const float, 2> y, View<const float, 2> x, Activation kind) {
  Tensor<double, 2> expected = converted<double>(x);
  for (std::int64_t i = 0; i < expected.size(); ++i)
    expected.data()[i] = reference::activation(expected.data()[i], kind);
  return compare_by(y, as_view(expected), [&](const Shape<2>& index, double e) {
    return limit_of(kind, element(x, index), e);
  });
}

// Values from -magnitude to magnitude, denser near zero.
Tensor<float, 2> sweep(std::int64_t count, double magnitude) {
  Tensor<float, 2> x(Shape{std::int64_t{1}, count});
  for (std::int64_t i = 0; i < count; ++i) {
    const double t = 2.0 * static_cast<double>(i) / static_cast<double>(count - 1) - 1.0;
    x(0, i) = static_cast<float>(magnitude * t * t * t);
  }
  return x;
}

}  // namespace

TEST_CASE("activation_forward: agrees with the definition in double over the whole range") {
  Context ctx(1);
  const Tensor<float, 2> x = sweep(40001, 100);
  for_each_target([&] {
    for (const Activation kind : kAll) {
      CAPTURE(static_cast<int>(kind));
      Tensor<float, 2> y(x.shape());
      activation_forward(y, x, kind, ctx);
      const Comparison result = compare_activation(y, x, kind);
      CHECK_MESSAGE(result.ok, result.message);
    }
  });
}

TEST_CASE(
    "activation_forward: every length up to two vectors and one, dense and strided, in place") {
  Context ctx(1);
  for_each_target([&] {
    for (std::int64_t C = 0; C <= 33; ++C) {
      CAPTURE(C);
      const Tensor<float, 2> x = random_tensor(Shape{std::int64_t{3}, C}, 7, -4, 4);
      for (const Activation kind : kAll) {
        Tensor<float, 2> y(x.shape());
        activation_forward(y, x, kind, ctx);
        const Comparison result = compare_activation(y, x, kind);
        CHECK_MESSAGE(result.ok, result.message);
        Strided<2> strided_x(x.view()), strided_y(x.shape());
        activation_forward(strided_y.view(), strided_x.view(), kind, ctx);
        CHECK_CLOSE(strided_y.view(), y, 3e-7);
        CHECK(strided_y.gaps_untouched());
        activation_forward(strided_x.view(), strided_x.view(), kind, ctx);
        CHECK_SAME_BITS(strided_x.view(), strided_y.view());
      }
    }
  });
}

TEST_CASE("activation_forward: NaN stays NaN, infinities and huge values go where they should") {
  Context ctx(1);
  for_each_target([&] {
    // One vector's worth of each, so that vectors and remainders both see it.
    for (const std::int64_t C : {1, 16, 21}) {
      Tensor<float, 2> x(Shape{std::int64_t{1}, C}), y(x.shape());
      const auto applied = [&](Activation kind, float value) {
        std::fill_n(x.data(), C, value);
        activation_forward(y, x, kind, ctx);
        for (std::int64_t i = 1; i < C; ++i) CHECK(std::isnan(y(0, i)) == std::isnan(y(0, 0)));
        return y(0, C - 1);
      };
      for (const Activation kind : kAll) CHECK(std::isnan(applied(kind, kNan)));
      CHECK(applied(Activation::kRelu, -kInfinity) == 0);
      CHECK(applied(Activation::kRelu, kInfinity) == kInfinity);
      CHECK(applied(Activation::kGelu, kInfinity) == kInfinity);
      CHECK(applied(Activation::kGelu, 3e38f) == 3e38f);
      CHECK(std::abs(applied(Activation::kGelu, -3e38f)) < 1e-18f);
      CHECK(applied(Activation::kSilu, 3e38f) == 3e38f);
      CHECK(applied(Activation::kSilu, -3e38f) == 0);
      CHECK(applied(Activation::kSigmoid, kInfinity) == 1);
      CHECK(applied(Activation::kSigmoid, -kInfinity) == 0);
    }
  });
}

TEST_CASE("activation_forward: 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  const Tensor<float, 2> x = random_tensor(Shape{37, 1031}, 5, -6, 6);
  for (const Activation kind : kAll) {
    Strided<2> strided(x.view());
    Tensor<float, 2> y1(x.shape()), y8(x.shape());
    activation_forward(y1, x, kind, one);
    activation_forward(y8, x, kind, eight);
    CHECK_SAME_BITS(y8, y1);
    activation_forward(y1, strided.view(), kind, one);
    activation_forward(y8, strided.view(), kind, eight);
    CHECK_SAME_BITS(y8, y1);
  }
}

TEST_CASE("activation_forward: different shapes are refused, both are named") {
  Context ctx(1);
  Tensor<float, 2> y(Shape{2, 3}), x(Shape{3, 2});
  CHECK_THROWS_WITH_AS(activation_forward(y, x, Activation::kRelu, ctx),
                       "activation: y is [2,3] but x is [3,2]", Error);
}

TEST_CASE("depth_activation: exp and 1 + exp of the two channels to 1.1 units in the last place") {
  Context ctx(1);
  const Tensor<float, 2> values = sweep(60000, 95);
  for_each_target([&] {
    for (const std::int64_t N : {0, 1, 7, 255, 257, 30000}) {
      CAPTURE(N);
      const View<const float, 2> x =
          values.view().reshaped(Shape{30000, 2}).narrow(0, 30000 - N, 30000);
      Tensor<float, 1> depth(Shape{N}), confidence(Shape{N});
      depth_activation(depth, confidence, x, ctx);
      Tensor<double, 1> expected_depth(Shape{N}), expected_confidence(Shape{N});
      for (std::int64_t n = 0; n < N; ++n) {
        // Beyond the largest float the result is infinity, below the smallest normal one 0.
        const auto exp_of = [](double v) {
          return v > 88.7228394 ? double{kInfinity} : std::exp(v);
        };
        expected_depth[n] = exp_of(x(n, 0));
        expected_confidence[n] = 1 + exp_of(x(n, 1));
      }
      CHECK_CLOSE(depth, expected_depth, 1.2e-38, 2.2 * kUnit);
      CHECK_CLOSE(confidence, expected_confidence, 0, 3.2 * kUnit);
    }
  });
}

TEST_CASE("point_activation: signed expm1 of three channels to 1.5 units in the last place") {
  Context ctx(1);
  const Tensor<float, 2> values = sweep(48000, 88);
  for_each_target([&] {
    for (const std::int64_t N : {0, 1, 7, 255, 257, 12000}) {
      CAPTURE(N);
      const View<const float, 2> x = values.view().reshaped(Shape{12000, 4}).narrow(0, 0, N);
      Strided<2> points(Shape{N, std::int64_t{3}});
      Tensor<float, 1> confidence(Shape{N});
      point_activation(points.view(), confidence, x, ctx);
      Tensor<double, 2> expected_points(Shape{N, std::int64_t{3}});
      Tensor<double, 1> expected_confidence(Shape{N});
      for (std::int64_t n = 0; n < N; ++n) {
        for (std::int64_t c = 0; c < 3; ++c)
          expected_points(n, c) = std::copysign(std::expm1(std::abs(double{x(n, c)})), x(n, c));
        expected_confidence[n] = 1 + std::exp(double{x(n, 3)});
      }
      CHECK_CLOSE(points.view(), expected_points, 0, 3 * kUnit);
      CHECK_CLOSE(confidence, expected_confidence, 0, 3.2 * kUnit);
      CHECK(points.gaps_untouched());
    }
  });
}

TEST_CASE("depth_activation, point_activation: NaN stays NaN, 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  Tensor<float, 2> x = random_tensor(Shape{40000, 4}, 3, -3, 3);
  x(11, 0) = x(11, 1) = x(39999, 2) = x(39999, 3) = kNan;
  Tensor<float, 2> p1(Shape{40000, 3}), p8(p1.shape());
  Tensor<float, 1> c1(Shape{40000}), c8(c1.shape()), d1(c1.shape()), d8(c1.shape());
  point_activation(p1, c1, x, one);
  point_activation(p8, c8, x, eight);
  CHECK_SAME_BITS(p8, p1);
  CHECK_SAME_BITS(c8, c1);
  CHECK((std::isnan(p1(11, 0)) && std::isnan(p1(11, 1)) && !std::isnan(p1(11, 2))));
  CHECK((std::isnan(p1(39999, 2)) && std::isnan(c1[39999]) && !std::isnan(c1[39998])));
  depth_activation(d1, c1, x.view().narrow(1, 0, 2), one);
  depth_activation(d8, c8, x.view().narrow(1, 0, 2), eight);
  CHECK_SAME_BITS(d8, d1);
  CHECK_SAME_BITS(c8, c1);
  CHECK((std::isnan(d1[11]) && std::isnan(c1[11]) && !std::isnan(d1[12])));
}

TEST_CASE("depth_activation, point_activation: a wrong number of channels is refused") {
  Context ctx(1);
  Tensor<float, 2> x(Shape{5, 3}), points(Shape{5, 3});
  Tensor<float, 1> depth(Shape{5}), confidence(Shape{5});
  CHECK_THROWS_WITH_AS(depth_activation(depth, confidence, x, ctx), doctest::Contains("[5,3]"),
                       Error);
  CHECK_THROWS_WITH_AS(point_activation(points, confidence, x, ctx), doctest::Contains("[5,3]"),
                       Error);
}
