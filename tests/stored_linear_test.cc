// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/stored_linear.h"

#include <doctest/doctest.h>

#include <cmath>
#include <vector>

#include "lvggt/core/float16.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// A weight as a file would hold it, and the values that stands for.
struct Stored {
  std::vector<std::byte> bytes;
  Tensor<float, 2> values;
  StoredMatrix matrix;

  Stored(const Tensor<float, 2>& weight, Storage storage) : values(weight.clone()) {
    const std::size_t element = storage_bytes(storage);
    bytes.resize(static_cast<std::size_t>(weight.size()) * element);
    for (std::int64_t i = 0; i < weight.size(); ++i) {
      float& value = values.data()[i];
      std::byte* to = bytes.data() + static_cast<std::size_t>(i) * element;
      if (storage == Storage::kF32) {
        std::memcpy(to, &value, 4);
      } else {
        const std::uint16_t bits =
            storage == Storage::kBf16 ? to_bfloat16(value).bits : to_float16(value).bits;
        value = storage == Storage::kBf16 ? to_float(bfloat16{bits}) : to_float(float16{bits});
        std::memcpy(to, &bits, 2);
      }
    }
    matrix = {bytes.data(), storage, weight.extent(0), weight.extent(1)};
  }
};

}  // namespace

TEST_CASE("stored_linear_forward: agrees with the definition for every storage and remainder") {
  Context ctx(2);
  for_each_target([&] {
    for (const Storage storage : {Storage::kF32, Storage::kBf16, Storage::kF16}) {
      CAPTURE(storage_name(storage));
      for (const std::int64_t K : {1, 15, 33, 520}) {
        for (const std::int64_t M : {1, 7, 100}) {
          const std::int64_t N = 67;
          CAPTURE(K);
          CAPTURE(M);
          const Stored w(random_tensor(Shape{N, K}, 1), storage);
          const auto x = random_tensor(Shape{M, K}, 2);
          const auto residual = random_tensor(Shape{M, N}, 3);
          Tensor<double, 2> expected(Shape{M, N});
          for (std::int64_t m = 0; m < M; ++m)
            for (std::int64_t n = 0; n < N; ++n) {
              expected(m, n) = residual(m, n);
              for (std::int64_t k = 0; k < K; ++k)
                expected(m, n) += double{x(m, k)} * w.values(n, k);
            }
          Strided<2> own_x(x.view()), y(residual.view());
          stored_linear_forward(y.view(), own_x.view(), w.matrix, y.view(), ctx);
          // Partial sums stay below sqrt(K) with room, and each lane adds K / 4 of them at most.
          CHECK_CLOSE(
              y.view(), expected,
              (static_cast<double>(K) / 4 + 8) * (2 + std::sqrt(static_cast<double>(K))) * kUnit);
          CHECK(y.gaps_untouched());
        }
      }
    }
  });
}

TEST_CASE("stored_linear_forward: a row's bits depend neither on its neighbours nor on threads") {
  Context one(1), many(8);
  const Stored w(random_tensor(Shape{200, 130}, 1), Storage::kBf16);
  const auto x = random_tensor(Shape{101, 130}, 2);
  Tensor<float, 2> all(Shape{101, 200}), alone(Shape{1, 200});
  stored_linear_forward(all, x, w.matrix, {}, many);
  stored_linear_forward(alone, x.view().narrow(0, 99, 100), w.matrix, {}, one);
  CHECK_SAME_BITS(all.view().narrow(0, 99, 100), alone);
}

TEST_CASE("stored_row: gives the widened row, and refuses one that is not there") {
  const Stored w(random_tensor(Shape{3, 5}, 1), Storage::kF16);
  Tensor<float, 1> row(Shape{5});
  stored_row(row, w.matrix, 2);
  CHECK_SAME_BITS(row, w.values[2]);
  CHECK_THROWS_AS(stored_row(row, w.matrix, 3), Error);
}
