// SPDX-License-Identifier: Apache-2.0
#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/bilinear_backward.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <algorithm>

#include "kernels/linear_taps.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"
#include "lvggt/kernels/interpolate.h"

#ifndef LVGGT_KERNELS_BILINEAR_BACKWARD_ONCE
#define LVGGT_KERNELS_BILINEAR_BACKWARD_ONCE
namespace lvggt::kernels {

// One output row, and the weight with which the input row at hand entered it.
struct WeightedRow {
  const float* dy;
  float weight;
};

}  // namespace lvggt::kernels
#endif

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// One input row: the gradients of the output rows that read it are summed with their weights, pixel
// by pixel, and each sum goes to the two input pixels it was blended from.
//   dx: [W, C], zeroed here   rows: num_rows of [Wo, C]
void bilinear_backward_row(float* dx, std::int64_t dx_step, std::int64_t W,
                           const WeightedRow* HWY_RESTRICT rows, std::int64_t num_rows,
                           std::int64_t dy_step, const LinearTap* HWY_RESTRICT taps,
                           std::int64_t Wo, std::int64_t C) {
  for (std::int64_t w = 0; w < W; ++w) std::fill_n(dx + w * dx_step, C, 0.0f);
  for (std::int64_t i = 0; i < Wo; ++i) {
    float* low = dx + taps[i].low * dx_step;
    float* high = dx + taps[i].high * dx_step;
    const float weight = taps[i].weight;
    for_each_vector(C, [=](auto d, std::int64_t c) HWY_ATTR {
      auto sum = hn::Zero(d);
      for (std::int64_t r = 0; r < num_rows; ++r)
        sum =
            hn::MulAdd(hn::LoadU(d, rows[r].dy + i * dy_step + c), hn::Set(d, rows[r].weight), sum);
      // One after the other: at the border both are the same pixel.
      hn::StoreU(hn::MulAdd(sum, hn::Set(d, 1.0f - weight), hn::LoadU(d, low + c)), d, low + c);
      hn::StoreU(hn::MulAdd(sum, hn::Set(d, weight), hn::LoadU(d, high + c)), d, high + c);
    });
  }
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(bilinear_backward_row);
auto bilinear_backward_row_function() { return HWY_DYNAMIC_DISPATCH(bilinear_backward_row); }

// readers[h] .. readers[h + 1]: the output rows whose low or high row may be h. Both never
// decrease, so these are one range an input row.
View<std::int64_t, 2> rows_that_read(View<const LinearTap, 1> taps, std::int64_t H, Arena& arena) {
  const View<std::int64_t, 2> readers = arena.alloc<std::int64_t>(Shape{H, std::int64_t{2}});
  const std::int64_t Ho = taps.extent(0);
  std::int64_t first = 0, last = 0;
  for (std::int64_t h = 0; h < H; ++h) {
    while (first < Ho && taps[first].high < h) ++first;
    while (last < Ho && taps[last].low <= h) ++last;
    readers(h, 0) = first;
    readers(h, 1) = last;
  }
  return readers;
}

}  // namespace
}  // namespace kernels

void bilinear_backward(View<float, 4> dx, View<const float, 4> dy, bool align_corners,
                       Context& ctx) {
  const std::int64_t B = dx.extent(0), H = dx.extent(1), W = dx.extent(2), C = dx.extent(3);
  LVGGT_CHECK(dy.extent(0) == B && dy.extent(3) == C, "bilinear_backward: dx is ", dx.shape(),
              " but dy is ", dy.shape());
  if (dx.size() == 0) {
    LVGGT_CHECK(dy.size() == 0, "bilinear_backward: dx is empty, ", dx.shape());
    return;
  }
  const std::int64_t Ho = dy.extent(1), Wo = dy.extent(2);
  const Arena::Scope scope(ctx.arena());
  const View<const kernels::LinearTap, 1> rows =
      kernels::linear_taps(Ho, H, align_corners, ctx.arena());
  const View<const kernels::LinearTap, 1> columns =
      kernels::linear_taps(Wo, W, align_corners, ctx.arena());
  const View<const std::int64_t, 2> readers = kernels::rows_that_read(rows, H, ctx.arena());
  const View<kernels::WeightedRow, 2> weighted =
      ctx.arena().alloc<kernels::WeightedRow>(Shape{std::int64_t{ctx.num_threads()}, Ho});
  const auto run = kernels::bilinear_backward_row_function();
  // Neighbouring input rows share an output row: a few to a chunk find it in the cache.
  const std::int64_t grain = std::clamp<std::int64_t>(B * H / 16, 1, 8);
  parallel_chunks(
      (B * H + grain - 1) / grain,
      [&](std::int64_t chunk, int worker) {
        for (std::int64_t n = chunk * grain; n < std::min(B * H, (chunk + 1) * grain); ++n) {
          const std::int64_t b = n / H, h = n % H;
          const View<kernels::WeightedRow, 1> list = weighted[worker];
          std::int64_t count = 0;
          for (std::int64_t o = readers(h, 0); o < readers(h, 1); ++o) {
            const kernels::LinearTap& tap = rows[o];
            const float weight =
                (tap.low == h ? 1.0f - tap.weight : 0.0f) + (tap.high == h ? tap.weight : 0.0f);
            if (weight != 0) list[count++] = {dy[b][o].data(), weight};
          }
          run(dx[b][h].data(), dx.stride(2), W, list.data(), count, dy.stride(2), columns.data(),
              Wo, C);
        }
      },
      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
