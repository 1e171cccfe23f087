// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/conv_transpose2d.h"

#include <doctest/doctest.h>

#include "tests/reference/conv_transpose2d.h"
#include "tests/support/compare.h"
#include "tests/support/gradient.h"
#include "tests/support/product.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

TEST_CASE(
    "conv_transpose2d_forward: agrees with the definition for k = 2 and 4, odd sizes, strided") {
  Context ctx(2);
  struct Size {
    std::int64_t B, H, W, Cin, Cout;
  };
  for_each_target([&] {
    for (const std::int64_t k : {2, 4})
      for (const Size& size : {Size{1, 1, 1, 1, 1}, Size{2, 3, 5, 6, 4}, Size{1, 5, 4, 17, 19},
                               Size{1, 21, 3, 40, 33}, Size{0, 3, 5, 6, 4}}) {
        for (const bool with_bias : {false, true}) {
          CAPTURE(k);
          CAPTURE(size.Cin);
          CAPTURE(size.Cout);
          const auto x = random_tensor(Shape{size.B, size.H, size.W, size.Cin}, 1);
          const auto w = random_tensor(Shape{size.Cin, size.Cout, k, k}, 2);
          const ProductOperands operands({.bias = with_bias}, size.Cout);
          const auto expected =
              expected_product(reference::conv_transpose2d(in_double(x), in_double(w)),
                               reference::conv_transpose2d(magnitudes(x), magnitudes(w)), size.Cin,
                               operands, Tensor<float, 4>());
          Strided<4> sx(x.view()), y(expected.y.shape());
          conv_transpose2d_forward(y.view(), sx.view(), pack_conv_transpose2d(w),
                                   operands.epilogue<4>().bias, ctx);
          CHECK_CLOSE(y.view(), expected.y, 1.0, expected.limit.view());
          CHECK(y.gaps_untouched());
        }
      }
  });
}

TEST_CASE("conv_transpose2d_backward: agrees with the complex step, k = 2 and 4, strided") {
  Context ctx(2);
  struct Size {
    std::int64_t B, H, W, Cin, Cout;
  };
  for (const std::int64_t k : {2, 4}) {
    for (const Size& size : {Size{1, 1, 1, 1, 1}, Size{2, 3, 2, 3, 4}, Size{1, 2, 3, 9, 2}}) {
      CAPTURE(k);
      CAPTURE(size.Cin);
      const auto x = random_tensor(Shape{size.B, size.H, size.W, size.Cin}, 1);
      const auto w = random_tensor(Shape{size.Cin, size.Cout, k, k}, 2);
      const auto dy = random_tensor(Shape{size.B, k * size.H, k * size.W, size.Cout}, 3);
      const auto dx_expected = complex_step(x, [&](const Tensor<Complex, 4>& v) {
        return weighted_sum(dy, reference::conv_transpose2d(v, in_complex(w)));
      });
      const auto dw_expected = complex_step(w, [&](const Tensor<Complex, 4>& v) {
        return weighted_sum(dy, reference::conv_transpose2d(in_complex(x), v));
      });
      Tensor<double, 1> db_expected(Shape{size.Cout});
      for (std::int64_t i = 0; i < dy.size(); ++i) db_expected[i % size.Cout] += dy.data()[i];
      for_each_target([&] {
        Strided<4> sx(x.view()), sdy(dy.view()), dx(x.shape());
        Tensor<float, 4> dw(w.shape());
        Tensor<float, 1> db(Shape{size.Cout});
        dw(0, 0, 1, 0) = db[0] = 3;  // accumulate
        conv_transpose2d_backward(dx.view(), dw, db, sdy.view(), sx.view(), w, ctx);
        dw(0, 0, 1, 0) -= 3;
        db[0] -= 3;
        // Sums of at most 64 (dx), 12 (dweight) and 192 products of magnitude below 1.
        CHECK_CLOSE(dx.view(), dx_expected, 64 * 64 * kUnit);
        CHECK_CLOSE(dw, dw_expected, 16 * 16 * kUnit);
        CHECK_CLOSE(db, db_expected, 192 * 16 * kUnit);
        CHECK(dx.gaps_untouched());
        Tensor<float, 4> alone_dx(x.shape()), alone_dw(w.shape());
        conv_transpose2d_backward(alone_dx, {}, {}, sdy.view(), {}, w, ctx);
        conv_transpose2d_backward({}, alone_dw, {}, sdy.view(), sx.view(), w, ctx);
        CHECK_SAME_BITS(alone_dx, dx.view());
        CHECK_CLOSE(alone_dw, dw, 4 * kUnit);
      });
    }
  }
}

