// SPDX-License-Identifier: Apache-2.0
#include "kernels/winograd.h"

#include <doctest/doctest.h>

#include <cmath>

#include "lvggt/kernels/conv2d.h"
#include "tests/reference/conv2d.h"
#include "tests/support/compare.h"
#include "tests/support/product.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

struct Size {
  std::int64_t B, H, W, Cin, Cout;
};

// Against the definition in double, relative to the root mean square of the result: sums of
// transformed values lose a little more than sums of the values themselves.
void check(const Size& size, const ProductParts& parts, Storage storage, Context& ctx) {
  CAPTURE(size.H);
  CAPTURE(size.W);
  CAPTURE(size.Cin);
  CAPTURE(size.Cout);
  const auto x = random_tensor(Shape{size.B, size.H, size.W, size.Cin}, 1);
  // Multiples of 1/64 below 1 are the same in bf16 and f16.
  auto w = random_tensor(Shape{size.Cout, size.Cin, std::int64_t{3}, std::int64_t{3}}, 2);
  for (std::int64_t i = 0; i < w.size(); ++i) w.data()[i] = std::round(w.data()[i] * 64) / 64;
  auto sum = reference::conv2d(in_double(x), in_double(w), 1, 1);
  auto size_of_sum = reference::conv2d(magnitudes(x), magnitudes(w), 1, 1);
  const ProductOperands operands(parts, size.Cout);
  const auto residual = random_tensor(sum.shape(), 5);
  const auto expected =
      expected_product(std::move(sum), size_of_sum, size.Cin * 9, operands, residual);
  Strided<4> sx(x.view()), y(residual.view());
  Epilogue<4> epilogue = operands.epilogue<4>();
  if (parts.residual) epilogue.residual = y.view();
  const PackedConv2d packed = pack_conv2d(w, 1, 1, storage);
  kernels::run_winograd(y.view(), sx.view(), packed.matrix, epilogue, ctx);
  CHECK_CLOSE(y.view(), expected.y, 4.0, expected.limit.view());
  CHECK(y.gaps_untouched());
}

}  // namespace

TEST_CASE("winograd: agrees with the definition for odd sizes and channels") {
  Context ctx(2);
  for_each_target([&] {
    for (const Size& size : {Size{1, 1, 1, 1, 1}, Size{1, 2, 2, 16, 16}, Size{2, 5, 7, 19, 33},
                             Size{1, 7, 4, 48, 50}, Size{1, 9, 11, 300, 17}})
      check(size, {.bias = true}, Storage::kF32, ctx);
  });
}

TEST_CASE("winograd: every part of the epilogue, and narrow weights") {
  Context ctx(2);
  for_each_target([&] {
    check({1, 6, 5, 20, 40}, {true, Activation::kRelu, true, true}, Storage::kF32, ctx);
    check({1, 6, 5, 20, 40}, {.residual = true}, Storage::kBf16, ctx);
    check({1, 6, 5, 20, 40}, {.activation = Activation::kGelu}, Storage::kF16, ctx);
  });
}

TEST_CASE("winograd: the largest error stays below 1e-5 of the largest value") {
  Context ctx(2);
  const auto x = random_tensor(Shape{1, 12, 14, 256}, 1),
             w = random_tensor(Shape{32, 256, 3, 3}, 2);
  const auto expected = reference::conv2d(in_double(x), in_double(w), 1, 1);
  for_each_target([&] {
    Tensor<float, 4> y(Shape{1, 12, 14, 32});
    kernels::run_winograd(y, x, pack_conv2d(w, 1, 1).matrix, {}, ctx);
    double largest = 0, error = 0;
    for (std::int64_t i = 0; i < y.size(); ++i) {
      largest = std::max(largest, std::abs(expected.data()[i]));
      error = std::max(error, std::abs(y.data()[i] - expected.data()[i]));
    }
    CHECK(error <= 1e-5 * largest);
  });
}

TEST_CASE("winograd: the same bits for any thread count and any place in a batch") {
  const auto x = random_tensor(Shape{3, 20, 22, 70}, 1), w = random_tensor(Shape{40, 70, 3, 3}, 2);
  const PackedConv2d packed = pack_conv2d(w, 1, 1);
  Context one(1), eight(8);
  Tensor<float, 4> y1(Shape{3, 20, 22, 40}), y8(Shape{3, 20, 22, 40}), alone(Shape{1, 20, 22, 40});
  kernels::run_winograd(y1, x, packed.matrix, {}, one);
  kernels::run_winograd(y8, x, packed.matrix, {}, eight);
  CHECK_SAME_BITS(y1, y8);
  kernels::run_winograd(alone, x.view().narrow(0, 1, 2), packed.matrix, {}, eight);
  CHECK_SAME_BITS(y1.view().narrow(0, 1, 2), alone);
}

TEST_CASE("winograd: conv2d takes it for wide 3x3 convolutions of large maps alone") {
  const kernels::ConvGeometry same{64, 3, 1, 1};
  CHECK(kernels::winograd_pays(Shape{1, 40, 40, 64}, same, 64));
  CHECK_FALSE(kernels::winograd_pays(Shape{1, 40, 40, 64}, {64, 3, 2, 1}, 64));
  CHECK_FALSE(kernels::winograd_pays(Shape{1, 40, 40, 64}, {64, 1, 1, 0}, 64));
  CHECK_FALSE(kernels::winograd_pays(Shape{1, 40, 40, 64}, {64, 3, 1, 0}, 64));
  CHECK_FALSE(kernels::winograd_pays(Shape{1, 40, 40, 64}, same, 3));
  // Not decided by the batch: a picture gives the same bits alone.
  CHECK_FALSE(kernels::winograd_pays(Shape{64, 8, 8, 64}, same, 64));
}
