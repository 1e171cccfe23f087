// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/rms_norm.h"

#include <doctest/doctest.h>

#include "tests/reference/sequence_ops.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

TEST_CASE("rms_norm_forward: agrees with the definition, strided and in place") {
  Context ctx(2);
  for_each_target([&] {
    for (const std::int64_t C : {1, 3, 16, 17, 33, 64, 140}) {
      CAPTURE(C);
      const auto x = random_tensor(Shape{std::int64_t{5}, C}, 1);
      const auto gamma = random_tensor(Shape{C}, 2);
      const auto expected = reference::rms_norm(in_double(x), in_double(gamma), 1e-5);
      Strided<2> strided(x.view()), y(x.shape());
      rms_norm_forward(y.view(), strided.view(), gamma, 1e-5f, ctx);
      // A sum of positive terms is off by at most C/4 + 3 roundings, its root by half of that.
      CHECK_CLOSE(y.view(), expected, kUnit, (static_cast<double>(C) / 8 + 8) * kUnit);
      CHECK(y.gaps_untouched());
      rms_norm_forward(strided.view(), strided.view(), gamma, 1e-5f, ctx);
      CHECK_SAME_BITS(strided.view(), y.view());
    }
  });
}

TEST_CASE("rms_norm_forward: gamma of another size is refused") {
  Context ctx(1);
  Tensor<float, 2> x(Shape{2, 8});
  Tensor<float, 1> gamma(Shape{7});
  CHECK_THROWS_WITH_AS(rms_norm_forward(x, x, gamma, 1e-5f, ctx),
                       "rms_norm: x is [2,8] but gamma is [7]", Error);
}
