// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <cmath>
#include <cstring>

#include "kernels/product.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/product_int8.cc"
#include "hwy/foreach_target.h"
//
#include "hwy/highway.h"
#include "kernels/epilogue-inl.h"
#include "kernels/simd-inl.h"
#include "kernels/tile-inl.h"

#ifndef LVGGT_PRODUCT_INT8_ONCE
#define LVGGT_PRODUCT_INT8_ONCE
namespace lvggt::kernels {

// Activations are stored as unsigned bytes q + 128, because the integer dot products take one
// unsigned side; 128 times the channel's weight sum is taken off again at the end.
inline constexpr std::int32_t kActivationZero = 128;
// Quads (4 neighbours of K) summed before moving on: 256 of one panel are 16 KiB, half of a
// first-level cache.
inline constexpr std::int64_t kBlockQuads = 256;

// The rows of x as integers.
struct QuantizedRows {
  const std::uint8_t* values = nullptr;  // [M, pitch]
  std::int64_t pitch = 0;                // bytes
  const float* scales = nullptr;         // [M]
};

}  // namespace lvggt::kernels
#endif

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// As kTileRows, less what the two-step dot product of 16 registers needs: 4 x 2 sums, 2 lines, a
// row's bytes, the pair sums and a vector of ones.
inline constexpr int kInt8Rows = kLanes == 16 ? 8 : kLanes == 8 ? 4 : 2;

// q = round(x / scale) + 128 with scale = largest magnitude / 127; a row of zeros has scale 0. NaN
// and infinity make the scale, and with it the whole row of the product, NaN.
void quantize_row(const float* HWY_RESTRICT x, std::int64_t K, std::uint8_t* HWY_RESTRICT q,
                  float* scale) {
  const Floats d;
  const Ints di;
  auto largest = hn::Zero(d);
  auto poison = hn::Zero(d);  // x - x: 0, or NaN for NaN and infinity
  for (std::int64_t k = 0; k < K; k += kLanes) {
    const auto v = load_first(d, x + k, K - k);
    largest = hn::Max(largest, hn::Abs(v));
    poison = hn::Add(poison, hn::Sub(v, v));
  }
  const float top =
      hn::GetLane(hn::MaxOfLanes(d, largest)) + hn::GetLane(hn::SumOfLanes(d, poison));
  *scale = top / 127;
  const auto inverse = hn::Set(d, top > 0 ? 127 / top : 0.0f);
  const auto zero = hn::Set(di, kActivationZero);
  const hn::Rebind<std::uint8_t, Floats> db;
  for (std::int64_t k = 0; k < K; k += kLanes) {  // the row's pitch has room for whole vectors
    const auto v = hn::NearestInt(hn::Mul(load_first(d, x + k, K - k), inverse));
    hn::StoreU(hn::DemoteTo(db, hn::Add(v, zero)), db, q + k);
  }
}

// out[r][n] (+)= sum over quads of rows[r] . panels[n]; as tile(), in integers.
template <int kPanels, bool kAccumulate>
HWY_NOINLINE void int8_tile(const std::uint8_t* HWY_RESTRICT rows, std::int64_t pitch,
                            std::int64_t quads, const std::int8_t* HWY_RESTRICT panels,
                            std::int64_t panel_stride, std::int32_t* HWY_RESTRICT out) {
  constexpr int kVectors = kPanels * kPanelVectors;
  const Ints d;
  hn::Vec<Ints> sum[kInt8Rows][kVectors];
#pragma GCC unroll 8
  for (int r = 0; r < kInt8Rows; ++r) {
#pragma GCC unroll 8
    for (int v = 0; v < kVectors; ++v) {
      sum[r][v] = kAccumulate ? hn::LoadU(d, out + r * kSumPitch + v * kLanes) : hn::Zero(d);
    }
  }
  for (std::int64_t k = 0; k < quads; ++k) {
    hn::Vec<Ints> b[kVectors];
#pragma GCC unroll 8
    for (int v = 0; v < kVectors; ++v) {
      const std::int8_t* line = panels + (v / kPanelVectors) * panel_stride + k * kPanelWidth * 4;
      b[v] =
          hn::LoadU(d, reinterpret_cast<const std::int32_t*>(line) + (v % kPanelVectors) * kLanes);
    }
#pragma GCC unroll 8
    for (int r = 0; r < kInt8Rows; ++r) {
      std::int32_t quad;
      std::memcpy(&quad, rows + r * pitch + k * 4, 4);
      const auto a = hn::Set(d, quad);
#pragma GCC unroll 8
      for (int v = 0; v < kVectors; ++v) sum[r][v] = dot4(d, sum[r][v], a, b[v]);
    }
  }
#pragma GCC unroll 8
  for (int r = 0; r < kInt8Rows; ++r) {
#pragma GCC unroll 8
    for (int v = 0; v < kVectors; ++v) hn::StoreU(sum[r][v], d, out + r * kSumPitch + v * kLanes);
  }
}

template <bool kAccumulate>
HWY_INLINE void int8_tile_of(std::int64_t num_panels, const std::uint8_t* rows, std::int64_t pitch,
                             std::int64_t quads, const std::int8_t* panels,
                             std::int64_t panel_stride, std::int32_t* out) {
  if constexpr (kTilePanels >= 3) {
    if (num_panels == 3)
      return int8_tile<3, kAccumulate>(rows, pitch, quads, panels, panel_stride, out);
    if (num_panels == 2)
      return int8_tile<2, kAccumulate>(rows, pitch, quads, panels, panel_stride, out);
  }
  int8_tile<1, kAccumulate>(rows, pitch, quads, panels, panel_stride, out);
}

