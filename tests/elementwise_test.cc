// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/elementwise.h"

#include <doctest/doctest.h>

#include <limits>

#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

TEST_CASE("add: one rounding, every length, strided, y may be a or b") {
  Context ctx(1);
  for_each_target([&] {
    for (std::int64_t C = 0; C <= 33; ++C) {
      CAPTURE(C);
      const auto a = random_tensor(Shape{std::int64_t{3}, C}, 1),
                 b = random_tensor(Shape{std::int64_t{3}, C}, 2);
      Tensor<float, 2> expected(a.shape());
      for (std::int64_t i = 0; i < a.size(); ++i) expected.data()[i] = a.data()[i] + b.data()[i];
      Strided<2> y(a.shape()), sa(a.view()), sb(b.view());
      add(y.view(), sa.view(), sb.view(), ctx);
      CHECK_SAME_BITS(y.view(), expected);
      CHECK(y.gaps_untouched());
      Strided<2> also_b(b.view());
      add(also_b.view(), sa.view(), also_b.view(), ctx);
      CHECK_SAME_BITS(also_b.view(), expected);
      add(sa.view(), sa.view(), sb.view(), ctx);
      CHECK_SAME_BITS(sa.view(), expected);
    }
  });
}

TEST_CASE("modulate: gate (x (1 + scale) + shift) + t, every length, strided, y may be x or t") {
  Context ctx(1);
  for_each_target([&] {
    for (std::int64_t C = 0; C <= 33; ++C) {
      CAPTURE(C);
      const Shape shape{std::int64_t{2}, C};
      const auto x = random_tensor(shape, 1), shift = random_tensor(shape, 2),
                 scale = random_tensor(shape, 3);
      const auto gate = random_tensor(shape, 4), t = random_tensor(shape, 5);
      Tensor<double, 2> expected(shape);
      for (std::int64_t i = 0; i < x.size(); ++i)
        expected.data()[i] =
            double{gate.data()[i]} *
                (double{x.data()[i]} * (1 + double{scale.data()[i]}) + double{shift.data()[i]}) +
            double{t.data()[i]};
      Strided<2> y(shape), sx(x.view()), st(t.view());
      modulate(y.view(), sx.view(), shift, scale, gate, st.view(), ctx);
      // All below 1 in size: sums below 2, 3 and 4, at most five roundings.
      CHECK_CLOSE(y.view(), expected, 14 * kUnit);
      CHECK(y.gaps_untouched());
      modulate(sx.view(), sx.view(), shift, scale, gate, t, ctx);
      CHECK_SAME_BITS(sx.view(), y.view());
      modulate(st.view(), x, shift, scale, gate, st.view(), ctx);
      CHECK_SAME_BITS(st.view(), y.view());
    }
  });
}

TEST_CASE("copy_rows: every element, nothing between the rows") {
  Context ctx(3);
  for (const std::int64_t N : {0, 1, 5, 4000}) {
    const auto x = random_tensor(Shape{N, std::int64_t{19}}, 1);
    Strided<2> from(x.view()), to(x.shape());
    copy_rows(to.view(), from.view(), ctx);
    CHECK_SAME_BITS(to.view(), x);
    CHECK(to.gaps_untouched());
  }
}

TEST_CASE("to_planes, from_planes: channels move, and back again; strided pixels") {
  Context ctx(2);
  for (const Shape<3>& shape : {Shape<3>{{1, 1, 1}}, Shape<3>{{3, 5, 3}}, Shape<3>{{7, 65, 19}},
                                Shape<3>{{4, 130, 2}}, Shape<3>{{0, 4, 3}}, Shape<3>{{4, 4, 0}}}) {
    CAPTURE(shape);
    const auto x = random_tensor(shape, 1);
    Strided<3> pixels(x.view()), back(shape);
    Tensor<float, 3> planes(Shape{shape[2], shape[0], shape[1]});
    to_planes(planes, pixels.view(), ctx);
    for (std::int64_t h = 0; h < shape[0]; ++h)
      for (std::int64_t w = 0; w < shape[1]; ++w)
        for (std::int64_t c = 0; c < shape[2]; ++c) REQUIRE(planes(c, h, w) == x(h, w, c));
    from_planes(back.view(), planes, ctx);
    CHECK_SAME_BITS(back.view(), x);
    CHECK(back.gaps_untouched());
  }
}

TEST_CASE("find_nonfinite: the first NaN or infinity, wherever it is") {
  for_each_target([&] {
    for (const std::int64_t N : {0, 1, 15, 16, 17, 4095, 4096, 4097, 20000}) {
      CAPTURE(N);
      Tensor<float, 1> x = random_tensor(Shape{N}, 1, -1e38f, 1e38f);
      CHECK(find_nonfinite(x) == -1);
      if (N == 0) continue;
      x[N - 1] = -std::numeric_limits<float>::infinity();
      CHECK(find_nonfinite(x) == N - 1);
      x[N / 2] = std::numeric_limits<float>::quiet_NaN();
      CHECK(find_nonfinite(x) == N / 2);
      x[0] = std::numeric_limits<float>::infinity();
      CHECK(find_nonfinite(x) == 0);
    }
  });
}

TEST_CASE("elementwise: 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  const auto a = random_tensor(Shape{999, 77}, 1), b = random_tensor(Shape{999, 77}, 2);
  Tensor<float, 2> y1(a.shape()), y8(a.shape());
  add(y1, a, b, one);
  add(y8, a, b, eight);
  CHECK_SAME_BITS(y8, y1);
  modulate(y1, a, b, b, a, b, one);
  modulate(y8, a, b, b, a, b, eight);
  CHECK_SAME_BITS(y8, y1);
}

TEST_CASE("elementwise: different shapes are refused, both are named") {
  Context ctx(1);
  Tensor<float, 2> a(Shape{2, 3}), b(Shape{2, 4});
  Tensor<float, 3> pixels(Shape{2, 3, 4}), planes(Shape{4, 3, 2});
  CHECK_THROWS_WITH_AS(add(a, a, b, ctx), "add: y is [2,3] but a is [2,3] and b is [2,4]", Error);
  CHECK_THROWS_WITH_AS(modulate(a, a, a, b, a, a, ctx), doctest::Contains("[2,4]"), Error);
  CHECK_THROWS_WITH_AS(copy_rows(a, b, ctx), doctest::Contains("[2,4]"), Error);
  CHECK_THROWS_WITH_AS(to_planes(planes, pixels, ctx), doctest::Contains("[4,3,2]"), Error);
  CHECK_THROWS_WITH_AS(from_planes(pixels, planes, ctx), doctest::Contains("[4,3,2]"), Error);
}
