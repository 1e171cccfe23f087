// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/causal_attention.h"

#include <doctest/doctest.h>

#include "tests/reference/sequence_ops.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

TEST_CASE("causal_attention: agrees with the definition, with grouped keys and several sequences") {
  Context ctx(3);
  for_each_target([&] {
    for (const std::int64_t D : {1, 8, 20, 64}) {
      for (const std::int64_t P : {1, 7, 40}) {
        for (const std::int64_t key_heads : {1, 2, 4}) {
          CAPTURE(D);
          CAPTURE(P);
          CAPTURE(key_heads);
          const auto q = random_tensor(Shape{2 * P, std::int64_t{4}, D}, 1, -2, 2);
          const auto k = random_tensor(Shape{2 * P, key_heads, D}, 2, -2, 2);
          const auto v = random_tensor(k.shape(), 3);
          const auto expected =
              reference::causal_attention(in_double(q), in_double(k), in_double(v), P, 0.25);
          Strided<3> own_q(q.view()), own_k(k.view()), own_v(v.view()), y(q.shape());
          causal_attention(y.view(), own_q.view(), own_k.view(), own_v.view(), P, 0.25f, ctx);
          // A score of |D| is off by D/4 + 3 roundings of at most D; so is its exponential,
          // relative; the weighted mean of values below 1 as much.
          CHECK_CLOSE(y.view(), expected,
                      (static_cast<double>(D) / 4 + 3) * static_cast<double>(D) * kUnit +
                          (static_cast<double>(P) + 8) * kUnit);
          CHECK(y.gaps_untouched());
          causal_attention(own_q.view(), own_q.view(), own_k.view(), own_v.view(), P, 0.25f, ctx);
          CHECK_SAME_BITS(own_q.view(), y.view());
        }
      }
    }
  });
}

TEST_CASE("causal_attention: what follows a token does not change it, whatever the threads") {
  Context one(1), many(8);
  const auto q = random_tensor(Shape{50, 2, 16}, 1), k = random_tensor(Shape{50, 2, 16}, 2);
  const auto v = random_tensor(Shape{50, 2, 16}, 3);
  Tensor<float, 3> whole(q.shape()), start(Shape{20, 2, 16});
  causal_attention(whole, q, k, v, 50, 1.0f, one);
  causal_attention(start, q.view().narrow(0, 0, 20), k.view().narrow(0, 0, 20),
                   v.view().narrow(0, 0, 20), 20, 1.0f, many);
  CHECK_SAME_BITS(whole.view().narrow(0, 0, 20), start);
}

TEST_CASE("causal_attention: parts that do not fit are refused") {
  Context ctx(1);
  Tensor<float, 3> q(Shape{6, 4, 8}), k(Shape{6, 3, 8}), pair(Shape{6, 2, 8});
  CHECK_THROWS_AS(causal_attention(q, q, k, k, 6, 1.0f, ctx), Error);        // 4 heads on 3
  CHECK_THROWS_AS(causal_attention(q, q, pair, pair, 4, 1.0f, ctx), Error);  // 6 tokens of 4
}
