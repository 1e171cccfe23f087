// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>

#include "lvggt/train/attention.h"
#include "tests/reference/masked_attention.h"
#include "tests/support/compare.h"
#include "tests/support/golden.h"
#include "tests/support/gradient.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

struct Operands {
  Tensor<float, 3> q, k, v, dy;
  Operands(std::int64_t Nq, std::int64_t Nk, std::int64_t heads, std::int64_t D)
      : q(random_tensor(Shape{Nq, heads, D}, 1, -2, 2)),
        k(random_tensor(Shape{Nk, heads, D}, 2, -2, 2)),
        v(random_tensor(Shape{Nk, heads, D}, 3)),
        dy(random_tensor(Shape{Nq, heads, D}, 4)) {}
};

struct Case {
  std::int64_t Nq, Nk, heads, D;
  FrameMask mask;
};
const Case kCases[] = {{1, 1, 1, 4, {}},          {5, 12, 2, 8, {}},
                       {12, 5, 3, 6, {}},         {12, 12, 2, 8, {4, false}},
                       {12, 12, 2, 8, {4, true}}, {6, 6, 1, 16, {6, true}}};

// The gradients in double by the chain rule, written out element by element.
struct Gradients {
  Tensor<double, 3> dq, dk, dv;
  Gradients(const Operands& o, const FrameMask& mask)
      : dq(o.q.shape()), dk(o.k.shape()), dv(o.v.shape()) {
    const std::int64_t heads = o.q.extent(1), D = o.q.extent(2), Nk = o.k.extent(0);
    const double scale = 1 / std::sqrt(static_cast<double>(D));
    const auto dot = [&](const auto& a, std::int64_t i, const auto& b, std::int64_t j,
                         std::int64_t h) {
      double sum = 0;
      for (std::int64_t d = 0; d < D; ++d) sum += static_cast<double>(a(i, h, d)) * b(j, h, d);
      return sum;
    };
    for (std::int64_t i = 0; i < o.q.extent(0); ++i)
      for (std::int64_t h = 0; h < heads; ++h) {
        std::vector<double> p(static_cast<std::size_t>(Nk)), dp(p.size());
        double total = 0, mean = 0;
        for (std::int64_t j = 0; j < Nk; ++j) {
          const bool seen = reference::sees(i, j, mask.frame_tokens, mask.earlier_frames);
          total += p[static_cast<std::size_t>(j)] =
              seen ? std::exp(scale * dot(o.q, i, o.k, j, h)) : 0;
          dp[static_cast<std::size_t>(j)] = dot(o.dy, i, o.v, j, h);
        }
        for (std::size_t j = 0; j < p.size(); ++j) mean += (p[j] /= total) * dp[j];
        for (std::int64_t j = 0; j < Nk; ++j) {
          const auto n = static_cast<std::size_t>(j);
          const double ds = scale * p[n] * (dp[n] - mean);
          for (std::int64_t d = 0; d < D; ++d) {
            dq(i, h, d) += ds * o.k(j, h, d);
            dk(j, h, d) += ds * o.q(i, h, d);
            dv(j, h, d) += p[n] * o.dy(i, h, d);
          }
        }
      }
  }
};

}  // namespace

TEST_CASE("attention_backward: agrees with the complex step, all keys, own frame, earlier frames") {
  Context ctx(2);
  for (const Case& c : kCases) {
    CAPTURE(c.Nq);
    CAPTURE(c.Nk);
    CAPTURE(c.mask.earlier_frames);
    const Operands o(c.Nq, c.Nk, c.heads, c.D);
    const auto loss = [&](const auto& q, const auto& k, const auto& v) {
      return weighted_sum(
          o.dy, reference::masked_attention(q, k, v, c.mask.frame_tokens, c.mask.earlier_frames));
    };
    const auto q = in_complex(o.q), k = in_complex(o.k), v = in_complex(o.v);
    const auto expected_dq = complex_step(o.q, [&](const auto& x) { return loss(x, k, v); });
    const auto expected_dk = complex_step(o.k, [&](const auto& x) { return loss(q, x, v); });
    const auto expected_dv = complex_step(o.v, [&](const auto& x) { return loss(q, k, x); });
    for_each_target([&] {
      Strided<3> sq(o.q.view()), sk(o.k.view()), sv(o.v.view()), sdy(o.dy.view());
      Strided<3> dq(o.q.shape()), dk(o.k.shape()), dv(o.v.shape());
      attention_backward(dq.view(), dk.view(), dv.view(), sdy.view(), sq.view(), sk.view(),
                         sv.view(), c.mask, ctx);
      CHECK_CLOSE(dq.view(), expected_dq, 5e-6);
      CHECK_CLOSE(dk.view(), expected_dk, 5e-6);
      CHECK_CLOSE(dv.view(), expected_dv, 5e-6);
      CHECK(dq.gaps_untouched());
      CHECK(dk.gaps_untouched());
      CHECK(dv.gaps_untouched());
      Tensor<float, 3> y(o.q.shape());
      attention_forward(y, sq.view(), sk.view(), sv.view(), c.mask, ctx);
      CHECK_CLOSE(y,
                  reference::masked_attention(in_double(o.q), in_double(o.k), in_double(o.v),
                                              c.mask.frame_tokens, c.mask.earlier_frames),
                  5e-6);
    });
  }
}

