// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/batch_norm2d.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/batch_norm2d.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <algorithm>
#include <cmath>

#include "kernels/batch_norm2d-inl.h"
#include "kernels/grain.h"
#include "lvggt/core/parallel.h"

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(batch_sums_row);
HWY_EXPORT(normalize_row);
HWY_EXPORT(backward_sums_row);
HWY_EXPORT(backward_input_row);
auto batch_sums_function() { return HWY_DYNAMIC_DISPATCH(batch_sums_row); }
auto normalize_function() { return HWY_DYNAMIC_DISPATCH(normalize_row); }
auto backward_sums_function() { return HWY_DYNAMIC_DISPATCH(backward_sums_row); }
auto backward_input_function() { return HWY_DYNAMIC_DISPATCH(backward_input_row); }

void check_vectors(const char* op, const Shape<4>& x,
                   std::initializer_list<View<const float, 1>> vectors) {
  for (const View<const float, 1>& vector : vectors)
    LVGGT_CHECK(vector.extent(0) == x[3], op, ": x is ", x, " but a vector of its channels is ",
                vector.shape());
}
void check_map(const char* op, const char* name, const Shape<4>& map, const Shape<4>& x) {
  LVGGT_CHECK(map == x, op, ": x is ", x, " but ", name, " is ", map);
}
bool is_relu(const char* op, Activation activation) {
  LVGGT_CHECK(activation == Activation::kNone || activation == Activation::kRelu, op,
              ": the activation behind a batch norm is none or ReLU");
  return activation == Activation::kRelu;
}

// gamma rstd
View<float, 1> scale_of(View<const float, 1> gamma, View<const float, 1> rstd, Arena& arena) {
  const View<float, 1> scale = arena.alloc(gamma.shape());
  for (std::int64_t c = 0; c < gamma.extent(0); ++c) scale[c] = gamma[c] * rstd[c];
  return scale;
}

// The rows of pixels of the maps, row n = b H + h.
struct BatchNormMaps {
  View<float, 4> out;
  View<const float, 4> dy;
  View<const float, 4> x;

  std::int64_t rows() const { return x.extent(0) * x.extent(1); }
  BatchNormRow row(std::int64_t n) const {
    const std::int64_t b = n / x.extent(1), h = n % x.extent(1);
    return {out ? out[b][h].data() : nullptr,
            out ? out.stride(2) : 0,
            dy ? dy[b][h].data() : nullptr,
            dy ? dy.stride(2) : 0,
            x[b][h].data(),
            x.stride(2),
            x.extent(2)};
  }
};

// sums = the sum of add(sums, row) over all rows: at most 256 partial sums, added up in order.
template <class Add>
void sum_over_rows(View<double, 2> sums, const BatchNormMaps& maps, const Add& add, Context& ctx) {
  const std::int64_t C = maps.x.extent(3), rows = maps.rows();
  const std::int64_t grain = std::max(rows_per_chunk(maps.x.extent(2) * C), (rows + 255) / 256);
  const std::int64_t chunks = (rows + grain - 1) / grain;
  Arena::Scope scope(ctx.arena());
  const View<double, 2> partial = ctx.arena().alloc<double>(Shape{chunks, 2 * C});
  parallel_chunks(
      chunks,
      [&](std::int64_t chunk, int) {
        std::fill_n(partial[chunk].data(), 2 * C, 0.0);
        for (std::int64_t n = chunk * grain; n < std::min(rows, (chunk + 1) * grain); ++n)
          add(partial[chunk].data(), maps.row(n));
      },
      ctx);
  for (std::int64_t i = 0; i < 2; ++i) {
    for (std::int64_t c = 0; c < C; ++c) {
      sums(i, c) = 0;
      for (std::int64_t chunk = 0; chunk < chunks; ++chunk) sums(i, c) += partial(chunk, i * C + c);
    }
  }
}

