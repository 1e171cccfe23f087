// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/interpolate.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/interpolate.cc"
#include <hwy/cache_control.h>
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <algorithm>
#include <cmath>

#include "kernels/linear_taps.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// y = (1 - weight) a + weight b
HWY_INLINE void blend(float* HWY_RESTRICT y, const float* a, const float* b, float weight,
                      std::int64_t C) {
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    const auto from_a = hn::Mul(hn::LoadU(d, a + i), hn::Set(d, 1.0f - weight));
    hn::StoreU(hn::MulAdd(hn::LoadU(d, b + i), hn::Set(d, weight), from_a), d, y + i);
  });
}

// The same, written past the caches; y must be aligned and C a multiple of the vector.
HWY_INLINE void blend_streaming(float* HWY_RESTRICT y, const float* a, const float* b, float weight,
                                std::int64_t C) {
  const hn::ScalableTag<float> d;
  for (std::int64_t i = 0; i < C; i += static_cast<std::int64_t>(hn::Lanes(d))) {
    const auto from_a = hn::Mul(hn::LoadU(d, a + i), hn::Set(d, 1.0f - weight));
    hn::Stream(hn::MulAdd(hn::LoadU(d, b + i), hn::Set(d, weight), from_a), d, y + i);
  }
}

// One output row from two input rows. The two input columns around an output pixel are blended
// vertically into `columns` [2, C], which stays in L1, and are kept while the next output pixel
// needs them: when enlarging, every input value is read from memory once and every output pixel
// costs one horizontal blend.
void bilinear_row(float* HWY_RESTRICT y, std::int64_t y_step, std::int64_t Wo, std::int64_t C,
                  const float* upper, const float* lower, std::int64_t x_step, float weight,
                  const LinearTap* taps, float* columns, bool past_caches) {
  const std::int64_t lanes = static_cast<std::int64_t>(hn::Lanes(hn::ScalableTag<float>()));
  const bool streaming =
      past_caches && C % lanes == 0 && y_step % lanes == 0 &&
      reinterpret_cast<std::uintptr_t>(y) % (sizeof(float) * static_cast<std::uintptr_t>(lanes)) ==
          0;
  float* left = columns;
  float* right = columns + C;
  std::int64_t left_idx = -1, right_idx = -1;
  for (std::int64_t i = 0; i < Wo; ++i) {
    const LinearTap tap = taps[i];
    if (tap.low == right_idx && left_idx != tap.low) {
      std::swap(left, right);
      std::swap(left_idx, right_idx);
    }
    if (tap.low != left_idx) {
      blend(left, upper + tap.low * x_step, lower + tap.low * x_step, weight, C);
      left_idx = tap.low;
    }
    if (tap.high != right_idx) {
      blend(right, upper + tap.high * x_step, lower + tap.high * x_step, weight, C);
      right_idx = tap.high;
    }
    if (streaming) {
      blend_streaming(y + i * y_step, left, right, tap.weight, C);
    } else {
      blend(y + i * y_step, left, right, tap.weight, C);
    }
  }
  if (streaming) hwy::FlushStream();
}

// y[c] = sum over j of weights[j] x[j * tap_step + c]
void weighted_sum(float* HWY_RESTRICT y, const float* HWY_RESTRICT x, std::int64_t tap_step,
                  const float* HWY_RESTRICT weights, std::int64_t num_taps, std::int64_t C) {
  for_each_vector(C, [=](auto d, std::int64_t c) HWY_ATTR {
    auto sum = hn::Zero(d);
    for (std::int64_t j = 0; j < num_taps; ++j)
      sum = hn::MulAdd(hn::LoadU(d, x + j * tap_step + c), hn::Set(d, weights[j]), sum);
    hn::StoreU(sum, d, y + c);
  });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(bilinear_row);
HWY_EXPORT(weighted_sum);
// Outputs of at least 32 MiB would be evicted before they are read again: writing them past the
// caches saves fetching each line first (168x296 to 294x518, 256 channels, 2 threads: 14 ms against
// 26).
constexpr std::int64_t kStreamingElements = std::int64_t{1} << 23;

auto bilinear_row_function() { return &HWY_DYNAMIC_DISPATCH(bilinear_row); }
auto weighted_sum_function() { return &HWY_DYNAMIC_DISPATCH(weighted_sum); }

// Output index i of one axis is the sum over j < count[i] of weights[i][j] * input[first[i] + j].
struct CubicTaps {
  View<std::int64_t, 1> first;
  View<std::int64_t, 1> count;
  View<float, 2> weights;
};

// The cubic convolution kernel with a = -1/2.
double cubic(double t) {
  constexpr double a = -0.5;
  t = std::abs(t);
  if (t < 1) return ((a + 2) * t - (a + 3)) * t * t + 1;
  if (t < 2) return ((a * t - 5 * a) * t + 8 * a) * t - 4 * a;
  return 0;
}

CubicTaps cubic_taps(std::int64_t out, std::int64_t in, Arena& arena) {
  const double scale = static_cast<double>(in) / static_cast<double>(out);
  const double stretch = std::max(scale, 1.0);  // shrinking widens the kernel to average
  const double support = 2.0 * stretch;
  const auto most = std::min(in, static_cast<std::int64_t>(std::ceil(2 * support)) + 1);
  const CubicTaps taps{arena.alloc<std::int64_t>(Shape{out}), arena.alloc<std::int64_t>(Shape{out}),
                       arena.alloc<float>(Shape{out, most})};
  for (std::int64_t i = 0; i < out; ++i) {
    const double center = scale * (static_cast<double>(i) + 0.5);
    const auto first = std::max<std::int64_t>(0, static_cast<std::int64_t>(center - support + 0.5));
    const auto last = std::min(in, static_cast<std::int64_t>(center + support + 0.5));
    const auto weight = [&](std::int64_t j) {
      return cubic((static_cast<double>(j) + 0.5 - center) / stretch);
    };
    double total = 0;
    for (std::int64_t j = first; j < last; ++j) total += weight(j);
    for (std::int64_t j = first; j < last; ++j)
      taps.weights(i, j - first) = static_cast<float>(weight(j) / total);
    taps.first[i] = first;
    taps.count[i] = last - first;
  }
  return taps;
}

}  // namespace
}  // namespace kernels

