// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/rope.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/rope.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <cmath>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"
#include "lvggt/kernels/rope_backward.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// One head of one token, turned by its angles or, backward, by minus them. Both elements of a pair
// are read before either is written, so y may be x.
template <bool kBackward>
HWY_INLINE void turn_head(float* y, const float* x, const float* HWY_RESTRICT cosine,
                          const float* HWY_RESTRICT sine, std::int64_t quarter) {
  for (std::int64_t half = 0; half < 2; ++half) {
    for_each_vector(quarter, [=](auto d, std::int64_t j) HWY_ATTR {
      const auto c = hn::LoadU(d, cosine + half * quarter + j);
      const auto positive = hn::LoadU(d, sine + half * quarter + j);
      const auto s = kBackward ? hn::Neg(positive) : positive;
      const auto a = hn::LoadU(d, x + 2 * half * quarter + j);
      const auto b = hn::LoadU(d, x + (2 * half + 1) * quarter + j);
      hn::StoreU(hn::NegMulAdd(b, s, hn::Mul(a, c)), d, y + 2 * half * quarter + j);
      hn::StoreU(hn::MulAdd(a, s, hn::Mul(b, c)), d, y + (2 * half + 1) * quarter + j);
    });
  }
}

void rope_head(float* y, const float* x, const float* HWY_RESTRICT cosine,
               const float* HWY_RESTRICT sine, std::int64_t quarter) {
  turn_head<false>(y, x, cosine, sine, quarter);
}
void rope_head_backward(float* dx, const float* dy, const float* HWY_RESTRICT cosine,
                        const float* HWY_RESTRICT sine, std::int64_t quarter) {
  turn_head<true>(dx, dy, cosine, sine, quarter);
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(rope_head);
HWY_EXPORT(rope_head_backward);
auto rope_head_function() { return &HWY_DYNAMIC_DISPATCH(rope_head); }
auto rope_head_backward_function() { return &HWY_DYNAMIC_DISPATCH(rope_head_backward); }

using TurnHead = void (*)(float*, const float*, const float*, const float*, std::int64_t);

void turn_heads(const char* op, TurnHead head, View<float, 3> y, View<const float, 3> x,
                const RopeTable& table, Context& ctx) {
  const std::int64_t N = x.extent(0), heads = x.extent(1), D = x.extent(2), P = table.cos.extent(0);
  LVGGT_CHECK(y.shape() == x.shape(), op, ": y is ", y.shape(), " but x is ", x.shape());
  LVGGT_CHECK(D % 4 == 0 && table.cos.extent(1) == D / 2, op, ": x is ", x.shape(),
              " but the table is ", table.cos.shape(), ", expected [P,D/2]");
  LVGGT_CHECK(N == 0 || (P > 0 && N % P == 0), op, ": ", N,
              " tokens are not whole frames of the table's ", P, " positions");
  parallel_rows(
      N, rows_per_chunk(heads * D),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n)
          for (std::int64_t h = 0; h < heads; ++h)
            head(y[n][h].data(), x[n][h].data(), table.cos[n % P].data(), table.sin[n % P].data(),
                 D / 4);
      },
      ctx);
}

}  // namespace
}  // namespace kernels

RopeTable make_rope_table(View<const std::int64_t, 2> positions, std::int64_t head_dim,
                          float base) {
  LVGGT_CHECK(positions.extent(1) == 2, "rope_2d: positions are ", positions.shape(),
              ", expected [P,2]");
  LVGGT_CHECK(head_dim > 0 && head_dim % 4 == 0, "rope_2d: head_dim ", head_dim,
              " is not a multiple of 4");
  const std::int64_t P = positions.extent(0), half = head_dim / 2, quarter = head_dim / 4;
  RopeTable table{Tensor<float, 2>(Shape{P, half}), Tensor<float, 2>(Shape{P, half})};
  for (std::int64_t p = 0; p < P; ++p)
    for (std::int64_t axis = 0; axis < 2; ++axis)
      for (std::int64_t j = 0; j < quarter; ++j) {
        const double exponent = -2.0 * static_cast<double>(j) / static_cast<double>(half);
        const double angle = static_cast<double>(positions(p, axis)) * std::pow(base, exponent);
        table.cos(p, axis * quarter + j) = static_cast<float>(std::cos(angle));
        table.sin(p, axis * quarter + j) = static_cast<float>(std::sin(angle));
      }
  return table;
}

void rope_2d_forward(View<float, 3> y, View<const float, 3> x, const RopeTable& table,
                     Context& ctx) {
  kernels::turn_heads("rope_2d", kernels::rope_head_function(), y, x, table, ctx);
}

void rope_2d_backward(View<float, 3> dx, View<const float, 3> dy, const RopeTable& table,
                      Context& ctx) {
  kernels::turn_heads("rope_2d_backward", kernels::rope_head_backward_function(), dx, dy, table,
                      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