template <class Run>
void for_each_row(const BatchNormMaps& maps, const Run& run, Context& ctx) {
  parallel_rows(
      maps.rows(), rows_per_chunk(maps.x.extent(2) * maps.x.extent(3)),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) run(maps.row(n));
      },
      ctx);
}

std::int64_t num_pixels(View<const float, 4> x) { return x.extent(0) * x.extent(1) * x.extent(2); }

}  // namespace
}  // namespace kernels

void batch_norm2d_fold(View<float, 4> weight, View<float, 1> bias, View<const float, 1> gamma,
                       View<const float, 1> beta, View<const float, 1> running_mean,
                       View<const float, 1> running_var, float eps) {
  const std::int64_t C = weight.extent(0);
  for (const View<const float, 1>& vector :
       {View<const float, 1>(bias), gamma, beta, running_mean, running_var})
    LVGGT_CHECK(vector.extent(0) == C, "batch_norm2d: weight is ", weight.shape(),
                " but a vector of its channels is ", vector.shape());
  for (std::int64_t c = 0; c < C; ++c) {
    // In double, so that the fold itself adds no more than one rounding to each value.
    const double scale = gamma[c] / std::sqrt(static_cast<double>(running_var[c]) + eps);
    for (std::int64_t i = 0; i < weight.extent(1); ++i)
      for (std::int64_t ky = 0; ky < weight.extent(2); ++ky)
        for (std::int64_t kx = 0; kx < weight.extent(3); ++kx)
          weight(c, i, ky, kx) = static_cast<float>(weight(c, i, ky, kx) * scale);
    bias[c] =
        static_cast<float>((static_cast<double>(bias[c]) - running_mean[c]) * scale + beta[c]);
  }
}

void batch_norm2d_sums(View<double, 2> sums, View<const float, 4> x, View<const float, 1> pivot,
                       Context& ctx) {
  const std::int64_t C = x.extent(3);
  LVGGT_CHECK(sums.shape() == (Shape{std::int64_t{2}, C}), "batch_norm2d_sums: sums are ",
              sums.shape(), " but x is ", x.shape());
  if (pivot) kernels::check_vectors("batch_norm2d_sums", x.shape(), {pivot});
  Arena::Scope scope(ctx.arena());
  const View<double, 1> wide = ctx.arena().alloc<double>(Shape{C});
  for (std::int64_t c = 0; c < C; ++c) wide[c] = pivot ? static_cast<double>(pivot[c]) : 0.0;
  const auto row_sums = kernels::batch_sums_function();
  kernels::sum_over_rows(
      sums, {{}, {}, x},
      [&](double* partial, const kernels::BatchNormRow& row) {
        row_sums(partial, row, wide.data(), C);
      },
      ctx);
}

void batch_norm2d_statistics(View<float, 1> mean, View<float, 1> rstd, View<float, 1> running_mean,
                             View<float, 1> running_var, View<const double, 2> sums,
                             View<const float, 1> pivot, std::int64_t count, float eps,
                             float momentum) {
  const std::int64_t C = sums.extent(1);
  LVGGT_CHECK(sums.extent(0) == 2 && mean.extent(0) == C && rstd.extent(0) == C &&
                  (!pivot || pivot.extent(0) == C) &&
                  (!running_mean || running_mean.extent(0) == C) &&
                  (!running_var || running_var.extent(0) == C),
              "batch_norm2d_statistics: sums are ", sums.shape(), " but mean is ", mean.shape(),
              ", rstd ", rstd.shape(), ", pivot ", pivot.shape(), ", running statistics ",
              running_mean.shape(), " and ", running_var.shape());
  LVGGT_CHECK(count >= 2, "batch_norm2d: a batch of ", count,
              " value a channel has no variance; take more frames or pixels, or frozen statistics");
  const double n = static_cast<double>(count);
  for (std::int64_t c = 0; c < C; ++c) {
    const double offset = sums(0, c) / n;
    const double center = (pivot ? static_cast<double>(pivot[c]) : 0.0) + offset;
    // Rounding may leave a constant channel a hair below zero; NaN stays NaN.
    const double difference = sums(1, c) / n - offset * offset;
    const double var = difference < 0 ? 0 : difference;
    mean[c] = static_cast<float>(center);
    rstd[c] = static_cast<float>(1 / std::sqrt(var + static_cast<double>(eps)));
    if (running_mean)
      running_mean[c] = static_cast<float>(running_mean[c] + momentum * (center - running_mean[c]));
    if (running_var)
      running_var[c] =
          static_cast<float>(running_var[c] + momentum * (var * n / (n - 1) - running_var[c]));
  }
}