// Integer sums to floats, in place: (sum - 128 weight_sum) * row scale * channel scale.
void dequantize(const Product& p, const QuantizedRows& x, std::int64_t row0, std::int64_t first,
                std::int64_t last, std::int64_t n0, std::int64_t channels, float* sums) {
  const Floats d;
  const Ints di;
  for (std::int64_t r = first; r < last; ++r) {
    const auto row_scale = hn::Set(d, x.scales[row0 + r]);
    float* row = sums + r * kSumPitch;
    for (std::int64_t i = 0; i < channels; i += kLanes) {
      const auto sum = hn::BitCast(di, hn::LoadU(d, row + i));
      const auto offset =
          hn::Mul(hn::LoadU(di, p.w.weight_sums + n0 + i), hn::Set(di, kActivationZero));
      const auto scale = hn::Mul(row_scale, hn::LoadU(d, p.w.scales + n0 + i));
      hn::StoreU(hn::Mul(hn::ConvertTo(d, hn::Sub(sum, offset)), scale), d, row + i);
    }
  }
}

std::int64_t int8_tile_rows() { return kInt8Rows; }

// One chunk: all of K for the rows of the table and panels [panel0, panel1).
void run_int8_chunk(const Product& p, const QuantizedRows& x, const RowTable& table,
                    std::int64_t panel0, std::int64_t panel1, float* sums) {
  const std::int64_t quads = (p.K + 3) / 4;
  const std::int64_t panel_stride = quads * kPanelWidth * 4;
  const std::uint8_t* rows = x.values + table.begin * x.pitch;
  for (std::int64_t k = 0; k < quads; k += kBlockQuads) {
    const std::int64_t count_k = std::min(kBlockQuads, quads - k);
    for_panel_groups(panel1 - panel0, [&](std::int64_t first, std::int64_t count) HWY_ATTR {
      const auto* panels = reinterpret_cast<const std::int8_t*>(p.w.panels) +
                           (panel0 + first) * panel_stride + k * kPanelWidth * 4;
      const std::int64_t n0 = (panel0 + first) * kPanelWidth;
      float* group = sums + first * kPanelWidth;
      for (std::int64_t r = 0; r < table.count; r += kInt8Rows) {
        auto* out = reinterpret_cast<std::int32_t*>(group + r * kSumPitch);
        const std::uint8_t* row = rows + r * x.pitch + k * 4;
        if (k == 0) {
          int8_tile_of<false>(count, row, x.pitch, count_k, panels, panel_stride, out);
        } else {
          int8_tile_of<true>(count, row, x.pitch, count_k, panels, panel_stride, out);
        }
        if (k + count_k < quads) continue;
        const std::int64_t last = std::min(table.count, r + kInt8Rows);
        dequantize(p, x, table.begin, r, last, n0, count * kPanelWidth, group);
        finish_any(p, table, group, r, last, n0, std::min(p.w.N, n0 + count * kPanelWidth));
      }
    });
  }
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt::kernels {

HWY_EXPORT(quantize_row);
HWY_EXPORT(run_int8_chunk);
HWY_EXPORT(int8_tile_rows);

void run_product_int8(const Product& product, View<const float, 2> x,
                      FunctionRef<void(const RowTable&)> gather, Context& ctx) {
  const std::int64_t M = product.M, K = product.K;
  const std::int64_t panels = num_panels(product.w.N);
  if (M == 0 || panels == 0) return;
  Arena::Scope scope(ctx.arena());
  // Room for a whole vector beyond K; an odd number of cache lines, so that rows do not compete for
  // the same sets. Tiles read whole: a few rows beyond the last one are there to be read, and their
  // sums dropped.
  const std::int64_t pitch = ((K + 16 + 63) / 64 | 1) * 64;
  const auto values = ctx.arena().alloc<std::uint8_t>(Shape{M + 8, pitch});
  const auto scales = ctx.arena().alloc(Shape{M});
  std::memset(values[M].data(), 0, static_cast<std::size_t>(8 * pitch));
  const auto quantize = HWY_DYNAMIC_DISPATCH(quantize_row);
  parallel_rows(
      M, 16,
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t m = begin; m < end; ++m)
          quantize(x.data() + m * x.stride(0), K, values[m].data(), &scales[m]);
      },
      ctx);

  const QuantizedRows quantized{values.data(), pitch, scales.data()};
  const std::int64_t workers = ctx.num_threads();
  const auto sums = ctx.arena().alloc(Shape{workers, kChunkRows, kSumPitch});
  const auto x_rows = ctx.arena().alloc<const float*>(Shape{workers, kChunkRows});
  const auto y_rows = ctx.arena().alloc<float*>(Shape{workers, kChunkRows});
  const auto residual_rows = ctx.arena().alloc<const float*>(Shape{workers, kChunkRows});
  const Chunks chunks = plan_chunks(M, panels, HWY_DYNAMIC_DISPATCH(int8_tile_rows)(), workers);
  const auto run = HWY_DYNAMIC_DISPATCH(run_int8_chunk);
  parallel_chunks(
      chunks.count(),
      [&](std::int64_t chunk, int worker) {
        const Chunks::Range rows = chunks.rows_of(chunk);
        RowTable table;
        table.begin = rows.begin;
        table.count = rows.end - rows.begin;
        table.worker = worker;
        table.capacity = kChunkRows;
        table.x = x_rows[worker].data();
        table.y = y_rows[worker].data();
        table.residual = residual_rows[worker].data();
        gather(table);
        const Chunks::Range panel_range = chunks.panels_of(chunk);
        run(product, quantized, table, panel_range.begin, panel_range.end, sums[worker].data());
      },
      ctx);
}

}  // namespace lvggt::kernels
#endif