void bilinear_forward(View<float, 4> y, View<const float, 4> x, bool align_corners, Context& ctx) {
  const std::int64_t B = y.extent(0), Ho = y.extent(1), Wo = y.extent(2), C = y.extent(3);
  LVGGT_CHECK(x.extent(0) == B && x.extent(3) == C, "bilinear: y is ", y.shape(), " but x is ",
              x.shape());
  if (y.size() == 0) return;
  LVGGT_CHECK(x.size() > 0, "bilinear: x is empty, ", x.shape());
  const Arena::Scope scope(ctx.arena());
  const auto rows = kernels::linear_taps(Ho, x.extent(1), align_corners, ctx.arena());
  const auto taps = kernels::linear_taps(Wo, x.extent(2), align_corners, ctx.arena());
  const auto columns = ctx.arena().alloc<float>(Shape{std::int64_t{ctx.num_threads()}, 2 * C});
  const auto row = kernels::bilinear_row_function();
  const bool past_caches = y.size() >= kernels::kStreamingElements;
  // Up to eight neighbouring output rows to a chunk share their input rows in L2; at least 16
  // chunks, if there are as many rows, to balance the threads.
  const std::int64_t grain = std::clamp<std::int64_t>(B * Ho / 16, 1, 8);
  parallel_chunks((B * Ho + grain - 1) / grain,
                  [&](std::int64_t chunk, int worker) {
                    for (std::int64_t n = chunk * grain; n < std::min(B * Ho, (chunk + 1) * grain);
                         ++n) {
                      const auto& tap = rows[n % Ho];
                      const auto image = x[n / Ho];
                      row(y[n / Ho][n % Ho].data(), y.stride(2), Wo, C, image[tap.low].data(),
                          image[tap.high].data(), x.stride(2), tap.weight, taps.data(),
                          columns[worker].data(), past_caches);
                    }
                  },
                  ctx);
}

void bicubic_antialias_forward(View<float, 3> y, View<const float, 3> x, Context& ctx) {
  const std::int64_t Ho = y.extent(0), Wo = y.extent(1), C = y.extent(2), H = x.extent(0);
  LVGGT_CHECK(x.extent(2) == C, "bicubic: y is ", y.shape(), " but x is ", x.shape());
  if (y.size() == 0) return;
  LVGGT_CHECK(x.size() > 0, "bicubic: x is empty, ", x.shape());
  const Arena::Scope scope(ctx.arena());
  const auto across = kernels::cubic_taps(Wo, x.extent(1), ctx.arena());
  const auto down = kernels::cubic_taps(Ho, H, ctx.arena());
  const auto narrowed = ctx.arena().alloc<float>(Shape{H, Wo, C});
  const auto weighted_sum = kernels::weighted_sum_function();
  parallel_rows(
      H * Wo, 16,
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) {
          const std::int64_t h = n / Wo, w = n % Wo;
          weighted_sum(narrowed[h][w].data(), x[h][across.first[w]].data(), x.stride(1),
                       across.weights[w].data(), across.count[w], C);
        }
      },
      ctx);
  parallel_rows(
      Ho * Wo, 16,
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n) {
          const std::int64_t h = n / Wo, w = n % Wo;
          weighted_sum(y[h][w].data(), narrowed[down.first[h]][w].data(), Wo * C,
                       down.weights[h].data(), down.count[h], C);
        }
      },
      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
