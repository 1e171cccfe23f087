// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <limits>

#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
constexpr float kInfinity = std::numeric_limits<float>::infinity();

Tensor<float, 2> two_by_three(float last) {
  Tensor<float, 2> x(Shape{2, 3});
  for (std::int64_t i = 0; i < 6; ++i) x.data()[i] = static_cast<float>(i + 1);
  x(1, 2) = last;
  return x;
}

bool close(float actual, float expected, double absolute, double relative = 0) {
  return compare(two_by_three(actual).view(), two_by_three(expected).view(), absolute, relative).ok;
}

}  // namespace

TEST_CASE("compare: the limit is inclusive and an excess fails in either direction") {
  CHECK(close(6.25f, 6.0f, 0.25));
  CHECK_FALSE(close(6.25f, 6.0f, 0.2499));
  CHECK_FALSE(close(5.75f, 6.0f, 0.2499));
  CHECK(close(8.0f, 6.4f, 0.0, 0.26));
  CHECK_FALSE(close(8.0f, 6.4f, 0.0, 0.24));
}

TEST_CASE("compare: NaN, infinity and a wrong sign fail whatever the limit") {
  CHECK_FALSE(close(kNan, 6.0f, kInfinity));
  CHECK_FALSE(close(6.0f, kNan, kInfinity));
  CHECK_FALSE(close(kNan, kNan, kInfinity));
  CHECK_FALSE(close(6.0f, 6.5f, kNan));
  CHECK_FALSE(close(kInfinity, 6.0f, 1e30));
  CHECK_FALSE(close(kInfinity, -kInfinity, 1e30));
  CHECK(close(kInfinity, kInfinity, 0.0));
  CHECK_FALSE(close(-6.0f, 6.0f, 1.0, 1.0));
}

TEST_CASE("compare: different shapes of the same size fail") {
  const Tensor<float, 2> a(Shape{2, 3}), b(Shape{3, 2});
  const Comparison result = compare(a.view(), b.view(), 1.0);
  CHECK_FALSE(result.ok);
  CHECK(result.message == "shape [2,3], expected [3,2]");
  CHECK_FALSE(compare(a.view(), a.view(), 1.0, b.view()).ok);
  CHECK_FALSE(compare_bits(a.view(), b.view()).ok);
}

TEST_CASE("compare: the message names the worst element, both values and the limit") {
  Tensor<float, 2> actual = two_by_three(6);
  actual(0, 1) += 0.5f;
  actual(1, 0) -= 2.0f;
  const Comparison result = compare(actual.view(), two_by_three(6).view(), 0.25);
  CHECK_FALSE(result.ok);
  CHECK(result.message == "worst at [1,0]: 2, expected 4, off by 2, limit 0.25");
}

TEST_CASE("compare: limits given an element at a time are scaled by the factor") {
  const Tensor<float, 2> actual = two_by_three(7), expected = two_by_three(6);
  Tensor<double, 2> limits(Shape{2, 3});
  limits(1, 2) = 2;
  CHECK(compare(actual.view(), expected.view(), 0.5, limits.view()).ok);
  CHECK_FALSE(compare(actual.view(), expected.view(), 0.25, limits.view()).ok);
}

TEST_CASE("compare_bits: one unit in the last place and the sign of zero are seen") {
  const Tensor<float, 2> zero = two_by_three(0.0f);
  CHECK(compare_bits(zero.view(), two_by_three(0.0f).view()).ok);
  CHECK_FALSE(compare_bits(zero.view(), two_by_three(-0.0f).view()).ok);
  CHECK_FALSE(
      compare_bits(two_by_three(1.0f).view(), two_by_three(std::nextafter(1.0f, 2.0f)).view()).ok);
}

TEST_CASE("Strided: keeps the values, has gaps, and sees a write into one") {
  const Tensor<float, 2> values = two_by_three(6);
  Strided<2> strided(values.view());
  CHECK_SAME_BITS(strided.view(), values);
  CHECK_FALSE(strided.view().dense());
  CHECK(strided.gaps_untouched());
  strided.view()(1, 2) = 0;
  CHECK(strided.gaps_untouched());
  strided.view().data()[3] = 0;
  CHECK_FALSE(strided.gaps_untouched());
}

TEST_CASE("random_tensor: the seed decides, the range is kept") {
  const auto a = random_tensor(Shape{100}, 1, -2, 3);
  CHECK_SAME_BITS(a, random_tensor(Shape{100}, 1, -2, 3));
  CHECK_FALSE(compare_bits(a.view(), random_tensor(Shape{100}, 2, -2, 3).view()).ok);
  for (std::int64_t i = 0; i < 100; ++i) CHECK((a[i] >= -2 && a[i] < 3));
}