void batch_norm2d_normalize(View<float, 4> y, View<const float, 4> x, View<const float, 1> mean,
                            View<const float, 1> rstd, View<const float, 1> gamma,
                            View<const float, 1> beta, Activation activation, Context& ctx) {
  kernels::check_map("batch_norm2d", "y", y.shape(), x.shape());
  kernels::check_vectors("batch_norm2d", x.shape(), {mean, rstd, gamma, beta});
  const bool relu = kernels::is_relu("batch_norm2d", activation);
  Arena::Scope scope(ctx.arena());
  const View<const float, 1> scale = kernels::scale_of(gamma, rstd, ctx.arena());
  const kernels::BatchNormChannels channels{mean.data(), rstd.data(), scale.data(), beta.data(),
                                            nullptr,     nullptr,     x.extent(3)};
  const auto normalize = kernels::normalize_function();
  kernels::for_each_row(
      {y, {}, x}, [&](const kernels::BatchNormRow& row) { normalize(row, channels, relu); }, ctx);
}

void batch_norm2d_forward(View<float, 4> y, View<float, 1> mean, View<float, 1> rstd,
                          View<float, 1> running_mean, View<float, 1> running_var,
                          View<const float, 4> x, View<const float, 1> gamma,
                          View<const float, 1> beta, float eps, float momentum,
                          Activation activation, Context& ctx) {
  LVGGT_CHECK(x.size() > 0, "batch_norm2d: x is empty, ", x.shape());
  const std::int64_t C = x.extent(3);
  // The first pixel is as near the data as any, and makes the variance of a constant exactly zero.
  const View<const float, 1> pivot = x[0][0][0];
  Arena::Scope scope(ctx.arena());
  const View<double, 2> sums = ctx.arena().alloc<double>(Shape{std::int64_t{2}, C});
  batch_norm2d_sums(sums, x, pivot, ctx);
  batch_norm2d_statistics(mean, rstd, running_mean, running_var, sums, pivot,
                          kernels::num_pixels(x), eps, momentum);
  batch_norm2d_normalize(y, x, mean, rstd, gamma, beta, activation, ctx);
}

void batch_norm2d_rstd(View<float, 1> rstd, View<const float, 1> var, float eps) {
  LVGGT_CHECK(rstd.shape() == var.shape(), "batch_norm2d_rstd: rstd is ", rstd.shape(),
              " but var is ", var.shape());
  for (std::int64_t c = 0; c < var.extent(0); ++c)
    rstd[c] = static_cast<float>(1 / std::sqrt(static_cast<double>(var[c]) + eps));
}

void batch_norm2d_backward_sums(View<double, 2> sums, View<const float, 4> dy,
                                View<const float, 1> mean, View<const float, 1> rstd,
                                View<const float, 4> x, View<const float, 1> gamma,
                                View<const float, 1> beta, Activation activation, Context& ctx) {
  LVGGT_CHECK(sums.shape() == (Shape{std::int64_t{2}, x.extent(3)}),
              "batch_norm2d_backward: sums are ", sums.shape(), " but x is ", x.shape());
  kernels::check_map("batch_norm2d_backward", "dy", dy.shape(), x.shape());
  kernels::check_vectors("batch_norm2d_backward", x.shape(), {mean, rstd, gamma, beta});
  const bool relu = kernels::is_relu("batch_norm2d_backward", activation);
  Arena::Scope scope(ctx.arena());
  const View<const float, 1> scale = kernels::scale_of(gamma, rstd, ctx.arena());
  const kernels::BatchNormChannels channels{mean.data(), rstd.data(), scale.data(), beta.data(),
                                            nullptr,     nullptr,     x.extent(3)};
  const auto row_sums = kernels::backward_sums_function();
  kernels::sum_over_rows(
      sums, {{}, dy, x},
      [&](double* partial, const kernels::BatchNormRow& row) {
        row_sums(partial, row, channels, relu);
      },
      ctx);
}

