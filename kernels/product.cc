// SPDX-License-Identifier: Apache-2.0
#include "kernels/product.h"

#include <algorithm>

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/product.cc"
#include "hwy/foreach_target.h"
//
#include "hwy/highway.h"
#include "kernels/math-inl.h"
#include "kernels/simd-inl.h"
#include "kernels/tile-inl.h"

#ifndef LVGGT_PRODUCT_ONCE
#define LVGGT_PRODUCT_ONCE
namespace lvggt::kernels {

// A chunk is the unit of parallel work and of reuse: kChunkRows rows times kChunkPanels panels.
//  - its inputs for one K block (96 x 256 floats, 96 KiB) and its sums (96 x 384 floats, 144 KiB) stay in a
//    second-level cache of 512 KiB together with the panels in use;
//  - a panel line group is read from there once for all 96 rows;
//  - 782 tokens x 3072 channels give 72 chunks: enough for dozens of threads to balance.
inline constexpr std::int64_t kChunkRows = 96;  // a multiple of every tile's rows
inline constexpr std::int64_t kChunkPanels = 24;
// Lines of a panel summed before moving on: 256 lines of one panel are 16 KiB, half of a first-level cache.
inline constexpr std::int64_t kBlockK = 256;
// Row pitch of copied inputs: not a multiple of 4 KiB, so that rows do not compete for the same cache sets.
inline constexpr std::int64_t kInputPitch = kBlockK + 16;
inline constexpr std::int64_t kSumPitch = kChunkPanels * kPanelWidth + 16;

// What one worker needs for one chunk.
struct ChunkScratch {
  float* input = nullptr;             // [kChunkRows, kInputPitch]
  float* sums = nullptr;              // [kChunkRows, kSumPitch]
  const float** input_rows = nullptr;  // [kChunkRows]
};

}  // namespace lvggt::kernels
#endif

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

template <Activation kActivation>
HWY_INLINE hn::Vec<Floats> activate(Floats d, hn::Vec<Floats> x) {
  if constexpr (kActivation == Activation::kRelu) return hn::IfThenZeroElse(hn::Lt(x, hn::Zero(d)), x);
  if constexpr (kActivation == Activation::kGelu) return gelu(d, x);
  if constexpr (kActivation == Activation::kSilu) return silu(d, x);
  if constexpr (kActivation == Activation::kSigmoid) return sigmoid(d, x);
  return x;
}

// The epilogue of rows [first, last) of a chunk and channels [n0, n1).
template <Activation kActivation>
void finish(const Product& p, const RowTable& table, const float* HWY_RESTRICT sums, std::int64_t first,
            std::int64_t last, std::int64_t n0, std::int64_t n1) {
  const Floats d;
  for (std::int64_t r = first; r < last; ++r) {
    const float* HWY_RESTRICT sum = sums + r * kSumPitch;
    float* y = table.y[r];
    for (std::int64_t n = n0; n < n1; n += kLanes, sum += kLanes) {
      const std::int64_t left = n1 - n;
      auto v = hn::LoadU(d, sum);
      if (p.bias) v = hn::Add(v, load_first(d, p.bias + n, left));
      v = activate<kActivation>(d, v);
      if (p.gamma) v = hn::Mul(v, load_first(d, p.gamma + n, left));
      if (p.has_residual) v = hn::Add(v, load_first(d, table.residual[r] + n, left));
      store_first(v, d, y + n, left);
    }
  }
}

void finish_any(const Product& p, const RowTable& table, const float* sums, std::int64_t first,
                std::int64_t last, std::int64_t n0, std::int64_t n1) {
  switch (p.activation) {
    case Activation::kNone: return finish<Activation::kNone>(p, table, sums, first, last, n0, n1);
    case Activation::kRelu: return finish<Activation::kRelu>(p, table, sums, first, last, n0, n1);
    case Activation::kGelu: return finish<Activation::kGelu>(p, table, sums, first, last, n0, n1);
    case Activation::kSilu: return finish<Activation::kSilu>(p, table, sums, first, last, n0, n1);
    case Activation::kSigmoid: return finish<Activation::kSigmoid>(p, table, sums, first, last, n0, n1);
  }
}

// Copies [k0, k1) of the chunk's rows of one tap side by side, and points the row table there.
void copy_inputs(const RowTable& table, std::int64_t tap, std::int64_t k0, std::int64_t k1,
                 const ChunkScratch& scratch) {
  const Floats d;
  for (std::int64_t r = 0; r < table.capacity; ++r) {
    const float* HWY_RESTRICT from = table.x[tap * table.capacity + r] + k0;
    float* HWY_RESTRICT to = scratch.input + r * kInputPitch;
    std::int64_t k = 0;
    for (; k + kLanes <= k1 - k0; k += kLanes) hn::StoreU(hn::LoadU(d, from + k), d, to + k);
    for (; k < k1 - k0; ++k) to[k] = from[k];
    scratch.input_rows[r] = to;
  }
}

