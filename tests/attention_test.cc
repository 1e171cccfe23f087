// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/attention.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <limits>
#include <vector>

#include "lvggt/core/float16.h"
#include "tests/reference/attention.h"
#include "tests/support/compare.h"
#include "tests/support/random.h"
#include "tests/support/strided.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// Keys and values in groups, packed, and the buffers they live in.
class Groups {
 public:
  // Splits the tokens of k and v, [Nk, heads, D], into groups of the given sizes.
  Groups(View<const float, 3> k, View<const float, 3> v, const std::vector<std::int64_t>& sizes,
         Context& ctx, Storage storage = Storage::kF32) {
    const std::int64_t heads = k.extent(1), D = k.extent(2);
    std::int64_t begin = 0;
    for (const std::int64_t size : sizes) {
      buffers_.emplace_back(Shape{keys_values_layout(storage, heads, size, D).size});
      groups_.push_back({buffers_.back().data(), storage, heads, size, D});
      pack_keys_values(groups_.back(), k.narrow(0, begin, begin + size),
                       v.narrow(0, begin, begin + size), ctx);
      begin += size;
    }
  }
  std::span<const PackedKeysValues> packed() const { return groups_; }

 private:
  std::vector<Tensor<std::byte, 1>> buffers_;
  std::vector<PackedKeysValues> groups_;
};

double largest(View<const float, 3> x) {
  const Tensor<float, 3> dense = converted<float>(x);
  double m = 0;
  for (std::int64_t i = 0; i < dense.size(); ++i)
    m = std::max(m, std::abs(double{dense.data()[i]}));
  return m;
}

// A score is off by at most (D + 4) u times the sum of its products' magnitudes, here the largest
// of all. That is the relative error of a weight before normalisation, which doubles it; the
// exponential and the sums over the keys add 8 + Nk roundings, again doubled. The result is a mean
// of values.
double bound(View<const float, 3> q, View<const float, 3> k, View<const float, 3> v, float scale) {
  double score = 0;
  for (std::int64_t i = 0; i < q.extent(0); ++i)
    for (std::int64_t j = 0; j < k.extent(0); ++j)
      for (std::int64_t h = 0; h < q.extent(1); ++h) {
        double sum = 0;
        for (std::int64_t d = 0; d < q.extent(2); ++d)
          sum += std::abs(double{q(i, h, d)} * k(j, h, d));
        score = std::max(score, scale * sum);
      }
  const double roundings = static_cast<double>(k.extent(0)) + 8;
  return 2 * kUnit * (static_cast<double>(q.extent(2) + 4) * score + roundings) * largest(v);
}

struct Case {
  std::int64_t Nq, heads, D;
  std::vector<std::int64_t> groups;
};

void check(const Case& size, float magnitude, Context& ctx) {
  CAPTURE(size.Nq);
  CAPTURE(size.D);
  std::int64_t Nk = 0;
  for (const std::int64_t group : size.groups) Nk += group;
  CAPTURE(Nk);
  // Slices of qkv buffers, as the model has them.
  const auto q_buffer =
      random_tensor(Shape{size.Nq, 3 * size.heads, size.D}, 1, -magnitude, magnitude);
  const auto kv_buffer = random_tensor(Shape{Nk, 3 * size.heads, size.D}, 2, -magnitude, magnitude);
  const View<const float, 3> q = q_buffer.view().narrow(1, 0, size.heads);
  const View<const float, 3> k = kv_buffer.view().narrow(1, size.heads, 2 * size.heads);
  const View<const float, 3> v = kv_buffer.view().narrow(1, 2 * size.heads, 3 * size.heads);
  const float scale = 1.0f / std::sqrt(static_cast<float>(size.D));
  const auto expected = reference::attention(converted<double>(q), converted<double>(k),
                                             converted<double>(v), static_cast<double>(scale));
  Strided<3> y(q.shape());
  scaled_dot_product_attention(y.view(), q, Groups(k, v, size.groups, ctx).packed(), scale, ctx);
  CHECK_CLOSE(y.view(), expected, bound(q, k, v, scale));
  CHECK(y.gaps_untouched());
}

}  // namespace

