// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/rope_1d.h"

#include <doctest/doctest.h>

#include "tests/reference/sequence_ops.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

TEST_CASE("rope_1d_forward: agrees with the definition for every head size, strided and in place") {
  Context ctx(2);
  for_each_target([&] {
    for (const std::int64_t D : {2, 4, 6, 16, 34, 64, 128}) {
      CAPTURE(D);
      const Rope1dTable table = make_rope_1d_table(7, D, 10000);
      for (const std::int64_t N : {0, 5, 7, 14}) {
        const auto x = random_tensor(Shape{N, std::int64_t{3}, D}, 1);
        Strided<3> strided(x.view()), y(x.shape());
        rope_1d_forward(y.view(), strided.view(), table, ctx);
        // |x| < 1: two products of a value with a rounded cosine or sine, 2 u each, and their sum.
        CHECK_CLOSE(y.view(), reference::rope_1d(in_double(x), 7, 10000.0), 6 * kUnit);
        CHECK(y.gaps_untouched());
        rope_1d_forward(strided.view(), strided.view(), table, ctx);
        CHECK_SAME_BITS(strided.view(), y.view());
      }
    }
  });
}

TEST_CASE("rope_1d_forward: odd heads and tables of another size are refused") {
  Context ctx(1);
  CHECK_THROWS_AS(make_rope_1d_table(4, 15, 10000), Error);
  const Rope1dTable table = make_rope_1d_table(4, 8, 10000);
  Tensor<float, 3> x(Shape{4, 2, 16});
  CHECK_THROWS_AS(rope_1d_forward(x, x, table, ctx), Error);
}
