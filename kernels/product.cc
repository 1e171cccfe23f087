// SPDX-License-Identifier: Apache-2.0
#include "kernels/product.h"

#include <algorithm>

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/product.cc"
#include "hwy/foreach_target.h"
//
#include "hwy/highway.h"
#include "kernels/epilogue-inl.h"
#include "kernels/prefetch-inl.h"
#include "kernels/simd-inl.h"
#include "kernels/storage-inl.h"
#include "kernels/tile-inl.h"

#ifndef LVGGT_PRODUCT_ONCE
#define LVGGT_PRODUCT_ONCE
namespace lvggt::kernels {

// What one worker needs for one chunk.
struct ChunkScratch {
  float* sums = nullptr;     // [kChunkRows, kSumPitch]
  float* widened = nullptr;  // [kTilePanels, kMostLines, 16]: lines of narrow weights as floats
};
// Panels of the widest tile of any instruction set.
inline constexpr std::int64_t kMaxTilePanels = 3;

}  // namespace lvggt::kernels
#endif

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

struct Panels {
  const float* lines;
  std::int64_t stride;  // floats between two panels
};

// Lines [line, line + num_lines) of `count` panels from `panel` on, widened if they are stored
// narrow.
Panels block_panels(const Product& p, std::int64_t panel, std::int64_t count, std::int64_t line,
                    std::int64_t num_lines, const ChunkScratch& scratch) {
  const std::int64_t panel_lines = p.taps * p.K;
  const std::int64_t first = (panel * panel_lines + line) * kPanelWidth;
  if (p.w.storage == Storage::kF32) {
    return {reinterpret_cast<const float*>(p.w.panels) + first, panel_lines * kPanelWidth};
  }
  for (std::int64_t i = 0; i < count; ++i) {
    widen_lines(p.w.storage, p.w.panels + 2 * (first + i * panel_lines * kPanelWidth), num_lines,
                scratch.widened + i * kMostLines * kPanelWidth);
  }
  return {scratch.widened, kMostLines * kPanelWidth};
}

// Lines [line, line + num_lines) of `count` panels from `panel` on, as they are stored.
Prefetch prefetch_panels(const Product& p, std::int64_t panel, std::int64_t count,
                         std::int64_t line, std::int64_t num_lines, std::int64_t parts) {
  const std::int64_t line_bytes =
      kPanelWidth * static_cast<std::int64_t>(storage_bytes(p.w.storage));
  const std::int64_t panel_lines = p.taps * p.K;
  return {p.w.panels + (panel * panel_lines + line) * line_bytes, num_lines * line_bytes, count,
          panel_lines * line_bytes, parts};
}

// A K block: values [k0, k0 + K) of `taps` taps, for all rows and panels of a chunk.
struct Block {
  const float* const* rows;  // [taps, row_stride], addresses
  std::int64_t row_stride;
  std::int64_t taps;
  std::int64_t k0;
  std::int64_t K;
  std::int64_t line;  // where the block starts inside a panel
  bool is_first;
  bool is_last;
  // Inputs of the next block: bytes [next_offset, next_offset + next_bytes) of next_rows.
  const float* const* next_rows = nullptr;
  std::int64_t next_offset = 0;
  std::int64_t next_bytes = 0;
};

void run_block(const Product& p, const RowTable& table, std::int64_t panel0, std::int64_t panel1,
               const Block& block, const ChunkScratch& scratch) {
  const std::int64_t lines = block.taps * block.K;
  const std::int64_t tiles = (table.count + kTileRows - 1) / kTileRows;
  for_panel_groups(panel1 - panel0, [&](std::int64_t first, std::int64_t count) HWY_ATTR {
    const std::int64_t panel = panel0 + first;
    const Panels panels = block_panels(p, panel, count, block.line, lines, scratch);
    Prefetch next;
    if (panel + count < panel1) {
      next = prefetch_panels(p, panel + count, std::min(count, panel1 - panel - count), block.line,
                             lines, tiles);
    } else if (!block.is_last) {
      const std::int64_t line = block.line + lines;
      next = prefetch_panels(p, panel0, std::min<std::int64_t>(kTilePanels, panel1 - panel0), line,
                             std::min(lines, p.taps * p.K - line), tiles);
    }
    if (block.next_rows != nullptr) {  // a share of the rows during each group of panels
      const std::int64_t groups = num_panel_groups(panel1 - panel0),
                         group = first * groups / (panel1 - panel0);
      next.add_rows(block.next_rows, table.count * group / groups,
                    table.count * (group + 1) / groups, block.next_offset, block.next_bytes, tiles);
    }
    float* sums = scratch.sums + first * kPanelWidth;
    const std::int64_t n0 = panel * kPanelWidth;
    const std::int64_t n1 = std::min(p.w.N, n0 + count * kPanelWidth);
    const TileColumn column{block.rows, table.count,  block.row_stride, block.taps, block.k0,
                            block.K,    panels.lines, panels.stride,    sums,       kSumPitch};
    if (block.is_first) {
      tile_column_of<false>(count, column, next, 0);
    } else {
      tile_column_of<true>(count, column, next, 0);
    }
    if (block.is_last) finish_any(p, table, sums, 0, table.count, n0, n1);
  });
}