TEST_CASE("attention: agrees with the definition for every head size and number of tokens") {
  Context ctx(2);
  for_each_target([&] {
    for (const std::int64_t D : {8, 16, 24, 64, 128})
      for (const std::int64_t tokens : {1, 5, 12, 29, 261}) check({tokens, 2, D, {tokens}}, 1, ctx);
  });
}

TEST_CASE("attention: several groups are one set of keys, whatever their sizes") {
  Context ctx(2);
  for_each_target([&] {
    check({5, 3, 16, {1, 17, 16, 2}}, 2, ctx);
    check({1, 16, 128, {1, 1, 1, 1, 1, 1, 1, 1, 1}}, 1, ctx);
    check({29, 2, 64, {29, 29, 29, 29}}, 1, ctx);
    check({97, 1, 64, {261, 261, 5}}, 1, ctx);
    check({12, 1, 20, {500, 3}}, 1, ctx);
    check({0, 2, 16, {5}}, 1, ctx);
  });
}

TEST_CASE("attention: the order of the groups changes nothing but rounding") {
  Context ctx(1);
  const auto q = random_tensor(Shape{7, 2, 32}, 1), k = random_tensor(Shape{40, 2, 32}, 2),
             v = random_tensor(Shape{40, 2, 32}, 3);
  for_each_target([&] {
    Tensor<float, 3> forwards(q.shape()), backwards(q.shape());
    const Groups groups(k, v, {7, 20, 13}, ctx);
    std::vector<PackedKeysValues> reversed(groups.packed().rbegin(), groups.packed().rend());
    scaled_dot_product_attention(forwards, q, groups.packed(), 0.2f, ctx);
    scaled_dot_product_attention(backwards, q, reversed, 0.2f, ctx);
    CHECK_CLOSE(forwards, backwards, 2 * bound(q, k, v, 0.2f));
  });
}

TEST_CASE("attention: scores around 1e4 of both signs give means of the values, not NaN") {
  Context ctx(1);
  for_each_target([&] {
    // Each score is about +-1e4: q and k are +-35 in one of 8 dimensions apiece, scale 8.
    auto q = random_tensor(Shape{12, 1, 8}, 1), k = random_tensor(Shape{29, 1, 8}, 2);
    const auto v = random_tensor(Shape{29, 1, 8}, 3);
    for (std::int64_t i = 0; i < 12; ++i) q(i, 0, 3) = i % 2 == 0 ? 35 : -35;
    for (std::int64_t j = 0; j < 29; ++j) k(j, 0, 3) = j % 3 == 0 ? 35 : -35;
    Tensor<float, 3> y(q.shape());
    scaled_dot_product_attention(y, q, Groups(k, v, {12, 17}, ctx).packed(), 8, ctx);
    const auto expected = reference::attention(in_double(q), in_double(k), in_double(v), 8.0);
    CHECK_CLOSE(y, expected, bound(q, k, v, 8));
  });
}

TEST_CASE("attention: all scores far below zero weigh by their differences") {
  Context ctx(1);
  for_each_target([&] {
    auto q = random_tensor(Shape{3, 1, 8}, 1), k = random_tensor(Shape{20, 1, 8}, 2);
    const auto v = random_tensor(Shape{20, 1, 8}, 3);
    for (std::int64_t i = 0; i < 3; ++i) q(i, 0, 0) = 1e3f;
    for (std::int64_t j = 0; j < 20; ++j) k(j, 0, 0) = -10;
    Tensor<float, 3> y(q.shape());
    scaled_dot_product_attention(y, q, Groups(k, v, {4, 16}, ctx).packed(), 1, ctx);
    CHECK_CLOSE(y, reference::attention(in_double(q), in_double(k), in_double(v), 1.0),
                bound(q, k, v, 1));
  });
}

