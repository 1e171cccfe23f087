// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/linear.h"

#include <doctest/doctest.h>

#include "tests/reference/activation.h"
#include "tests/reference/linear.h"
#include "tests/support/compare.h"
#include "tests/support/gradient.h"
#include "tests/support/product.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

struct Case {
  std::int64_t M, N, K;
};

void check(const Case& size, const ProductParts& parts, Context& ctx) {
  CAPTURE(size.M);
  CAPTURE(size.N);
  CAPTURE(size.K);
  const auto x = random_tensor(Shape{size.M, size.K}, 1),
             w = random_tensor(Shape{size.N, size.K}, 2);
  const ProductOperands operands(parts, size.N);
  const auto residual = random_tensor(Shape{size.M, size.N}, 5);
  const auto expected =
      expected_product(reference::linear(in_double(x), in_double(w)),
                       reference::linear(magnitudes(x), magnitudes(w)), size.K, operands, residual);
  Strided<2> sx(x.view()), y(residual.view());
  Epilogue<2> epilogue = operands.epilogue<2>();
  if (parts.residual) epilogue.residual = y.view();  // y may be the residual
  linear_forward(y.view(), sx.view(), pack_linear(w), epilogue, ctx);
  CHECK_CLOSE(y.view(), expected.y, 1.0, expected.limit.view());
  CHECK(y.gaps_untouched());
}

}  // namespace

TEST_CASE("linear_forward: agrees with the definition for odd sizes, below a vector, and no rows") {
  Context ctx(2);
  for_each_target([&] {
    for (const std::int64_t M : {0, 1, 2, 5, 13, 33})
      for (const std::int64_t N : {1, 3, 9, 15, 16, 17, 31, 33, 50})
        for (const std::int64_t K : {1, 2, 7, 24}) check({M, N, K}, {}, ctx);
    check({3, 5, 0}, {.bias = true}, ctx);
  });
}

TEST_CASE("linear_forward: sizes that cross every block, as in the model") {
  Context ctx(2);
  for_each_target([&] {
    for (const Case& size :
         {Case{130, 70, 300}, Case{97, 192, 65}, Case{11, 130, 1100}, Case{260, 33, 48}})
      check(size, {.bias = true}, ctx);
  });
}

TEST_CASE("linear_forward: every combination of bias, activation, gamma and residual") {
  Context ctx(1);
  for_each_target([&] {
    for (int mask = 0; mask < 8; ++mask)
      for (const Activation activation : {Activation::kNone, Activation::kRelu, Activation::kGelu,
                                          Activation::kSilu, Activation::kSigmoid}) {
        CAPTURE(mask);
        CAPTURE(static_cast<int>(activation));
        const ProductParts parts{(mask & 1) != 0, activation, (mask & 2) != 0, (mask & 4) != 0};
        check({9, 37, 20}, parts, ctx);
        check({3, 6, 5}, parts, ctx);
      }
  });
}

TEST_CASE("linear_forward: NaN in a row of x reaches that row of y and no other") {
  Context ctx(1);
  for_each_target([&] {
    auto x = random_tensor(Shape{15, 40}, 1);
    const auto w = random_tensor(Shape{19, 40}, 2);
    x(7, 39) = std::numeric_limits<float>::quiet_NaN();
    Tensor<float, 2> y(Shape{15, 19});
    for (const Activation activation : {Activation::kNone, Activation::kRelu, Activation::kGelu}) {
      linear_forward(y, x, pack_linear(w), {.activation = activation}, ctx);
      for (std::int64_t m = 0; m < 15; ++m)
        for (std::int64_t n = 0; n < 19; ++n) CHECK(std::isnan(y(m, n)) == (m == 7));
    }
  });
}

TEST_CASE("linear_forward: 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  const auto x = random_tensor(Shape{301, 200}, 1), w = random_tensor(Shape{210, 200}, 2);
  const PackedMatrix packed = pack_linear(w);
  Tensor<float, 2> y1(Shape{301, 210}), y8(y1.shape());
  linear_forward(y1, x, packed, {.activation = Activation::kGelu}, one);
  linear_forward(y8, x, packed, {.activation = Activation::kGelu}, eight);
  CHECK_SAME_BITS(y8, y1);
}

TEST_CASE("linear_forward: the same product row by row gives the same bits") {
  Context ctx(2);
  const auto x = random_tensor(Shape{29, 200}, 1), w = random_tensor(Shape{50, 200}, 2);
  const PackedMatrix packed = pack_linear(w);
  for_each_target([&] {
    Tensor<float, 2> whole(Shape{29, 50}), row(Shape{1, 50});
    linear_forward(whole, x, packed, {}, ctx);
    for (std::int64_t m = 0; m < 29; ++m) {
      linear_forward(row, x.view().narrow(0, m, m + 1), packed, {}, ctx);
      CHECK_SAME_BITS(row[0], whole[m]);
    }
  });
}