TEST_CASE("attention_backward: more queries than a block, over frames: as the sums written out") {
  Context one(1), eight(8);
  for (const FrameMask& mask : {FrameMask{}, FrameMask{290, false}, FrameMask{290, true}}) {
    CAPTURE(mask.frame_tokens);
    CAPTURE(mask.earlier_frames);
    const Operands o(580, 580, 2, 16);
    const Gradients expected(o, mask);
    Tensor<float, 3> dq(o.q.shape()), dk(o.k.shape()), dv(o.v.shape());
    attention_backward(dq, dk, dv, o.dy, o.q, o.k, o.v, mask, one);
    CHECK_CLOSE(dq, expected.dq, 2e-6);
    CHECK_CLOSE(dk, expected.dk, 2e-5);  // a sum over up to 580 queries
    CHECK_CLOSE(dv, expected.dv, 2e-5);
    Tensor<float, 3> dq8(o.q.shape()), dk8(o.k.shape()), dv8(o.v.shape());
    attention_backward(dq8, dk8, dv8, o.dy, o.q, o.k, o.v, mask, eight);
    CHECK_SAME_BITS(dq8, dq);
    CHECK_SAME_BITS(dk8, dk);
    CHECK_SAME_BITS(dv8, dv);
  }
}

TEST_CASE("attention_backward: gradients that are not wanted change nothing in the others") {
  Context ctx(1);
  const Operands o(8, 8, 2, 4);
  const FrameMask mask{4, true};
  Tensor<float, 3> dq(o.q.shape()), dk(o.k.shape()), dv(o.v.shape());
  Tensor<float, 3> dq_alone(o.q.shape()), dk_alone(o.k.shape()), dv_alone(o.v.shape());
  attention_backward(dq, dk, dv, o.dy, o.q, o.k, o.v, mask, ctx);
  attention_backward(dq_alone, {}, {}, o.dy, o.q, o.k, o.v, mask, ctx);
  attention_backward({}, dk_alone, {}, o.dy, o.q, o.k, o.v, mask, ctx);
  attention_backward({}, {}, dv_alone, o.dy, o.q, o.k, o.v, mask, ctx);
  CHECK_SAME_BITS(dq_alone, dq);
  CHECK_SAME_BITS(dk_alone, dk);
  CHECK_SAME_BITS(dv_alone, dv);
}

TEST_CASE("attention_backward: wrong shapes and masks are refused by name") {
  Context ctx(1);
  const Operands o(8, 12, 2, 4);
  Tensor<float, 3> dq(o.q.shape()), dk(o.k.shape()), y(o.q.shape());
  CHECK_THROWS_WITH_AS(attention_backward(dq, dk, dq, o.dy, o.q, o.k, o.v, {}, ctx),
                       doctest::Contains("dv [8,2,4]"), Error);
  CHECK_THROWS_WITH_AS(attention_backward(dq, dk, {}, o.k, o.q, o.k, o.v, {}, ctx),
                       doctest::Contains("dy is [12,2,4]"), Error);
  CHECK_THROWS_WITH_AS(attention_backward(dq, dk, {}, o.dy, o.q, o.k, o.v, {4, true}, ctx),
                       doctest::Contains("whole frames of 4 tokens"), Error);
  CHECK_THROWS_WITH_AS(attention_forward(y, o.q, o.q, o.q, {3, false}, ctx),
                       doctest::Contains("whole frames of 3 tokens"), Error);
}
