// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/conv_transpose2d.h"

#include <doctest/doctest.h>

#include "tests/reference/conv_transpose2d.h"
#include "tests/support/compare.h"
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
