// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/interpolate.h"

#include <doctest/doctest.h>

#include "tests/reference/bicubic.h"
#include "tests/reference/interpolate.h"
#include "tests/support/compare.h"
#include "tests/support/gradient.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

struct Resize {
  std::int64_t H, W, Ho, Wo;
};
constexpr Resize kResizes[] = {{1, 1, 1, 1},   {1, 1, 4, 3},  {3, 5, 1, 4},   {1, 3, 4, 6},
                               {5, 7, 11, 13}, {4, 5, 8, 10}, {11, 13, 5, 7}, {4, 6, 4, 6},
                               {2, 9, 9, 2},   {8, 8, 1, 1}};

template <class T>
Tensor<T, 3> bilinear(const Tensor<T, 3>& x, std::int64_t Ho, std::int64_t Wo, bool align_corners) {
  return reference::resize(
      x, Ho, Wo, [=](std::int64_t i, std::int64_t j, std::int64_t out, std::int64_t in) {
        return reference::bilinear_weight<double>(i, j, out, in, align_corners);
      });
}

}  // namespace

TEST_CASE(
    "bilinear_forward: agrees with the definition for both conventions, any size and channel "
    "count") {
  Context ctx(2);
  for_each_target([&] {
    for (const Resize& r : kResizes) {
      for (const std::int64_t C : {1, 2, 3, 7, 16, 21, 33}) {
        CAPTURE(C);
        const auto x = random_tensor(Shape{std::int64_t{2}, r.H, r.W, C}, 1);
        for (const bool align_corners : {false, true}) {
          Strided<4> sx(x.view()), y(Shape{std::int64_t{2}, r.Ho, r.Wo, C});
          bilinear_forward(y.view(), sx.view(), align_corners, ctx);
          for (std::int64_t b = 0; b < 2; ++b) {
            // |x| < 1: each blend rounds the weight, its complement, two products and a sum; two in
            // a row.
            CHECK_CLOSE(y.view()[b], bilinear(converted<double>(x[b]), r.Ho, r.Wo, align_corners),
                        10 * kUnit);
          }
          CHECK(y.gaps_untouched());
        }
      }
    }
  });
}

TEST_CASE("bilinear_forward: corners map to corners when align_corners is true") {
  Context ctx(1);
  const auto x = random_tensor(Shape{1, 6, 9, 5}, 1);
  Tensor<float, 4> y(Shape{1, 17, 23, 5});
  bilinear_forward(y, x, true, ctx);
  for (std::int64_t c = 0; c < 5; ++c) {
    CHECK(y(0, 0, 0, c) == x(0, 0, 0, c));
    CHECK(y(0, 0, 22, c) == x(0, 0, 8, c));
    CHECK(y(0, 16, 0, c) == x(0, 5, 0, c));
    CHECK(y(0, 16, 22, c) == x(0, 5, 8, c));
  }
}

TEST_CASE("bilinear_forward: the same size changes nothing, a constant stays a constant") {
  Context ctx(1);
  const auto x = random_tensor(Shape{2, 7, 5, 19}, 1);
  Tensor<float, 4> same(x.shape()), constant(Shape{1, 3, 4, 2}), larger(Shape{1, 10, 11, 2});
  const Tensor<float, 4> threes = random_tensor(larger.shape(), 1, 3, 3);
  for (std::int64_t i = 0; i < constant.size(); ++i) constant.data()[i] = 3;
  for (const bool align_corners : {false, true}) {
    bilinear_forward(same, x, align_corners, ctx);
    CHECK_CLOSE(same, x, 0.0);
    bilinear_forward(larger, constant, align_corners, ctx);
    CHECK_CLOSE(larger, threes, 0, 10 * kUnit);
  }
}

TEST_CASE("bilinear_forward: outputs too large for the caches are the same as strided ones") {
  Context ctx(2);
  const auto x = random_tensor(Shape{1, 33, 65, 128}, 1);
  Tensor<float, 4> y(Shape{1, 257, 256, 128}), wider(Shape{1, 257, 256, 129});
  for_each_target([&] {
    bilinear_forward(y, x, true, ctx);
    bilinear_forward(wider.view().narrow(3, 1, 129), x, true, ctx);
    for (const std::int64_t row : {0, 100, 256})
      CHECK_SAME_BITS(y[0][row], wider.view().narrow(3, 1, 129)[0][row]);
  });
}

TEST_CASE("bilinear_backward: agrees with the complex step for both conventions, any size") {
  Context ctx(2);
  for (const Resize& r : kResizes) {
    for (const std::int64_t C : {2}) {
      for (const bool align_corners : {false, true}) {
        CAPTURE(r.H);
        CAPTURE(r.Ho);
        CAPTURE(align_corners);
        const auto dy = random_tensor(Shape{std::int64_t{2}, r.Ho, r.Wo, C}, 1);
        Tensor<double, 4> expected(Shape{std::int64_t{2}, r.H, r.W, C});
        double most = 0;  // magnitudes that end up in one pixel
        for (std::int64_t b = 0; b < 2; ++b) {
          const Tensor<float, 3> slice = converted<float>(dy[b]);
          const auto gradient =
              complex_step(Tensor<float, 3>(Shape{r.H, r.W, C}), [&](const auto& x) {
                return weighted_sum(slice, bilinear(x, r.Ho, r.Wo, align_corners));
              });
          std::copy_n(gradient.data(), gradient.size(), expected[b].data());
          most = std::max(most, static_cast<double>(r.Ho * r.Wo) / static_cast<double>(r.H * r.W));
        }
        for_each_target([&] {
          Strided<4> sdy(dy.view()), dx(expected.shape());
          bilinear_backward(dx.view(), sdy.view(), align_corners, ctx);
          // An input pixel has at most (2 ratio + 1) readers a side; each adds two roundings of its
          // weight and one of the sum.
          CHECK_CLOSE(dx.view(), expected, 12 * (4 * most + 4) * kUnit);
          CHECK(dx.gaps_untouched());
        });
      }
    }
  }
}