// One chunk: all of K for the rows of the table and panels [panel0, panel1).
void run_chunk(const Product& p, const RowTable& table, std::int64_t panel0, std::int64_t panel1,
               const ChunkScratch& scratch) {
  const std::int64_t taps = p.taps;
  const std::int64_t K = p.K;
  if (K > kBlockK) {  // each tap in several blocks
    const std::int64_t blocks = (K + kBlockK - 1) / kBlockK;
    for (std::int64_t t = 0; t < taps; ++t) {
      for (std::int64_t b = 0; b < blocks; ++b) {
        const std::int64_t k0 = K * b / blocks;
        const std::int64_t k1 = K * (b + 1) / blocks;
        Block block{table.x + t * table.capacity,
                    table.capacity,
                    1,
                    k0,
                    k1 - k0,
                    t * K + k0,
                    t == 0 && b == 0,
                    t == taps - 1 && b == blocks - 1};
        if (!block.is_last) {
          const std::int64_t next_tap = b + 1 < blocks ? t : t + 1, next_b = (b + 1) % blocks;
          block.next_rows = table.x + next_tap * table.capacity;
          block.next_offset = K * next_b / blocks * 4;
          block.next_bytes = K * (next_b + 1) / blocks * 4 - block.next_offset;
        }
        run_block(p, table, panel0, panel1, block, scratch);
      }
    }
  } else {  // several taps in one block
    const std::int64_t group = std::max<std::int64_t>(1, kMostLines / std::max<std::int64_t>(K, 1));
    const std::int64_t blocks = (taps + group - 1) / group;
    for (std::int64_t b = 0; b < blocks; ++b) {
      const std::int64_t t0 = taps * b / blocks, t1 = taps * (b + 1) / blocks;
      run_block(p, table, panel0, panel1,
                {table.x + t0 * table.capacity, table.capacity, t1 - t0, 0, K, t0 * K, b == 0,
                 b == blocks - 1},
                scratch);
    }
  }
}

std::int64_t tile_rows() { return kTileRows; }

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt::kernels {

HWY_EXPORT(run_chunk);
HWY_EXPORT(tile_rows);

void run_product(const Product& product, FunctionRef<void(const RowTable&)> gather, Context& ctx) {
  const PackedPanels& w = product.w;
  const std::int64_t panels = num_panels(w.N);
  if (product.M == 0 || panels == 0) return;
  const Chunks chunks =
      plan_chunks(product.M, panels, HWY_DYNAMIC_DISPATCH(tile_rows)(), ctx.num_threads());

  Arena::Scope scope(ctx.arena());
  const std::int64_t workers = ctx.num_threads();
  const auto sums = ctx.arena().alloc(Shape{workers, kChunkRows, kSumPitch});
  const auto x_rows = ctx.arena().alloc<const float*>(Shape{workers, product.taps, kChunkRows});
  const auto y_rows = ctx.arena().alloc<float*>(Shape{workers, kChunkRows});
  const bool narrow = w.storage != Storage::kF32;
  const auto widened =
      ctx.arena().alloc(Shape{workers, narrow ? kMaxTilePanels * kMostLines * kPanelWidth : 0});
  const auto residual_rows = ctx.arena().alloc<const float*>(Shape{workers, kChunkRows});

  const auto run = HWY_DYNAMIC_DISPATCH(run_chunk);
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
        // Tiles read whole: the rows beyond the last one repeat it, and their sums are dropped.
        for (std::int64_t t = 0; t < product.taps; ++t) {
          const float** row = table.x + t * kChunkRows;
          std::fill(row + table.count, row + kChunkRows, row[table.count - 1]);
        }
        const Chunks::Range panel_range = chunks.panels_of(chunk);
        run(product, table, panel_range.begin, panel_range.end,
            {sums[worker].data(), widened[worker].data()});
      },
      ctx);
}

}  // namespace lvggt::kernels
#endif