// One K block: `taps` taps of K values each, for all rows and panels of the chunk. The rows' table has
// row_stride addresses a tap; `lines` is where the block starts inside a panel.
void run_block(const Product& p, const RowTable& table, std::int64_t panel0, std::int64_t panel1,
               const float* const* rows, std::int64_t row_stride, std::int64_t taps, std::int64_t K,
               std::int64_t lines, bool is_first, bool is_last, const ChunkScratch& scratch) {
  const std::int64_t panel_stride = p.taps * p.K * kPanelWidth;
  for_panel_groups(panel1 - panel0, [&](std::int64_t first, std::int64_t count) HWY_ATTR {
    const float* panels = p.w->panels.data() + (panel0 + first) * panel_stride + lines * kPanelWidth;
    float* sums = scratch.sums + first * kPanelWidth;
    const std::int64_t n0 = (panel0 + first) * kPanelWidth;
    const std::int64_t n1 = std::min(p.w->N, n0 + count * kPanelWidth);
    for (std::int64_t r = 0; r < table.count; r += kTileRows) {
      float* out = sums + r * kSumPitch;
      if (is_first) {
        tile_of<false>(count, rows + r, row_stride, taps, K, panels, panel_stride, out, kSumPitch);
      } else {
        tile_of<true>(count, rows + r, row_stride, taps, K, panels, panel_stride, out, kSumPitch);
      }
      if (is_last) finish_any(p, table, sums, r, std::min(table.count, r + kTileRows), n0, n1);
    }
  });
}

// One chunk: all of K for the rows of the table and panels [panel0, panel1).
void run_chunk(const Product& p, const RowTable& table, std::int64_t panel0, std::int64_t panel1,
               const ChunkScratch& scratch) {
  const std::int64_t taps = p.taps;
  const std::int64_t K = p.K;
  if (K > kBlockK) {  // each tap in several blocks, its rows copied so that they lie densely
    const std::int64_t blocks = (K + kBlockK - 1) / kBlockK;
    for (std::int64_t t = 0; t < taps; ++t) {
      for (std::int64_t b = 0; b < blocks; ++b) {
        const std::int64_t k0 = K * b / blocks;
        const std::int64_t k1 = K * (b + 1) / blocks;
        copy_inputs(table, t, k0, k1, scratch);
        run_block(p, table, panel0, panel1, scratch.input_rows, 0, 1, k1 - k0, t * K + k0,
                  t == 0 && b == 0, t == taps - 1 && b == blocks - 1, scratch);
      }
    }
  } else {  // several taps in one block, read where they are
    const std::int64_t group = std::max<std::int64_t>(1, kBlockK / std::max<std::int64_t>(K, 1));
    for (std::int64_t t = 0; t < taps; t += group) {
      run_block(p, table, panel0, panel1, table.x + t * table.capacity, table.capacity,
                std::min(group, taps - t), K, t * K, t == 0, t + group >= taps, scratch);
    }
  }
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt::kernels {

HWY_EXPORT(run_chunk);

void run_product(const Product& product, FunctionRef<void(const RowTable&)> gather, Context& ctx) {
  const PackedMatrix& w = *product.w;
  const std::int64_t panels = num_panels(w.N);
  if (product.M == 0 || panels == 0) return;
  const std::int64_t row_chunks = (product.M + kChunkRows - 1) / kChunkRows;
  const std::int64_t panel_chunks = (panels + kChunkPanels - 1) / kChunkPanels;

  Arena::Scope scope(ctx.arena());
  const std::int64_t workers = ctx.num_threads();
  const auto inputs = ctx.arena().alloc(Shape{workers, kChunkRows, kInputPitch});
  const auto sums = ctx.arena().alloc(Shape{workers, kChunkRows, kSumPitch});
  const auto input_rows = ctx.arena().alloc<const float*>(Shape{workers, kChunkRows});
  const auto x_rows = ctx.arena().alloc<const float*>(Shape{workers, product.taps, kChunkRows});
  const auto y_rows = ctx.arena().alloc<float*>(Shape{workers, kChunkRows});
  const auto residual_rows = ctx.arena().alloc<const float*>(Shape{workers, kChunkRows});

  const auto run = HWY_DYNAMIC_DISPATCH(run_chunk);
  // Chunks of the same rows follow each other, so that a thread finds the rows in its cache.
  parallel_chunks(
      row_chunks * panel_chunks,
      [&](std::int64_t chunk, int worker) {
        RowTable table;
        table.begin = chunk / panel_chunks * kChunkRows;
        table.count = std::min(kChunkRows, product.M - table.begin);
        table.capacity = kChunkRows;
        table.x = x_rows[worker].data();
        table.y = y_rows[worker].data();
        table.residual = residual_rows[worker].data();
        gather(table);
        // Tiles read whole: the rows beyond the last one repeat it, and their sums are dropped.
        for (std::int64_t t = 0; t < product.taps; ++t) {
          const float** row = table.x + t * kChunkRows;
          std::fill(row + table.count, row + kChunkRows, row[table.count - 1]);
        }
        const std::int64_t panel0 = chunk % panel_chunks * kChunkPanels;
        run(product, table, panel0, std::min(panels, panel0 + kChunkPanels),
            {inputs[worker].data(), sums[worker].data(), input_rows[worker].data()});
      },
      ctx);
}

}  // namespace lvggt::kernels
#endif
