// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/loss.h"

#include <doctest/doctest.h>

#include <cmath>
#include <functional>
#include <limits>
#include <string>

#include "tests/reference/loss.h"
#include "tests/support/compare.h"
#include "tests/support/golden.h"
#include "tests/support/gradient.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

using Map = View<const float, 4>;
using Mask = View<const float, 3>;

struct Loss {
  std::string name;
  std::function<double(Map a, Map b, Mask, Context&)> forward;
  std::function<void(View<float, 4> da, double dloss, Map a, Map b, Mask, Context&)> backward;
  std::function<double(const Tensor<double, 4>&, const Tensor<double, 4>&,
                       const Tensor<double, 3>&)>
      reference;
  std::function<Complex(const Tensor<Complex, 4>&, const Tensor<Complex, 4>&,
                        const Tensor<Complex, 3>&)>
      complex_reference;
};

Loss cosine(CosineAxis axis) {
  const int number = axis == CosineAxis::kChannels ? 3 : 2;
  return {
      number == 3 ? "cosine over channels" : "cosine over the width",
      [=](Map a, Map b, Mask m, Context& ctx) { return cosine_loss_forward(a, b, m, axis, ctx); },
      [=](View<float, 4> da, double dloss, Map a, Map b, Mask m, Context& ctx) {
        cosine_loss_backward(da, dloss, a, b, m, axis, ctx);
      },
      [=](const auto& a, const auto& b, const auto& m) {
        return reference::cosine_loss(a, b, m, number);
      },
      [=](const auto& a, const auto& b, const auto& m) {
        return reference::cosine_loss(a, b, m, number);
      }};
}

std::vector<Loss> losses() {
  return {{"l1", l1_loss_forward, l1_loss_backward, reference::l1_loss<double>,
           reference::l1_loss<Complex>},
          {"mse", mse_loss_forward, mse_loss_backward, reference::mse_loss<double>,
           reference::mse_loss<Complex>},
          cosine(CosineAxis::kChannels),
          cosine(CosineAxis::kWidth)};
}

struct Batch {
  Tensor<float, 4> a, b;
  Tensor<float, 3> mask;
  explicit Batch(Shape<4> shape)
      : a(random_tensor(shape, 1)),
        b(random_tensor(shape, 2)),
        mask(random_tensor(Shape{shape[0], shape[1], shape[2]}, 3)) {
    // Holes, labelled pixels and, for the arithmetic, a mask of neither.
    for (std::int64_t i = 0; i < mask.size(); ++i)
      mask.data()[i] = mask.data()[i] < -0.5f ? 0.0f : mask.data()[i] < 0.8f ? 1.0f : 0.5f;
  }
};

Tensor<float, 3> ones(const Tensor<float, 3>& like) { return random_tensor(like.shape(), 1, 1, 1); }

constexpr Shape<4> kShapes[] = {{2, 3, 5, 3}, {1, 1, 1, 1}, {1, 2, 1, 6}, {2, 4, 7, 1}};

}  // namespace

TEST_CASE("losses: value and gradient agree with the definition, with and without a mask") {
  Context ctx(2);
  for (const Loss& loss : losses()) {
    for (const Shape<4>& shape : kShapes) {
      CAPTURE(loss.name);
      CAPTURE(shape);
      const Batch batch(shape);
      for (const bool masked : {true, false}) {
        const Tensor<float, 3> mask = masked ? batch.mask.clone() : ones(batch.mask);
        const Mask given = masked ? Mask(mask) : Mask();
        Strided<4> a(batch.a.view()), b(batch.b.view()), da(shape);
        const double expected =
            loss.reference(in_double(batch.a), in_double(batch.b), in_double(mask));
        CHECK(loss.forward(a.view(), b.view(), given, ctx) ==
              doctest::Approx(expected).epsilon(1e-14));
        const auto gradient = complex_step(batch.a, [&](const Tensor<Complex, 4>& v) {
          return loss.complex_reference(v, in_complex(batch.b), in_complex(mask));
        });
        loss.backward(da.view(), 1, a.view(), b.view(), given, ctx);
        CHECK_CLOSE(da.view(), gradient, 1e-9, kUnit);  // rounded once, to float
        CHECK(da.gaps_untouched());
        // Twice the weight is twice the gradient, and nothing accumulates.
        Tensor<float, 4> twice(shape);
        loss.backward(twice, 2, a.view(), b.view(), given, ctx);
        for (std::int64_t i = 0; i < twice.size(); ++i) twice.data()[i] /= 2;
        CHECK_SAME_BITS(twice, da.view());
      }
    }
  }
}

TEST_CASE("losses: levels of a batch are slices of wider tensors") {
  Context ctx(1);
  const auto features = random_tensor(Shape{2, 3, 4, 5, 3}, 1);  // [B, levels, H, W, C]
  const auto predicted = random_tensor(Shape{2, 4, 5, 3}, 2);
  const View<const float, 4> level(features.data() + 60, Shape{2, 4, 5, 3}, {180, 15, 3, 1});
  const Tensor<float, 4> copy = converted<float>(level);
  for (const Loss& loss : losses())
    CHECK(loss.forward(predicted, level, {}, ctx) == loss.forward(predicted, copy, {}, ctx));
}

