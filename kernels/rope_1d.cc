// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/rope_1d.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/rope_1d.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <cmath>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// One head of one token. Both elements of a pair are read before either is written, so y may be x.
void rope_1d_head(float* y, const float* x, const float* HWY_RESTRICT cosine,
                  const float* HWY_RESTRICT sine, std::int64_t half) {
  for_each_vector(half, [=](auto d, std::int64_t j) HWY_ATTR {
    const auto c = hn::LoadU(d, cosine + j);
    const auto s = hn::LoadU(d, sine + j);
    const auto a = hn::LoadU(d, x + j);
    const auto b = hn::LoadU(d, x + half + j);
    hn::StoreU(hn::NegMulAdd(b, s, hn::Mul(a, c)), d, y + j);
    hn::StoreU(hn::MulAdd(a, s, hn::Mul(b, c)), d, y + half + j);
  });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(rope_1d_head);
auto rope_1d_head_function() { return &HWY_DYNAMIC_DISPATCH(rope_1d_head); }

}  // namespace
}  // namespace kernels

Rope1dTable make_rope_1d_table(std::int64_t P, std::int64_t head_dim, double base) {
  LVGGT_CHECK(head_dim > 0 && head_dim % 2 == 0, "rope_1d: head_dim ", head_dim, " is not even");
  const std::int64_t half = head_dim / 2;
  Rope1dTable table{Tensor<float, 2>(Shape{P, half}), Tensor<float, 2>(Shape{P, half})};
  for (std::int64_t j = 0; j < half; ++j) {
    const double frequency =
        std::pow(base, -2.0 * static_cast<double>(j) / static_cast<double>(head_dim));
    for (std::int64_t p = 0; p < P; ++p) {
      table.cos(p, j) = static_cast<float>(std::cos(static_cast<double>(p) * frequency));
      table.sin(p, j) = static_cast<float>(std::sin(static_cast<double>(p) * frequency));
    }
  }
  return table;
}

void rope_1d_forward(View<float, 3> y, View<const float, 3> x, const Rope1dTable& table,
                     Context& ctx) {
  const std::int64_t N = x.extent(0), heads = x.extent(1), D = x.extent(2), P = table.cos.extent(0);
  LVGGT_CHECK(y.shape() == x.shape(), "rope_1d: y is ", y.shape(), " but x is ", x.shape());
  LVGGT_CHECK(D % 2 == 0 && table.cos.extent(1) == D / 2, "rope_1d: x is ", x.shape(),
              " but the table is ", table.cos.shape(), ", expected [P,D/2]");
  LVGGT_CHECK(N == 0 || P > 0, "rope_1d: ", N, " tokens, but the table has no positions");
  const auto head = kernels::rope_1d_head_function();
  parallel_rows(
      N, kernels::rows_per_chunk(heads * D),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n)
          for (std::int64_t h = 0; h < heads; ++h)
            head(y[n][h].data(), x[n][h].data(), table.cos[n % P].data(), table.sin[n % P].data(),
                 D / 2);
      },
      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