TEST_CASE("attention: one score of 1e38 takes everything, its negative nothing") {
  Context ctx(1);
  for_each_target([&] {
    auto q = random_tensor(Shape{9, 1, 16}, 1), k = random_tensor(Shape{33, 1, 16}, 2);
    const auto v = random_tensor(Shape{33, 1, 16}, 3);
    for (const std::int64_t token : {0, 15, 16, 32}) {
      for (std::int64_t i = 0; i < 9; ++i) q(i, 0, 5) = 1e19f;
      for (std::int64_t j = 0; j < 33; ++j) k(j, 0, 5) = j == token ? 1e19f : 0;
      Tensor<float, 3> y(q.shape());
      scaled_dot_product_attention(y, q, Groups(k, v, {16, 17}, ctx).packed(), 1, ctx);
      for (std::int64_t i = 0; i < 9; ++i) CHECK_CLOSE(y[i], v[token], 2 * kUnit);
      k(token, 0, 5) = -1e19f;
      scaled_dot_product_attention(y, q, Groups(k, v, {16, 17}, ctx).packed(), 1, ctx);
      Tensor<double, 3> others = in_double(k);
      others(token, 0, 5) = -1e3;  // already no weight at all
      Tensor<double, 3> queries = in_double(q);
      for (std::int64_t i = 0; i < 9; ++i) queries(i, 0, 5) = 1;
      CHECK_CLOSE(y, reference::attention(queries, others, in_double(v), 1.0), 1e-5);
    }
  });
}

TEST_CASE("attention: NaN in a query, a key or a value is seen in the result") {
  Context ctx(1);
  constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
  for_each_target([&] {
    const auto q = random_tensor(Shape{5, 2, 16}, 1), k = random_tensor(Shape{20, 2, 16}, 2);
    const auto v = random_tensor(Shape{20, 2, 16}, 3);
    const auto attended = [&](const Tensor<float, 3>& q1, const Tensor<float, 3>& k1,
                              const Tensor<float, 3>& v1) {
      Tensor<float, 3> y(q.shape());
      scaled_dot_product_attention(y, q1, Groups(k1, v1, {20}, ctx).packed(), 0.25f, ctx);
      return y;
    };
    auto bad_q = q.clone(), bad_k = k.clone(), bad_v = v.clone();
    bad_q(3, 1, 15) = bad_k(17, 1, 0) = bad_v(19, 1, 7) = kNan;
    const auto y_q = attended(bad_q, k, v), y_k = attended(q, bad_k, v),
               y_v = attended(q, k, bad_v);
    for (std::int64_t i = 0; i < 5; ++i)
      for (std::int64_t d = 0; d < 16; ++d) {
        CHECK(std::isnan(y_q(i, 1, d)) == (i == 3));
        CHECK(std::isnan(y_k(i, 1, d)));
        CHECK(std::isnan(y_v(i, 1, d)) == (d == 7));
        CHECK_FALSE(
            (std::isnan(y_q(i, 0, d)) || std::isnan(y_k(i, 0, d)) || std::isnan(y_v(i, 0, d))));
      }
  });
}

TEST_CASE("attention: y may be q, and 1 and 8 threads give the same bits") {
  Context one(1), eight(8);
  const auto k = random_tensor(Shape{261, 4, 64}, 2), v = random_tensor(Shape{261, 4, 64}, 3);
  auto q = random_tensor(Shape{261, 4, 64}, 1);
  Tensor<float, 3> y1(q.shape()), y8(q.shape());
  scaled_dot_product_attention(y1, q, Groups(k, v, {130, 131}, one).packed(), 0.125f, one);
  scaled_dot_product_attention(y8, q, Groups(k, v, {130, 131}, eight).packed(), 0.125f, eight);
  CHECK_SAME_BITS(y8, y1);
  scaled_dot_product_attention(q, q, Groups(k, v, {130, 131}, eight).packed(), 0.125f, eight);
  CHECK_SAME_BITS(q, y1);
}

