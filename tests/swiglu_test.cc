// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/swiglu.h"

#include <doctest/doctest.h>

#include <cmath>

#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

TEST_CASE("swiglu_forward: is silu(gate) * up, and may overwrite either") {
  Context ctx(2);
  for_each_target([&] {
    for (const std::int64_t C : {1, 5, 16, 31, 64}) {
      CAPTURE(C);
      const auto gate = random_tensor(Shape{std::int64_t{3}, C}, 1, -9, 9);
      const auto up = random_tensor(gate.shape(), 2, -4, 4);
      Tensor<double, 2> expected(gate.shape());
      for (std::int64_t i = 0; i < gate.size(); ++i) {
        const double g = gate.data()[i];
        expected.data()[i] = g / (1 + std::exp(-g)) * up.data()[i];
      }
      Strided<2> strided_gate(gate.view()), strided_up(up.view()), y(gate.shape());
      swiglu_forward(y.view(), strided_gate.view(), strided_up.view(), ctx);
      CHECK_CLOSE(y.view(), expected, 0, 8 * kUnit);  // silu is within 2.5 ulp, and one product
      CHECK(y.gaps_untouched());
      swiglu_forward(strided_gate.view(), strided_gate.view(), strided_up.view(), ctx);
      CHECK_SAME_BITS(strided_gate.view(), y.view());
    }
  });
}
