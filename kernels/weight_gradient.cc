// SPDX-License-Identifier: Apache-2.0
#include "kernels/weight_gradient.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/weight_gradient.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <algorithm>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "kernels/outer_tile-inl.h"
#include "kernels/weight_gradient_plan.h"
#include "lvggt/core/parallel.h"

#ifndef LVGGT_KERNELS_WEIGHT_GRADIENT_ONCE
#define LVGGT_KERNELS_WEIGHT_GRADIENT_ONCE
namespace lvggt::kernels {

struct WeightGradientTask {
  Range groups;      // of input channels
  Range panels;      // of output channels
  Range rectangles;  // of dy's pixels
  float* x;          // scratch, plan.x_floats()
  float* dy;         // scratch, plan.dy_floats()
  float* sums;       // result, plan.sum_floats()
  float* bias_sums;  // result, [16 max_panels], or null
};

}  // namespace lvggt::kernels
#endif

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// Copies kWidth values, those beyond the first `count` as zeros.
template <int kWidth>
HWY_INLINE void copy_padded(float* HWY_RESTRICT to, const float* HWY_RESTRICT from,
                            std::int64_t count) {
  if (HWY_LIKELY(count >= kWidth)) {
    for_each_vector(kWidth, [=](auto d, std::int64_t i)
                                HWY_ATTR { hn::StoreU(hn::LoadU(d, from + i), d, to + i); });
  } else {
    for (std::int64_t i = 0; i < kWidth; ++i) to[i] = i < count ? from[i] : 0.0f;
  }
}

// A rectangle of dy.
struct Rectangle {
  std::int64_t b;
  Range rows, columns;
};

// [panel][pixel][16], and the sums of the channels.
void copy_dy(const WeightGradientPlan& plan, View<const float, 4> dy, const Rectangle& rectangle,
             const WeightGradientTask& task) {
  const std::int64_t first = task.panels.begin * kPanelWidth;
  const std::int64_t count = std::min(plan.dy[3], task.panels.end * kPanelWidth) - first;
  const std::int64_t pixels = rectangle.rows.size() * rectangle.columns.size();
  float* to = task.dy;
  for (std::int64_t i = rectangle.rows.begin; i < rectangle.rows.end; ++i) {
    const float* from = dy.data() + rectangle.b * dy.stride(0) + i * dy.stride(1) +
                        rectangle.columns.begin * dy.stride(2) + first;
    for (std::int64_t j = 0; j < rectangle.columns.size(); ++j, from += dy.stride(2)) {
      for (std::int64_t p = 0; p < task.panels.size(); ++p)
        copy_padded<kPanelWidth>(to + p * pixels * kPanelWidth, from + p * kPanelWidth,
                                 count - p * kPanelWidth);
      to += kPanelWidth;
    }
  }
  if (task.bias_sums == nullptr) return;
  const Floats d;
  for (std::int64_t n = 0; n < task.panels.size() * kPanelWidth; n += kLanes) {
    const float* HWY_RESTRICT line =
        task.dy + n / kPanelWidth * pixels * kPanelWidth + n % kPanelWidth;
    auto even = hn::Zero(d), odd = even;
    std::int64_t i = 0;
    for (; i + 2 <= pixels; i += 2) {
      even = hn::Add(even, hn::LoadU(d, line + i * kPanelWidth));
      odd = hn::Add(odd, hn::LoadU(d, line + (i + 1) * kPanelWidth));
    }
    if (i < pixels) even = hn::Add(even, hn::LoadU(d, line + i * kPanelWidth));
    hn::StoreU(hn::Add(hn::LoadU(d, task.bias_sums + n), hn::Add(even, odd)), d,
               task.bias_sums + n);
  }
}

// [group][row][column modulo stride][column / stride][kTileRows], zeros beyond the border.
void copy_x(const WeightGradientPlan& plan, View<const float, 4> x, const Rectangle& rectangle,
            const WeightGradientTask& task) {
  const std::int64_t rows = plan.x_rows(rectangle.rows.size());
  const std::int64_t columns = plan.x_columns(rectangle.columns.size());
  const std::int64_t used_columns = (rectangle.columns.size() - 1) * plan.stride + plan.kernel;
  const std::int64_t group_step = rows * plan.stride * columns * kTileRows;
  const std::int64_t first = task.groups.begin * kTileRows;
  const std::int64_t count = std::min(plan.x[3], task.groups.end * kTileRows) - first;
  for (std::int64_t i = 0; i < rows; ++i) {
    const std::int64_t h = rectangle.rows.begin * plan.stride - plan.padding + i;
    const float* row = x.data() + rectangle.b * x.stride(0) + h * x.stride(1) + first;
    for (std::int64_t j = 0; j < used_columns; ++j) {
      const std::int64_t w = rectangle.columns.begin * plan.stride - plan.padding + j;
      const bool inside = h >= 0 && h < plan.x[1] && w >= 0 && w < plan.x[2];
      const float* from = row + (inside ? w * x.stride(2) : 0);
      float* to =
          task.x + ((i * plan.stride + j % plan.stride) * columns + j / plan.stride) * kTileRows;
      for (std::int64_t g = 0; g < task.groups.size(); ++g)
        copy_padded<kTileRows>(to + g * group_step, from + g * kTileRows,
                               inside ? count - g * kTileRows : 0);
    }
  }
}

