// SPDX-License-Identifier: Apache-2.0
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/layer_norm_backward.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <algorithm>
#include <cmath>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"
#include "lvggt/kernels/layer_norm.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

void layer_norm_statistics_row(float* mean, float* rstd, const float* HWY_RESTRICT x,
                               std::int64_t C, float eps) {
  const float center =
      sum_vectors(C, [=](auto d, std::int64_t i) HWY_ATTR { return hn::LoadU(d, x + i); }) /
      static_cast<float>(C);
  const float sum_of_squares = sum_vectors(C, [=](auto d, std::int64_t i) HWY_ATTR {
    const auto deviation = hn::Sub(hn::LoadU(d, x + i), hn::Set(d, center));
    return hn::Mul(deviation, deviation);
  });
  *mean = center;
  *rstd = 1.0f / std::sqrt(sum_of_squares / static_cast<float>(C) + eps);
}

// n = (x - mean) rstd
template <class D>
HWY_INLINE hn::Vec<D> normed(D d, const float* HWY_RESTRICT x, float mean, float rstd) {
  return hn::Mul(hn::Sub(hn::LoadU(d, x), hn::Set(d, mean)), hn::Set(d, rstd));
}
// g = gamma dy
template <class D>
HWY_INLINE hn::Vec<D> scaled(D d, const float* dy, const float* HWY_RESTRICT gamma,
                             std::int64_t i) {
  const auto v = hn::LoadU(d, dy + i);
  return gamma ? hn::Mul(v, hn::LoadU(d, gamma + i)) : v;
}

void layer_norm_backward_row(float* dx, const float* dy, float mean, float rstd,
                             const float* HWY_RESTRICT x, const float* HWY_RESTRICT gamma,
                             std::int64_t C) {
  const float inverse_C = 1.0f / static_cast<float>(C);
  const float avg_g = inverse_C * sum_vectors(C, [=](auto d, std::int64_t i)
                                                     HWY_ATTR { return scaled(d, dy, gamma, i); });
  const float avg_gn = inverse_C * sum_vectors(C, [=](auto d, std::int64_t i) HWY_ATTR {
                         return hn::Mul(scaled(d, dy, gamma, i), normed(d, x + i, mean, rstd));
                       });
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    const auto centered = hn::Sub(scaled(d, dy, gamma, i), hn::Set(d, avg_g));
    const auto v = hn::NegMulAdd(normed(d, x + i, mean, rstd), hn::Set(d, avg_gn), centered);
    hn::StoreU(hn::Mul(v, hn::Set(d, rstd)), d, dx + i);
  });
}

// dgamma += dy n, dbeta += dy, for one row; either may be null.
void layer_norm_parameters_row(float* HWY_RESTRICT dgamma, float* HWY_RESTRICT dbeta,
                               const float* HWY_RESTRICT dy, float mean, float rstd,
                               const float* HWY_RESTRICT x, std::int64_t C) {
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    const auto g = hn::LoadU(d, dy + i);
    if (dgamma)
      hn::StoreU(hn::MulAdd(g, normed(d, x + i, mean, rstd), hn::LoadU(d, dgamma + i)), d,
                 dgamma + i);
    if (dbeta) hn::StoreU(hn::Add(g, hn::LoadU(d, dbeta + i)), d, dbeta + i);
  });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(layer_norm_statistics_row);
HWY_EXPORT(layer_norm_backward_row);
HWY_EXPORT(layer_norm_parameters_row);
auto statistics_function() { return HWY_DYNAMIC_DISPATCH(layer_norm_statistics_row); }
auto backward_function() { return HWY_DYNAMIC_DISPATCH(layer_norm_backward_row); }
auto parameters_function() { return HWY_DYNAMIC_DISPATCH(layer_norm_parameters_row); }

// Rows whose parameter gradients are summed together before the sums are added up in order: 64,
// more when there are so many rows that the sums would outgrow the rows.
std::int64_t rows_per_sum(std::int64_t N) { return std::max<std::int64_t>(64, N / 64); }

}  // namespace
}  // namespace kernels

void layer_norm_forward(View<float, 2> y, View<float, 1> mean, View<float, 1> rstd,
                        View<const float, 2> x, View<const float, 1> gamma,
                        View<const float, 1> beta, float eps, Context& ctx) {
  const std::int64_t N = x.extent(0), C = x.extent(1);
  LVGGT_CHECK(mean.extent(0) == N && rstd.extent(0) == N, "layer_norm: x is ", x.shape(),
              " but mean is ", mean.shape(), " and rstd ", rstd.shape());
  const auto row = kernels::statistics_function();
  parallel_rows(
      N, kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) row(&mean[n], &rstd[n], x[n].data(), C, eps);
      },
      ctx);
  layer_norm_forward(y, x, gamma, beta, eps, ctx);
}

void layer_norm_backward(View<float, 2> dx, View<float, 1> dgamma, View<float, 1> dbeta,
                         View<const float, 2> dy, View<const float, 1> mean,
                         View<const float, 1> rstd, View<const float, 2> x,
                         View<const float, 1> gamma, Context& ctx) {
  const std::int64_t N = x.extent(0), C = x.extent(1);
  LVGGT_CHECK(dy.shape() == x.shape() && (!dx || dx.shape() == x.shape()),
              "layer_norm_backward: x is ", x.shape(), " but dy is ", dy.shape(), " and dx ",
              dx.shape());
  LVGGT_CHECK(mean.extent(0) == N && rstd.extent(0) == N, "layer_norm_backward: x is ", x.shape(),
              " but mean is ", mean.shape(), " and rstd ", rstd.shape());
  for (const View<const float, 1>& vector :
       {gamma, View<const float, 1>(dgamma), View<const float, 1>(dbeta)})
    LVGGT_CHECK(!vector || vector.extent(0) == C, "layer_norm_backward: x is ", x.shape(),
                " but a vector of its channels is ", vector.shape());
  if (dgamma || dbeta) {
    const std::int64_t grain = kernels::rows_per_sum(N), chunks = (N + grain - 1) / grain;
    Arena::Scope scope(ctx.arena());
    const View<float, 3> sums = ctx.arena().alloc(Shape{chunks, std::int64_t{2}, C});
    const auto row = kernels::parameters_function();
    parallel_chunks(
        chunks,
        [&](std::int64_t chunk, int) {
          const View<float, 2> sum = sums[chunk];
          std::fill_n(sum.data(), 2 * C, 0.0f);
          for (std::int64_t n = chunk * grain; n < std::min(N, (chunk + 1) * grain); ++n)
            row(dgamma ? sum[0].data() : nullptr, dbeta ? sum[1].data() : nullptr, dy[n].data(),
                mean[n], rstd[n], x[n].data(), C);
        },
        ctx);
    for (std::int64_t chunk = 0; chunk < chunks; ++chunk) {
      for (std::int64_t c = 0; c < C; ++c) {
        if (dgamma) dgamma[c] += sums(chunk, 0, c);
        if (dbeta) dbeta[c] += sums(chunk, 1, c);
      }
    }
  }
  if (dx.empty()) return;
  const auto row = kernels::backward_function();
  parallel_rows(
      N, kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n)
          row(dx[n].data(), dy[n].data(), mean[n], rstd[n], x[n].data(), gamma.data(), C);
      },
      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
