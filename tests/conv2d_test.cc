// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/conv2d.h"

#include <doctest/doctest.h>

#include <limits>

#include "tests/reference/conv2d.h"
#include "tests/support/compare.h"
#include "tests/support/product.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

struct Kernel {
  std::int64_t k, stride, padding;
};
// All that the model uses.
constexpr Kernel kKernels[] = {{1, 1, 0}, {3, 1, 1}, {3, 2, 1}, {2, 2, 0}, {14, 14, 0}};

struct Size {
  std::int64_t B, H, W, Cin, Cout;
};

void check(const Kernel& kernel, const Size& size, const ProductParts& parts, Context& ctx) {
  CAPTURE(kernel.k);
  CAPTURE(kernel.stride);
  CAPTURE(size.H);
  CAPTURE(size.W);
  CAPTURE(size.Cin);
  CAPTURE(size.Cout);
  const auto x = random_tensor(Shape{size.B, size.H, size.W, size.Cin}, 1);
  const auto w = random_tensor(Shape{size.Cout, size.Cin, kernel.k, kernel.k}, 2);
  auto sum = reference::conv2d(in_double(x), in_double(w), kernel.stride, kernel.padding);
  const auto size_of_sum =
      reference::conv2d(magnitudes(x), magnitudes(w), kernel.stride, kernel.padding);
  CHECK(sum.extent(1) == conv2d_extent(size.H, kernel.k, kernel.stride, kernel.padding));
  const ProductOperands operands(parts, size.Cout);
  const auto residual = random_tensor(sum.shape(), 5);
  const auto expected = expected_product(std::move(sum), size_of_sum,
                                         size.Cin * kernel.k * kernel.k, operands, residual);
  Strided<4> sx(x.view()), y(residual.view());
  Epilogue<4> epilogue = operands.epilogue<4>();
  if (parts.residual) epilogue.residual = y.view();  // y may be the residual
  conv2d_forward(y.view(), sx.view(), pack_conv2d(w, kernel.stride, kernel.padding), epilogue, ctx);
  CHECK_CLOSE(y.view(), expected.y, 1.0, expected.limit.view());
  CHECK(y.gaps_untouched());
}

}  // namespace

TEST_CASE(
    "conv2d_forward: agrees with the definition for every kernel of the model and odd sizes") {
  Context ctx(2);
  for_each_target([&] {
    for (const Kernel& kernel : kKernels) {
      const std::int64_t unit = kernel.k == 14 ? 14 : 1;
      for (const Size& size : {Size{1, 1, 1, 4, 3}, Size{2, 7, 9, 5, 6}, Size{2, 6, 8, 3, 17},
                               Size{1, 2, 5, 16, 16}, Size{3, 3, 4, 19, 33}, Size{1, 5, 1, 1, 1}}) {
        if (unit == 1 &&
            (size.H < kernel.k - 2 * kernel.padding || size.W < kernel.k - 2 * kernel.padding))
          continue;
        check(kernel, {size.B, size.H * unit, size.W * unit, size.Cin, size.Cout}, {.bias = true},
              ctx);
      }
    }
  });
}

TEST_CASE("conv2d_forward: maps that cross every block") {
  Context ctx(2);
  for_each_target([&] {
    check({3, 1, 1}, {1, 13, 37, 70, 40}, {.activation = Activation::kRelu}, ctx);
    check({3, 2, 1}, {2, 21, 37, 33, 20}, {}, ctx);
    check({1, 1, 0}, {1, 21, 37, 130, 50}, {.bias = true, .residual = true}, ctx);
  });
}

TEST_CASE("conv2d_forward: every combination of bias, activation, gamma and residual") {
  Context ctx(1);
  for_each_target([&] {
    for (int mask = 0; mask < 8; ++mask)
      for (const Activation activation :
           {Activation::kNone, Activation::kRelu, Activation::kGelu, Activation::kSigmoid})
        check({3, 1, 1}, {1, 4, 5, 6, 21},
              {(mask & 1) != 0, activation, (mask & 2) != 0, (mask & 4) != 0}, ctx);
  });
}

TEST_CASE("conv2d_forward: y may be a slice of a concatenated map, x a crop") {
  Context ctx(2);
  const auto wide = random_tensor(Shape{2, 9, 11, 8}, 1), w = random_tensor(Shape{5, 3, 3, 3}, 2);
  const View<const float, 4> x = wide.view().narrow(1, 1, 8).narrow(2, 2, 9).narrow(3, 4, 7);
  Tensor<float, 4> joined(Shape{2, 7, 7, 12}), alone(Shape{2, 7, 7, 5});
  const Tensor<float, 4> crop = converted<float>(x);
  const PackedConv2d packed = pack_conv2d(w, 1, 1);
  for_each_target([&] {
    conv2d_forward(joined.view().narrow(3, 4, 9), x, packed, {}, ctx);
    conv2d_forward(alone, crop, packed, {}, ctx);
    CHECK_SAME_BITS(joined.view().narrow(3, 4, 9), alone);
    for (const std::int64_t c : {0, 3, 9, 11}) CHECK(joined(1, 6, 6, c) == 0);
  });
}