void add_rectangle(const WeightGradientPlan& plan, const Rectangle& rectangle,
                   const WeightGradientTask& task, NextRectangle next) {
  const std::int64_t height = rectangle.rows.size(), width = rectangle.columns.size();
  const std::int64_t columns = plan.x_columns(width);
  const std::int64_t x_row = plan.stride * columns * kTileRows;
  const std::int64_t group_step = plan.x_rows(height) * x_row;
  const std::int64_t panel_step = height * width * kPanelWidth;
  const std::int64_t sums_stride = task.panels.size() * kPanelWidth;
  const std::int64_t shares =
      ceil_div(task.panels.size(), kTilePanels) * task.groups.size() * plan.taps() * height;
  next.dy_lines = ceil_div(next.dy.lines(), shares);
  next.x_lines = ceil_div(next.x.lines(), shares);
  for_panel_groups(task.panels.size(), [&](std::int64_t panel, std::int64_t count) HWY_ATTR {
    for (std::int64_t g = 0; g < task.groups.size(); ++g) {
      for (std::int64_t t = 0; t < plan.taps(); ++t) {
        const std::int64_t ky = t / plan.kernel, kx = t % plan.kernel;
        const float* x = task.x + g * group_step + ky * x_row +
                         (kx % plan.stride * columns + kx / plan.stride) * kTileRows;
        float* sums = task.sums + (t * task.groups.size() + g) * kTileRows * sums_stride +
                      panel * kPanelWidth;
        outer_tile_of(count, x, plan.stride * x_row, task.dy + panel * panel_step, panel_step,
                      height, width, sums, sums_stride, next);
      }
    }
  });
}

Rectangle rectangle_at(const WeightGradientPlan& plan, std::int64_t n) {
  return {n / plan.across / plan.down, part_of(plan.dy[1], n / plan.across % plan.down, plan.down),
          part_of(plan.dy[2], n % plan.across, plan.across)};
}

void run_weight_gradient(const WeightGradientPlan& plan, View<const float, 4> dy,
                         View<const float, 4> x, const WeightGradientTask& task) {
  for (std::int64_t n = task.rectangles.begin; n < task.rectangles.end; ++n) {
    const Rectangle rectangle = rectangle_at(plan, n);
    copy_dy(plan, dy, rectangle, task);
    copy_x(plan, x, rectangle, task);
    NextRectangle next;
    if (n + 1 < task.rectangles.end) {
      const Rectangle after = rectangle_at(plan, n + 1);
      next.dy = Fetch(dy, after.b, after.rows, after.columns, task.panels.begin * kPanelWidth,
                      task.panels.size() * kPanelWidth);
      next.x = Fetch(x, after.b, plan.inputs_of(after.rows), plan.inputs_of(after.columns),
                     task.groups.begin * kTileRows, task.groups.size() * kTileRows);
    }
    add_rectangle(plan, rectangle, task, next);
  }
}

std::int64_t tile_rows() { return kTileRows; }