TEST_CASE("losses D23: a mask without a labelled pixel gives a defined value and no gradient") {
  Context ctx(1);
  Batch batch({2, 3, 4, 3});
  // What stands in a hole does not matter, not even that it is no number.
  batch.b(0, 1, 1, 1) = std::numeric_limits<float>::quiet_NaN();
  batch.a(0, 1, 2, 1) = std::numeric_limits<float>::infinity();
  const Tensor<float, 3> holes(batch.mask.shape());
  for (const Loss& loss : losses()) {
    CAPTURE(loss.name);
    const bool is_cosine = loss.name.starts_with("cosine");
    CHECK(loss.forward(batch.a, batch.b, holes, ctx) == (is_cosine ? 1 : 0));
    Tensor<float, 4> da = random_tensor(batch.a.shape(), 5);
    loss.backward(da, 1, batch.a, batch.b, holes, ctx);
    for (std::int64_t i = 0; i < da.size(); ++i) CHECK(da.data()[i] == 0);
  }
}

TEST_CASE("losses D26: NaN at a labelled pixel is seen in the value and in the gradient") {
  Context ctx(1);
  for (const Loss& loss : losses()) {
    CAPTURE(loss.name);
    Batch batch({1, 2, 4, 3});
    batch.mask = ones(batch.mask);
    batch.a(0, 1, 2, 1) = std::numeric_limits<float>::quiet_NaN();
    CHECK(std::isnan(loss.forward(batch.a, batch.b, batch.mask, ctx)));
    Tensor<float, 4> da(batch.a.shape());
    loss.backward(da, 1, batch.a, batch.b, batch.mask, ctx);
    CHECK(std::isnan(da(0, 1, 2, 1)));
    CHECK_FALSE(std::isnan(da(0, 0, 2, 1)));
  }
}

TEST_CASE("cosine_loss D33: a zero vector on either side has cosine 0 and gradient 0") {
  Context ctx(1);
  for (const CosineAxis axis : {CosineAxis::kChannels, CosineAxis::kWidth}) {
    for (const float length : {0.0f, 1e-9f, 1e-30f}) {
      for (const bool target : {false, true}) {
        auto a = random_tensor(Shape{1, 1, 4, 3}, 1), b = random_tensor(Shape{1, 1, 4, 3}, 2);
        Tensor<float, 4>& zero = target ? b : a;
        for (std::int64_t i = 0; i < zero.size(); ++i) zero.data()[i] *= length;
        Tensor<float, 4> da = random_tensor(a.shape(), 3);
        CHECK(cosine_loss_forward(a, b, {}, axis, ctx) == 1);
        cosine_loss_backward(da, 1, a, b, {}, axis, ctx);
        for (std::int64_t i = 0; i < da.size(); ++i) CHECK(da.data()[i] == 0);
      }
    }
  }
}

TEST_CASE("cosine_loss: short and long vectors have a direction too") {
  Context ctx(1);
  for (const float length : {1e-6f, 1.0f, 1e18f, 1e30f}) {
    auto a = random_tensor(Shape{1, 2, 3, 3}, 1);
    const auto b = random_tensor(a.shape(), 2);
    const double expected = reference::cosine_loss(
        in_double(a), in_double(b), in_double(random_tensor(Shape{1, 2, 3}, 1, 1, 1)), 3);
    for (std::int64_t i = 0; i < a.size(); ++i) a.data()[i] *= length;
    CHECK(cosine_loss_forward(a, b, {}, CosineAxis::kChannels, ctx) ==
          doctest::Approx(expected).epsilon(1e-6));
  }
}

TEST_CASE("l1_loss: equal values have gradient 0") {
  Context ctx(1);
  const auto a = random_tensor(Shape{1, 2, 3, 3}, 1);
  Tensor<float, 4> da = random_tensor(a.shape(), 2);
  l1_loss_backward(da, 1, a, a, {}, ctx);
  for (std::int64_t i = 0; i < da.size(); ++i) CHECK(da.data()[i] == 0);
}

TEST_CASE("losses: 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  const Batch batch({2, 61, 83, 6});
  for (const Loss& loss : losses()) {
    CHECK(loss.forward(batch.a, batch.b, batch.mask, one) ==
          loss.forward(batch.a, batch.b, batch.mask, eight));
    Tensor<float, 4> da1(batch.a.shape()), da8(batch.a.shape());
    loss.backward(da1, 1, batch.a, batch.b, batch.mask, one);
    loss.backward(da8, 1, batch.a, batch.b, batch.mask, eight);
    CHECK_SAME_BITS(da8, da1);
  }
}

TEST_CASE("losses: shapes that do not fit, and nothing to average, are refused by name") {
  Context ctx(1);
  Tensor<float, 4> a(Shape{1, 2, 3, 4}), b(Shape{1, 2, 3, 3}), none(Shape{0, 2, 3, 4});
  const Tensor<float, 3> mask(Shape{1, 2, 4});
  for (const Loss& loss : losses()) {
    CHECK_THROWS_WITH_AS(loss.forward(a, b, {}, ctx), doctest::Contains("[1,2,3,3]"), Error);
    CHECK_THROWS_WITH_AS(loss.forward(a, a, mask, ctx), doctest::Contains("[1,2,4]"), Error);
    CHECK_THROWS_WITH_AS(loss.backward(b, 1, a, a, {}, ctx), doctest::Contains("[1,2,3,3]"), Error);
    CHECK_THROWS_WITH_AS(loss.forward(none, none, {}, ctx), doctest::Contains("empty"), Error);
  }
}