TEST_CASE("linear_forward: shapes that do not fit are refused by name") {
  Context ctx(1);
  const PackedMatrix w = pack_linear(Tensor<float, 2>(Shape{4, 6}));
  Tensor<float, 2> y(Shape{3, 4}), x(Shape{3, 6}), wrong(Shape{3, 5});
  const Tensor<float, 1> vector(Shape{5});
  CHECK_THROWS_WITH_AS(linear_forward(y, wrong, w, {}, ctx), doctest::Contains("[3,5]"), Error);
  CHECK_THROWS_WITH_AS(linear_forward(wrong, x, w, {}, ctx), doctest::Contains("[3,5]"), Error);
  CHECK_THROWS_WITH_AS(linear_forward(y, x, w, {.bias = vector}, ctx), doctest::Contains("[5]"),
                       Error);
  CHECK_THROWS_WITH_AS(linear_forward(y, x, w, {.gamma = vector}, ctx), doctest::Contains("[5]"),
                       Error);
  CHECK_THROWS_WITH_AS(linear_forward(y, x, w, {.residual = wrong}, ctx),
                       doctest::Contains("[3,5]"), Error);
}

TEST_CASE("linear_backward: agrees with the complex step, strided, parameters accumulate") {
  Context ctx(2);
  struct Size {
    std::int64_t M, K, N;
  };
  for (const Size& size : {Size{1, 1, 1}, Size{5, 12, 10}, Size{7, 3, 19}, Size{2, 33, 2}}) {
    CAPTURE(size.K);
    const auto x = random_tensor(Shape{size.M, size.K}, 1);
    const auto w = random_tensor(Shape{size.N, size.K}, 2);
    const auto dy = random_tensor(Shape{size.M, size.N}, 3);
    const auto dx_expected = complex_step(x, [&](const Tensor<Complex, 2>& v) {
      return weighted_sum(dy, reference::linear(v, in_complex(w)));
    });
    const auto dw_expected = complex_step(w, [&](const Tensor<Complex, 2>& v) {
      return weighted_sum(dy, reference::linear(in_complex(x), v));
    });
    for_each_target([&] {
      Strided<2> sx(x.view()), sdy(dy.view()), dx(x.shape());
      Tensor<float, 2> dw(w.shape());
      Tensor<float, 1> db(Shape{size.N});
      dw(0, 0) = db[0] = 3;
      linear_backward(dx.view(), dw, db, sdy.view(), sx.view(), w, ctx);
      dw(0, 0) -= 3;
      db[0] -= 3;
      // Sums of at most 19 (dx) and 7 products of magnitude below 1; the 3 rounds twice more.
      CHECK_CLOSE(dx.view(), dx_expected, 19 * 19 * kUnit);
      CHECK_CLOSE(dw, dw_expected, 7 * 16 * kUnit);
      for (std::int64_t n = 0; n < size.N; ++n) {
        double sum = 0;
        for (std::int64_t m = 0; m < size.M; ++m) sum += dy(m, n);
        CHECK(std::abs(db[n] - sum) < 7 * 16 * kUnit);
      }
      CHECK(dx.gaps_untouched());
      Strided<2> strided_w(w.view());
      Tensor<float, 2> alone(x.shape());
      linear_backward(alone, {}, {}, sdy.view(), {}, strided_w.view(), ctx);
      CHECK_SAME_BITS(alone, dx.view());
    });
  }
}

TEST_CASE("linear_backward: rows and channels across every block, and wrong shapes") {
  Context ctx(2);
  const auto x = random_tensor(Shape{1000, 310}, 1), w = random_tensor(Shape{170, 310}, 2);
  const auto dy = random_tensor(Shape{1000, 170}, 3);
  Tensor<float, 2> dx(x.shape()), dw(w.shape()), none(Shape{0, 310}), no_dy(Shape{0, 170});
  Tensor<float, 1> db(Shape{170});
  linear_backward(dx, dw, db, dy, x, w, ctx);
  for (const std::int64_t m : {0, 500, 999})
    for (const std::int64_t k : {0, 17, 309}) {
      double sum = 0;
      for (std::int64_t n = 0; n < 170; ++n) sum += static_cast<double>(dy(m, n)) * w(n, k);
      CHECK(std::abs(dx(m, k) - sum) < 1e-4);
    }
  for (const std::int64_t n : {0, 100, 169})
    for (const std::int64_t k : {0, 290, 309}) {
      double sum = 0;
      for (std::int64_t m = 0; m < 1000; ++m) sum += static_cast<double>(dy(m, n)) * x(m, k);
      CHECK(std::abs(dw(n, k) - sum) < 5e-4);
    }
  linear_backward(none, dw, db, no_dy, none, w, ctx);  // no rows
  CHECK_THROWS_WITH_AS(linear_backward(dx, {}, {}, x, {}, w, ctx), doctest::Contains("1000,310"),
                       Error);
}

TEST_CASE("linear_forward: a weight packed for one call gives the same bits, strided too") {
  Context ctx(2);
  const auto x = random_tensor(Shape{23, 70}, 1), w = random_tensor(Shape{37, 70}, 2);
  for_each_target([&] {
    Tensor<float, 2> y(Shape{23, 37}), packed(y.shape());
    Strided<2> strided(w.view());
    linear_forward(y, x, View<const float, 2>(strided.view()), {}, ctx);
    linear_forward(packed, x, pack_linear(w), {}, ctx);
    CHECK_SAME_BITS(y, packed);
  });
}