TEST_CASE("attention: shapes that do not fit are refused by name") {
  Context ctx(1);
  const auto k = random_tensor(Shape{6, 2, 16}, 1);
  const Groups groups(k, k, {6}, ctx);
  Tensor<float, 3> y(Shape{3, 2, 16}), short_head(Shape{3, 2, 8}), one_head(Shape{3, 1, 16});
  CHECK_THROWS_WITH_AS(scaled_dot_product_attention(y, short_head, groups.packed(), 1, ctx),
                       doctest::Contains("[3,2,8]"), Error);
  CHECK_THROWS_WITH_AS(scaled_dot_product_attention(one_head, one_head, groups.packed(), 1, ctx),
                       doctest::Contains("[3,1,16]"), Error);
  CHECK_THROWS_WITH_AS(pack_keys_values(groups.packed()[0], k, y, ctx),
                       doctest::Contains("[3,2,16]"), Error);
}

namespace {

// What pack_keys_values keeps of x, as floats.
Tensor<float, 3> stored(const Tensor<float, 3>& x, Storage storage) {
  Tensor<float, 3> y = x.clone();
  const auto [P, heads, D] = x.shape();
  for (std::int64_t row = 0; row < P * heads; ++row) {
    float* values = y.data() + row * D;
    float largest = 0;
    for (std::int64_t i = 0; i < D; ++i) largest = std::max(largest, std::abs(values[i]));
    for (std::int64_t i = 0; i < D; ++i) {
      if (storage == Storage::kBf16) {
        values[i] = to_float(to_bfloat16(values[i]));
      } else {
        values[i] = largest > 0 ? std::nearbyint(values[i] * (127 / largest)) * (largest / 127) : 0;
      }
    }
  }
  return y;
}

}  // namespace

TEST_CASE(
    "attention: bf16 and int8 keys and values count as what they were rounded to, bit for bit") {
  Context ctx(2);
  for_each_target([&] {
    for (const Storage storage : {Storage::kBf16, Storage::kI8}) {
      for (const std::int64_t D : {8, 24, 64}) {
        CAPTURE(D);
        auto k = random_tensor(Shape{261, 2, D}, 2), v = random_tensor(Shape{261, 2, D}, 3);
        const auto q = random_tensor(Shape{29, 2, D}, 1);
        for (std::int64_t i = 0; i < D; ++i) k(17, 1, i) = v(17, 0, i) = 0;
        const std::vector<std::int64_t> sizes{5, 251, 5};
        Tensor<float, 3> narrow(q.shape()), wide(q.shape());
        scaled_dot_product_attention(narrow, q, Groups(k, v, sizes, ctx, storage).packed(), 0.3f,
                                     ctx);
        scaled_dot_product_attention(
            wide, q, Groups(stored(k, storage), stored(v, storage), sizes, ctx).packed(), 0.3f,
            ctx);
        CHECK_SAME_BITS(narrow, wide);
      }
    }
  });
}

TEST_CASE(
    "attention: NaN in a key or value is seen through int8 storage, and f16 is refused by name") {
  Context ctx(1);
  auto k = random_tensor(Shape{6, 1, 16}, 1);
  const auto q = random_tensor(Shape{2, 1, 16}, 2), v = random_tensor(Shape{6, 1, 16}, 3);
  k(3, 0, 5) = std::numeric_limits<float>::quiet_NaN();
  Tensor<float, 3> y(q.shape());
  scaled_dot_product_attention(y, q, Groups(k, v, {6}, ctx, Storage::kI8).packed(), 1, ctx);
  CHECK(std::isnan(y(1, 0, 0)));
  CHECK_THROWS_WITH_AS(Groups(q, q, {2}, ctx, Storage::kF16), doctest::Contains("not as f16"),
                       Error);
}