TEST_CASE("conv2d_forward: weights packed for one call give the same bits as packed ones") {
  Context ctx(2);
  for_each_target([&] {
    for (const Kernel& kernel :
         {Kernel{3, 1, 1}, Kernel{3, 2, 1}, Kernel{2, 2, 0}, Kernel{1, 1, 0}}) {
      const auto x = random_tensor(Shape{1, 8, 10, 19}, 1);
      const auto w =
          random_tensor(Shape{std::int64_t{37}, std::int64_t{19}, kernel.k, kernel.k}, 2);
      const auto bias = random_tensor(Shape{37}, 3);
      Tensor<float, 4> y(
          Shape{std::int64_t{1}, conv2d_extent(8, kernel.k, kernel.stride, kernel.padding),
                conv2d_extent(10, kernel.k, kernel.stride, kernel.padding), std::int64_t{37}});
      Tensor<float, 4> packed(y.shape());
      conv2d_forward(y, x, w, kernel.stride, kernel.padding, {.bias = bias}, ctx);
      conv2d_forward(packed, x, pack_conv2d(w, kernel.stride, kernel.padding), {.bias = bias}, ctx);
      CHECK_SAME_BITS(y, packed);
    }
  });
  Tensor<float, 4> x(Shape{1, 6, 7, 3}), y(Shape{1, 6, 7, 5});
  CHECK_THROWS_WITH_AS(
      conv2d_forward(y, x, Tensor<float, 4>(Shape{5, 3, 3, 2}).view(), 1, 1, {}, ctx),
      doctest::Contains("square"), Error);
}

TEST_CASE("conv2d_forward: NaN in a pixel reaches the pixels around it and no other") {
  Context ctx(1);
  for_each_target([&] {
    auto x = random_tensor(Shape{1, 6, 7, 3}, 1);
    x(0, 2, 3, 1) = std::numeric_limits<float>::quiet_NaN();
    Tensor<float, 4> y(Shape{1, 6, 7, 5});
    conv2d_forward(y, x, pack_conv2d(random_tensor(Shape{5, 3, 3, 3}, 2), 1, 1), {}, ctx);
    for (std::int64_t i = 0; i < 6; ++i)
      for (std::int64_t j = 0; j < 7; ++j)
        CHECK(std::isnan(y(0, i, j, 0)) == (i >= 1 && i <= 3 && j >= 2 && j <= 4));
  });
}

TEST_CASE("conv2d_forward: no images") {
  Context ctx(1);
  Tensor<float, 4> x(Shape{0, 6, 7, 3}), y(Shape{0, 6, 7, 5});
  conv2d_forward(y, x, pack_conv2d(Tensor<float, 4>(Shape{5, 3, 3, 3}), 1, 1), {}, ctx);
}

TEST_CASE("conv2d_forward: 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  const auto x = random_tensor(Shape{2, 23, 31, 20}, 1);
  for (const Kernel& kernel : {Kernel{3, 1, 1}, Kernel{3, 2, 1}, Kernel{1, 1, 0}}) {
    const PackedConv2d w =
        pack_conv2d(random_tensor(Shape{std::int64_t{37}, std::int64_t{20}, kernel.k, kernel.k}, 2),
                    kernel.stride, kernel.padding);
    Tensor<float, 4> y1(
        Shape{std::int64_t{2}, conv2d_extent(23, kernel.k, kernel.stride, kernel.padding),
              conv2d_extent(31, kernel.k, kernel.stride, kernel.padding), std::int64_t{37}});
    Tensor<float, 4> y8(y1.shape());
    conv2d_forward(y1, x, w, {}, one);
    conv2d_forward(y8, x, w, {}, eight);
    CHECK_SAME_BITS(y8, y1);
  }
}

TEST_CASE("conv2d_forward: shapes that do not fit are refused by name") {
  Context ctx(1);
  const PackedConv2d w = pack_conv2d(Tensor<float, 4>(Shape{5, 3, 3, 3}), 1, 1);
  Tensor<float, 4> x(Shape{1, 6, 7, 3}), y(Shape{1, 6, 7, 5}), narrow(Shape{1, 6, 6, 5}),
      channels(Shape{1, 6, 7, 4});
  CHECK_THROWS_WITH_AS(conv2d_forward(narrow, x, w, {}, ctx), doctest::Contains("[1,6,6,5]"),
                       Error);
  CHECK_THROWS_WITH_AS(conv2d_forward(y, channels, w, {}, ctx), doctest::Contains("[1,6,7,4]"),
                       Error);
  CHECK_THROWS_WITH_AS(conv2d_forward(y, x, w, {.residual = narrow}, ctx),
                       doctest::Contains("[1,6,6,5]"), Error);
  CHECK_THROWS_AS(pack_conv2d(Tensor<float, 4>(Shape{5, 3, 3, 2}), 1, 1), Error);
}