void batch_norm2d_backward_parameters(View<float, 1> dgamma, View<float, 1> dbeta,
                                      View<const double, 2> sums) {
  const std::int64_t C = sums.extent(1);
  LVGGT_CHECK(
      sums.extent(0) == 2 && (!dgamma || dgamma.extent(0) == C) && (!dbeta || dbeta.extent(0) == C),
      "batch_norm2d_backward: sums are ", sums.shape(), " but dgamma is ", dgamma.shape(),
      " and dbeta ", dbeta.shape());
  for (std::int64_t c = 0; c < C; ++c) {
    if (dgamma) dgamma[c] += static_cast<float>(sums(1, c));
    if (dbeta) dbeta[c] += static_cast<float>(sums(0, c));
  }
}

void batch_norm2d_backward_input(View<float, 4> dx, View<const float, 4> dy,
                                 View<const double, 2> sums, std::int64_t count,
                                 View<const float, 1> mean, View<const float, 1> rstd,
                                 View<const float, 4> x, View<const float, 1> gamma,
                                 View<const float, 1> beta, Activation activation, Context& ctx) {
  const std::int64_t C = x.extent(3);
  kernels::check_map("batch_norm2d_backward", "dx", dx.shape(), x.shape());
  kernels::check_map("batch_norm2d_backward", "dy", dy.shape(), x.shape());
  kernels::check_vectors("batch_norm2d_backward", x.shape(), {mean, rstd, gamma, beta});
  LVGGT_CHECK(!sums || sums.shape() == (Shape{std::int64_t{2}, C}),
              "batch_norm2d_backward: sums are ", sums.shape(), " but x is ", x.shape());
  const bool relu = kernels::is_relu("batch_norm2d_backward", activation);
  Arena::Scope scope(ctx.arena());
  const View<const float, 1> scale = kernels::scale_of(gamma, rstd, ctx.arena());
  kernels::BatchNormChannels channels{
      mean.data(), rstd.data(), scale.data(), beta.data(), nullptr, nullptr, C};
  if (sums) {
    const View<float, 2> averages = ctx.arena().alloc(Shape{std::int64_t{2}, C});
    for (std::int64_t i = 0; i < 2; ++i)
      for (std::int64_t c = 0; c < C; ++c)
        averages(i, c) = static_cast<float>(sums(i, c) / static_cast<double>(count));
    channels.avg_g = averages[0].data();
    channels.avg_gn = averages[1].data();
  }
  const auto backward = kernels::backward_input_function();
  kernels::for_each_row(
      {dx, dy, x}, [&](const kernels::BatchNormRow& row) { backward(row, channels, relu); }, ctx);
}

void batch_norm2d_backward(View<float, 4> dx, View<float, 1> dgamma, View<float, 1> dbeta,
                           View<const float, 4> dy, View<const float, 1> mean,
                           View<const float, 1> rstd, View<const float, 4> x,
                           View<const float, 1> gamma, View<const float, 1> beta,
                           Activation activation, Context& ctx) {
  Arena::Scope scope(ctx.arena());
  const View<double, 2> sums = ctx.arena().alloc<double>(Shape{std::int64_t{2}, x.extent(3)});
  batch_norm2d_backward_sums(sums, dy, mean, rstd, x, gamma, beta, activation, ctx);
  batch_norm2d_backward_parameters(dgamma, dbeta, sums);
  if (dx)
    batch_norm2d_backward_input(dx, dy, sums, kernels::num_pixels(x), mean, rstd, x, gamma, beta,
                                activation, ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
