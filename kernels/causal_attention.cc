// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/causal_attention.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/causal_attention.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <algorithm>

#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// One query over num_keys keys and values, whose tokens lie `stride` apart. `scores` has room for
// num_keys values. The query is read before y is written.
void causal_row(float* y, const float* q, const float* HWY_RESTRICT k, std::int64_t k_stride,
                const float* HWY_RESTRICT v, std::int64_t v_stride, std::int64_t num_keys,
                std::int64_t D, float scale, float* HWY_RESTRICT scores) {
  for (std::int64_t j = 0; j < num_keys; ++j) {
    const float* key = k + j * k_stride;
    scores[j] = scale * sum_vectors(D, [=](auto d, std::int64_t i) HWY_ATTR {
                  return hn::Mul(hn::LoadU(d, q + i), hn::LoadU(d, key + i));
                });
  }
  float largest = scores[0];
  for (std::int64_t j = 1; j < num_keys; ++j) largest = std::max(largest, scores[j]);
  for_each_vector(num_keys, [=](auto d, std::int64_t j) HWY_ATTR {
    const auto shifted = hn::Sub(hn::LoadU(d, scores + j), hn::Set(d, largest));
    hn::StoreU(exp_nonpositive(d, shifted), d, scores + j);
  });
  const float sum = sum_vectors(
      num_keys, [=](auto d, std::int64_t j) HWY_ATTR { return hn::LoadU(d, scores + j); });
  const float inverse = 1.0f / sum;
  for_each_vector(D, [=](auto d, std::int64_t i) HWY_ATTR {
    auto total = hn::Zero(d);
    for (std::int64_t j = 0; j < num_keys; ++j)
      total = hn::MulAdd(hn::Set(d, scores[j]), hn::LoadU(d, v + j * v_stride + i), total);
    hn::StoreU(hn::Mul(total, hn::Set(d, inverse)), d, y + i);
  });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(causal_row);
auto causal_row_function() { return &HWY_DYNAMIC_DISPATCH(causal_row); }

// Queries of one head handled together: enough work to be worth a hand-over for the first ones too,
// which see few keys.
constexpr std::int64_t kQueries = 32;

}  // namespace
}  // namespace kernels

void causal_attention(View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                      View<const float, 3> v, std::int64_t P, float scale, Context& ctx) {
  const std::int64_t N = q.extent(0), heads = q.extent(1), D = q.extent(2);
  const std::int64_t key_heads = k.extent(1);
  LVGGT_CHECK(y.shape() == q.shape(), "causal_attention: y is ", y.shape(), " but q is ",
              q.shape());
  LVGGT_CHECK(k.shape() == v.shape() && k.extent(0) == N && k.extent(2) == D && key_heads > 0 &&
                  heads % key_heads == 0,
              "causal_attention: q is ", q.shape(), " but k is ", k.shape(), " and v ", v.shape());
  LVGGT_CHECK(N == 0 || (P > 0 && N % P == 0), "causal_attention: ", N,
              " tokens are not whole sequences of ", P);
  if (N == 0 || heads == 0) return;
  Arena::Scope scope(ctx.arena());
  const auto scores = ctx.arena().alloc(Shape{std::int64_t{ctx.num_threads()}, P});
  const std::int64_t blocks = (P + kernels::kQueries - 1) / kernels::kQueries;
  const auto row = kernels::causal_row_function();
  parallel_chunks(
      N / P * heads * blocks,
      [&](std::int64_t chunk, int worker) {
        const std::int64_t block = chunk % blocks, head = chunk / blocks % heads;
        const std::int64_t first = chunk / (blocks * heads) * P;
        const std::int64_t key_head = head / (heads / key_heads);
        const float* keys = k[first][key_head].data();
        const float* values = v[first][key_head].data();
        const std::int64_t end = std::min(P, (block + 1) * kernels::kQueries);
        for (std::int64_t i = block * kernels::kQueries; i < end; ++i)
          row(y[first + i][head].data(), q[first + i][head].data(), keys, k.stride(0), values,
              v.stride(0), i + 1, D, scale, scores[worker].data());
      },
      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