TEST_CASE("conv_transpose2d_backward: many channels are the transpose of the forward pass") {
  Context ctx(2), one(1), eight(8);
  for_each_target([&] {
    for (const std::int64_t k : {2, 4}) {
      const auto x = random_tensor(Shape{1, 9, 14, 37}, 1);
      const auto w = random_tensor(Shape{std::int64_t{37}, std::int64_t{19}, k, k}, 2);
      const auto dy = random_tensor(Shape{std::int64_t{1}, 9 * k, 14 * k, std::int64_t{19}}, 3);
      Tensor<float, 4> y(dy.shape()), dx(x.shape()), dw(w.shape()), dx1(x.shape()), dw1(w.shape());
      Tensor<float, 1> db(Shape{19}), db1(Shape{19});
      conv_transpose2d_forward(y, x, pack_conv_transpose2d(w), {}, ctx);
      conv_transpose2d_backward(dx, dw, db, dy, x, w, eight);
      conv_transpose2d_backward(dx1, dw1, db1, dy, x, w, one);
      // <dy, f(x, w)> is linear in x and in w.
      double loss = 0, by_x = 0, by_w = 0;
      for (std::int64_t i = 0; i < y.size(); ++i)
        loss += static_cast<double>(dy.data()[i]) * y.data()[i];
      for (std::int64_t i = 0; i < x.size(); ++i)
        by_x += static_cast<double>(dx.data()[i]) * x.data()[i];
      for (std::int64_t i = 0; i < w.size(); ++i)
        by_w += static_cast<double>(dw.data()[i]) * w.data()[i];
      CHECK(by_x == doctest::Approx(loss).epsilon(1e-5));
      CHECK(by_w == doctest::Approx(loss).epsilon(1e-5));
      CHECK_SAME_BITS(dx, dx1);
      CHECK_SAME_BITS(dw, dw1);
      CHECK_SAME_BITS(db, db1);
    }
  });
}

TEST_CASE("conv_transpose2d_backward: shapes that do not fit are refused by name") {
  Context ctx(1);
  const Tensor<float, 4> w(Shape{6, 4, 2, 2});
  Tensor<float, 4> x(Shape{1, 3, 5, 6}), dy(Shape{1, 6, 10, 4}), wrong(Shape{1, 6, 9, 4}),
      other(Shape{6, 4, 2, 3});
  Tensor<float, 1> bias(Shape{6});
  CHECK_THROWS_WITH_AS(conv_transpose2d_backward(x, {}, {}, wrong, {}, w, ctx),
                       doctest::Contains("[1,6,9,4]"), Error);
  CHECK_THROWS_WITH_AS(conv_transpose2d_backward({}, other, {}, dy, x, w, ctx),
                       doctest::Contains("[6,4,2,3]"), Error);
  CHECK_THROWS_WITH_AS(conv_transpose2d_backward({}, {}, bias, dy, x, w, ctx),
                       doctest::Contains("[6]"), Error);
  CHECK_THROWS_WITH_AS(conv_transpose2d_backward(x, {}, {}, dy, {}, other, ctx),
                       doctest::Contains("square"), Error);
}

TEST_CASE("conv_transpose2d_forward: weights packed for one call give the same bits") {
  Context ctx(2);
  for_each_target([&] {
    for (const std::int64_t k : {2, 4}) {
      const auto x = random_tensor(Shape{1, 5, 6, 19}, 1);
      const auto w = random_tensor(Shape{std::int64_t{19}, std::int64_t{21}, k, k}, 2);
      const auto bias = random_tensor(Shape{21}, 3);
      Tensor<float, 4> y(Shape{std::int64_t{1}, 5 * k, 6 * k, std::int64_t{21}}), packed(y.shape());
      conv_transpose2d_forward(y, x, w, bias, ctx);
      conv_transpose2d_forward(packed, x, pack_conv_transpose2d(w), bias, ctx);
      CHECK_SAME_BITS(y, packed);
    }
  });
}

TEST_CASE("conv_transpose2d_forward: 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  const auto x = random_tensor(Shape{1, 21, 37, 48}, 1);
  const PackedConvTranspose2d w = pack_conv_transpose2d(random_tensor(Shape{48, 24, 2, 2}, 2));
  Tensor<float, 4> y1(Shape{1, 42, 74, 24}), y8(y1.shape());
  conv_transpose2d_forward(y1, x, w, {}, one);
  conv_transpose2d_forward(y8, x, w, {}, eight);
  CHECK_SAME_BITS(y8, y1);
}

TEST_CASE("conv_transpose2d_forward: shapes that do not fit are refused by name") {
  Context ctx(1);
  const PackedConvTranspose2d w = pack_conv_transpose2d(Tensor<float, 4>(Shape{6, 4, 2, 2}));
  Tensor<float, 4> x(Shape{1, 3, 5, 6}), y(Shape{1, 6, 10, 4}), wrong(Shape{1, 6, 9, 4}),
      channels(Shape{1, 3, 5, 5});
  CHECK_THROWS_WITH_AS(conv_transpose2d_forward(wrong, x, w, {}, ctx),
                       doctest::Contains("[1,6,9,4]"), Error);
  CHECK_THROWS_WITH_AS(conv_transpose2d_forward(y, channels, w, {}, ctx),
                       doctest::Contains("[1,3,5,5]"), Error);
  CHECK_THROWS_AS(pack_conv_transpose2d(Tensor<float, 4>(Shape{6, 4, 2, 3})), Error);
  CHECK_THROWS_WITH_AS(conv_transpose2d_forward(y, x, w, Tensor<float, 1>(Shape{5}), ctx),
                       doctest::Contains("[5]"), Error);
}