TEST_CASE("bilinear_backward: is the transpose of the forward pass, wide channels and all") {
  Context ctx(2);
  for_each_target([&] {
    for (const bool align_corners : {false, true}) {
      const auto x = random_tensor(Shape{1, 9, 14, 37}, 1);
      const auto dy = random_tensor(Shape{1, 16, 25, 37}, 2);
      Tensor<float, 4> y(dy.shape()), dx(x.shape());
      bilinear_forward(y, x, align_corners, ctx);
      bilinear_backward(dx, dy, align_corners, ctx);
      double outside = 0, inside = 0;  // <dy, A x> = <A^T dy, x>
      for (std::int64_t i = 0; i < y.size(); ++i)
        outside += static_cast<double>(dy.data()[i]) * y.data()[i];
      for (std::int64_t i = 0; i < x.size(); ++i)
        inside += static_cast<double>(dx.data()[i]) * x.data()[i];
      CHECK(inside == doctest::Approx(outside).epsilon(1e-5));
    }
  });
}

TEST_CASE("bilinear_backward: a border pixel that is both neighbours gets both shares") {
  Context ctx(1);
  Tensor<float, 4> dx(Shape{1, 1, 1, 2}), dy = random_tensor(Shape{1, 3, 4, 2}, 1, 1, 1);
  for_each_target([&] {
    bilinear_backward(dx, dy, false, ctx);
    CHECK(dx(0, 0, 0, 0) == 12);
    CHECK(dx(0, 0, 0, 1) == 12);
  });
}

TEST_CASE("bicubic_antialias_forward: agrees with the definition, shrinking, enlarging and mixed") {
  Context ctx(2);
  for_each_target([&] {
    for (const Resize& r : kResizes) {
      for (const std::int64_t C : {1, 3, 16, 35}) {
        CAPTURE(C);
        const auto x = random_tensor(Shape{r.H, r.W, C}, 1);
        Strided<3> sx(x.view()), y(Shape{r.Ho, r.Wo, C});
        bicubic_antialias_forward(y.view(), sx.view(), ctx);
        // At most 4 * 8 + 2 taps a side whose absolute weights add up to less than 1.5 a pass.
        CHECK_CLOSE(y.view(),
                    reference::resize(in_double(x), r.Ho, r.Wo, reference::bicubic_weight<double>),
                    2 * 34 * 1.5 * 1.5 * kUnit);
        CHECK(y.gaps_untouched());
      }
    }
  });
}

TEST_CASE("interpolate: no output, or an empty input, and mismatched channels") {
  Context ctx(1);
  Tensor<float, 4> none(Shape{0, 4, 4, 3}), some(Shape{1, 4, 4, 3}), empty(Shape{1, 0, 4, 3}),
      two(Shape{1, 4, 4, 2});
  bilinear_forward(none, none, true, ctx);
  bilinear_forward(empty, some, true, ctx);
  CHECK_THROWS_WITH_AS(bilinear_forward(some, empty, true, ctx), doctest::Contains("[1,0,4,3]"),
                       Error);
  CHECK_THROWS_WITH_AS(bilinear_forward(some, two, true, ctx),
                       "bilinear: y is [1,4,4,3] but x is [1,4,4,2]", Error);
  bilinear_backward(none, none, true, ctx);
  CHECK_THROWS_WITH_AS(bilinear_backward(empty, some, true, ctx), doctest::Contains("[1,0,4,3]"),
                       Error);
  CHECK_THROWS_WITH_AS(bilinear_backward(some, two, true, ctx), doctest::Contains("[1,4,4,2]"),
                       Error);
  Tensor<float, 4> unread = random_tensor(some.shape(), 1);
  bilinear_backward(unread, empty, true, ctx);  // no output reads it
  CHECK(unread(0, 3, 3, 2) == 0);
  bicubic_antialias_forward(empty[0], some[0], ctx);
  CHECK_THROWS_WITH_AS(bicubic_antialias_forward(some[0], empty[0], ctx),
                       doctest::Contains("[0,4,3]"), Error);
  CHECK_THROWS_WITH_AS(bicubic_antialias_forward(some[0], two[0], ctx),
                       doctest::Contains("[4,4,2]"), Error);
}

TEST_CASE("interpolate: 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  const auto x = random_tensor(Shape{2, 23, 31, 37}, 1);
  Tensor<float, 4> y1(Shape{2, 41, 54, 37}), y8(y1.shape());
  for (const bool align_corners : {false, true}) {
    bilinear_forward(y1, x, align_corners, one);
    bilinear_forward(y8, x, align_corners, eight);
    CHECK_SAME_BITS(y8, y1);
    Tensor<float, 4> dx1(x.shape()), dx8(x.shape());
    bilinear_backward(dx1, y1, align_corners, one);
    bilinear_backward(dx8, y1, align_corners, eight);
    CHECK_SAME_BITS(dx8, dx1);
  }
  bicubic_antialias_forward(y1[0], x[0], one);
  bicubic_antialias_forward(y8[0], x[0], eight);
  CHECK_SAME_BITS(y8[0], y1[0]);
}