// sums += x, over the pixels of a row.
void add_pixels(float* HWY_RESTRICT sums, const float* HWY_RESTRICT x, std::int64_t step,
                std::int64_t W, std::int64_t C) {
  for_each_vector(C, [=](auto d, std::int64_t c) HWY_ATTR {
    auto even = hn::LoadU(d, sums + c), odd = hn::Zero(d);
    std::int64_t w = 0;
    for (; w + 2 <= W; w += 2) {
      even = hn::Add(even, hn::LoadU(d, x + w * step + c));
      odd = hn::Add(odd, hn::LoadU(d, x + (w + 1) * step + c));
    }
    if (w < W) even = hn::Add(even, hn::LoadU(d, x + w * step + c));
    hn::StoreU(hn::Add(even, odd), d, sums + c);
  });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt::kernels {
namespace {

HWY_EXPORT(run_weight_gradient);
HWY_EXPORT(tile_rows);
HWY_EXPORT(add_pixels);

// The task's place in the plan; tasks of the same pixels follow each other.
struct TaskIndex {
  std::int64_t share, input_block, output_block;
};
TaskIndex task_index(const WeightGradientPlan& plan, std::int64_t task) {
  return {task / plan.output_blocks / plan.input_blocks,
          task / plan.output_blocks % plan.input_blocks, task % plan.output_blocks};
}

// dweight += the shares' sums, in order, for one panel of output and one group of input channels.
// They are added up in `total`, [taps, tile_rows, 16], in the order in which they lie in memory;
// its transposition into dweight stays in a first-level cache.
void add_shares(const WeightGradientPlan& plan, View<float, 4> dweight, View<const float, 2> sums,
                std::int64_t panel, std::int64_t group, float* total) {
  const std::int64_t i = part_with(plan.input_groups, group, plan.input_blocks);
  const std::int64_t o = part_with(plan.output_panels, panel, plan.output_blocks);
  const Range groups = part_of(plan.input_groups, i, plan.input_blocks);
  const Range panels = part_of(plan.output_panels, o, plan.output_blocks);
  const std::int64_t width = panels.size() * kPanelWidth;
  std::fill_n(total, plan.total_floats(), 0.0f);
  for (std::int64_t s = 0; s < plan.shares; ++s) {
    const float* share = sums[(s * plan.input_blocks + i) * plan.output_blocks + o].data() +
                         (group - groups.begin) * plan.tile_rows * width +
                         (panel - panels.begin) * kPanelWidth;
    float* to = total;
    for (std::int64_t t = 0; t < plan.taps(); ++t)
      for (std::int64_t r = 0; r < plan.tile_rows; ++r, to += kPanelWidth) {
        const float* line = share + (t * groups.size() * plan.tile_rows + r) * width;
        for (std::int64_t n = 0; n < kPanelWidth; ++n) to[n] += line[n];
      }
  }
  const std::int64_t ci_end = std::min(plan.x[3], (group + 1) * plan.tile_rows);
  const std::int64_t co_end = std::min(plan.dy[3], (panel + 1) * kPanelWidth);
  const std::int64_t k = plan.kernel;
  for (std::int64_t co = panel * kPanelWidth; co < co_end; ++co) {
    for (std::int64_t ci = group * plan.tile_rows; ci < ci_end; ++ci) {
      const float* from = total + ci % plan.tile_rows * kPanelWidth + co % kPanelWidth;
      float* filter = dweight.data() + co * dweight.stride(0) + ci * dweight.stride(1);
      for (std::int64_t ky = 0; ky < k; ++ky, filter += dweight.stride(2))
        for (std::int64_t kx = 0; kx < k; ++kx, from += plan.tile_rows * kPanelWidth)
          filter[kx * dweight.stride(3)] += *from;
    }
  }
}

// dbias += the shares' sums, in order.
void add_bias_shares(const WeightGradientPlan& plan, View<float, 1> dbias,
                     View<const float, 2> sums) {
  for (std::int64_t s = 0; s < plan.shares; ++s) {
    for (std::int64_t o = 0; o < plan.output_blocks; ++o) {
      const Range panels = part_of(plan.output_panels, o, plan.output_blocks);
      const View<const float, 1> line = sums[s * plan.output_blocks + o];
      const std::int64_t first = panels.begin * kPanelWidth;
      for (std::int64_t c = first; c < std::min(plan.dy[3], panels.end * kPanelWidth); ++c)
        dbias[c] += line[c - first];
    }
  }
}

}  // namespace

namespace {

// With stride 1, dy and x may change places: with q = o + t - padding,
//   dweight[co, ci, t] = sum over q of x[q, ci] dy[q + (k - 1 - t) - (k - 1 - padding), co]
// is the weight gradient of a convolution from Cout to Cin channels, its taps turned by 180
// degrees. For a handful of output channels that leaves fewer lanes of a tile idle: 3 of its 8 rows
// are used instead of 3 of its 16 columns.
void weight_gradient_exchanged(View<float, 4> dweight, View<const float, 4> dy,
                               View<const float, 4> x, std::int64_t padding, Context& ctx) {
  const std::int64_t Cout = dweight.extent(0), Cin = dweight.extent(1), k = dweight.extent(2);
  Arena::Scope scope(ctx.arena());
  const View<float, 4> turned = ctx.arena().alloc(Shape{Cin, Cout, k, k});
  std::fill_n(turned.data(), turned.size(), 0.0f);
  weight_gradient(turned, {}, x, dy, 1, k - 1 - padding, ctx);
  for (std::int64_t co = 0; co < Cout; ++co)
    for (std::int64_t ci = 0; ci < Cin; ++ci)
      for (std::int64_t t = 0; t < k * k; ++t)
        dweight(co, ci, t / k, t % k) += turned(ci, co, k - 1 - t / k, k - 1 - t % k);
}

}  // namespace

void weight_gradient(View<float, 4> dweight, View<float, 1> dbias, View<const float, 4> dy,
                     View<const float, 4> x, std::int64_t stride, std::int64_t padding,
                     Context& ctx) {
  if (dy.size() == 0 || x.extent(3) == 0) return;
  const bool few_outputs = dy.extent(3) <= kPanelWidth / 2 && x.extent(3) >= kPanelWidth;
  if (few_outputs && stride == 1 && padding < dweight.extent(2)) {
    weight_gradient_exchanged(dweight, dy, x, padding, ctx);
    if (dbias) bias_gradient(dbias, dy, ctx);
    return;
  }
  const WeightGradientPlan plan(dy.shape(), x.shape(), dweight.extent(2), stride, padding,
                                HWY_DYNAMIC_DISPATCH(tile_rows)());
  Arena::Scope scope(ctx.arena());
  const std::int64_t workers = ctx.num_threads();
  const View<float, 2> x_scratch = ctx.arena().alloc(Shape{workers, plan.x_floats()});
  const View<float, 2> dy_scratch = ctx.arena().alloc(Shape{workers, plan.dy_floats()});
  const View<float, 2> sums = ctx.arena().alloc(Shape{plan.tasks(), plan.sum_floats()});
  const View<float, 2> bias_sums =
      ctx.arena().alloc(Shape{plan.shares * plan.output_blocks, plan.max_panels() * kPanelWidth});
  const View<float, 2> totals = ctx.arena().alloc(Shape{workers, plan.total_floats()});
  const auto run = HWY_DYNAMIC_DISPATCH(run_weight_gradient);
  parallel_chunks(
      plan.tasks(),
      [&](std::int64_t task, int worker) {
        const TaskIndex at = task_index(plan, task);
        float* bias = nullptr;
        if (dbias && at.input_block == 0) {
          const View<float, 1> line = bias_sums[at.share * plan.output_blocks + at.output_block];
          std::fill_n(line.data(), line.size(), 0.0f);
          bias = line.data();
        }
        std::fill_n(sums[task].data(), plan.sum_floats(), 0.0f);
        run(plan, dy, x,
            {part_of(plan.input_groups, at.input_block, plan.input_blocks),
             part_of(plan.output_panels, at.output_block, plan.output_blocks),
             part_of(plan.rectangles(), at.share, plan.shares), x_scratch[worker].data(),
             dy_scratch[worker].data(), sums[task].data(), bias});
      },
      ctx);
  parallel_chunks(
      plan.output_panels * plan.input_groups,
      [&](std::int64_t n, int worker) {
        add_shares(plan, dweight, sums, n / plan.input_groups, n % plan.input_groups,
                   totals[worker].data());
      },
      ctx);
  if (dbias) add_bias_shares(plan, dbias, bias_sums);
}

void bias_gradient(View<float, 1> dbias, View<const float, 4> dy, Context& ctx) {
  const std::int64_t H = dy.extent(1), W = dy.extent(2), C = dy.extent(3);
  const std::int64_t rows = dy.extent(0) * H;
  const std::int64_t grain = std::max(rows_per_chunk(W * C), ceil_div(rows, 256));
  const std::int64_t chunks = ceil_div(rows, grain);
  Arena::Scope scope(ctx.arena());
  const View<float, 2> sums = ctx.arena().alloc(Shape{chunks, C});
  const auto add = HWY_DYNAMIC_DISPATCH(add_pixels);
  parallel_chunks(
      chunks,
      [&](std::int64_t chunk, int) {
        std::fill_n(sums[chunk].data(), C, 0.0f);
        for (std::int64_t n = chunk * grain; n < std::min(rows, (chunk + 1) * grain); ++n)
          add(sums[chunk].data(), dy[n / H][n % H].data(), dy.stride(2), W, C);
      },
      ctx);
  for (std::int64_t chunk = 0; chunk < chunks; ++chunk)
    for (std::int64_t c = 0; c < C; ++c) dbias[c] += sums(chunk, c);
}

}  // namespace lvggt::kernels
#endif
