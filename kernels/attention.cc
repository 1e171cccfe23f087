// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/attention.h"

#include <algorithm>
#include <cmath>
#include <limits>
#include <numbers>

#include "lvggt/core/parallel.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/attention.cc"
#include "hwy/foreach_target.h"
//
#include "hwy/highway.h"
#include "kernels/prefetch-inl.h"
#include "kernels/simd-inl.h"
#include "kernels/storage-inl.h"
#include "kernels/tile-inl.h"

#ifndef LVGGT_ATTENTION_ONCE
#define LVGGT_ATTENTION_ONCE
namespace lvggt::kernels {

// Most queries of one head handled together, and keys scored before the running maximum is updated:
// at most 15 panels = 240 keys. The keys and values of a block (2 x 240 x 64 floats = 120 KiB), its
// scores (216 x 240 floats = 203 KiB), the queries and the outputs (54 KiB each) fit a second-level
// cache of 512 KiB. Each product walks all rows with one group of panels, which stays in the
// first-level cache: a panel is 4 KiB of keys or 15 KiB of values. More queries share its way there
// and the widening of narrow keys: with 8 lanes 216 are 2 % faster than 144, which are 7 % faster
// than 96; 264 would be as fast but leave that cache. 12, 15 and 20 panels measured alike, eight a
// little slower.
inline constexpr std::int64_t kQueryBlock = 216;
inline constexpr std::int64_t kQueryUnit = 24;  // a multiple of every tile's rows
inline constexpr std::int64_t kKeyPanels = 15;
inline constexpr std::int64_t kScorePitch = kKeyPanels * kPanelWidth;

struct AttentionScratch {
  float* queries = nullptr;            // [kQueryBlock, D], scaled
  float* outputs = nullptr;            // [kQueryBlock, D rounded up to a panel]
  float* scores = nullptr;             // [kQueryBlock, kScorePitch]
  const float** query_rows = nullptr;  // [kQueryBlock]
  const float** score_rows = nullptr;  // [kQueryBlock]
  float* keys = nullptr;               // [kKeyPanels, D, 16]: a block of narrow keys as floats
  float* values = nullptr;             // [num_panels(D), 16 kKeyPanels, 16]: of narrow values
  float* maximum = nullptr;            // [kQueryBlock]
  float* sum = nullptr;                // [kQueryBlock]
};

}  // namespace lvggt::kernels
#endif

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// 2^x for x <= 0: x = n + f with |f| <= 1/2, 2^f by the polynomial of degree 5 that is 1 at 0 and
// elsewhere within 9.2e-8 of it, the least there is, times 2^n. Its terms are summed in pairs: a
// chain of multiply-adds would leave the units waiting for each other. Below -126 the result is
// 2^-126, which is nothing beside the row's maximum, which counts 1. NaN stays NaN: it is not less
// than anything, and what follows are sums and products.
HWY_INLINE hn::Vec<Floats> exp2_nonpositive(Floats d, hn::Vec<Floats> x) {
  const hn::RebindToUnsigned<Floats> du;
  const auto least = hn::Set(d, -126.0f);
  x = hn::IfThenElse(hn::Lt(x, least), least, x);
  // Adding 1.5 * 2^23 rounds to an integer and leaves n in the low bits; 127 more makes it the
  // exponent of 2^n.
  const auto magic = hn::Set(d, 12582912.0f + 127.0f);
  const auto shifted = hn::Add(x, magic);
  const auto f = hn::Sub(x, hn::Sub(shifted, magic));
  const auto power = hn::BitCast(d, hn::ShiftLeft<23>(hn::BitCast(du, shifted)));
  const auto f2 = hn::Mul(f, f);
  const auto p01 = hn::MulAdd(f, hn::Set(d, 6.93146978e-1f), hn::Set(d, 1.0f));
  const auto p23 = hn::MulAdd(f, hn::Set(d, 5.55073374e-2f), hn::Set(d, 2.40222421e-1f));
  const auto p45 = hn::MulAdd(f, hn::Set(d, 1.32647272e-3f), hn::Set(d, 9.67151269e-3f));
  return hn::Mul(hn::MulAdd(f2, hn::MulAdd(f2, p45, p23), p01), power);
}

// Turns one row of scores into weights 2^(score - maximum), and brings the row's running maximum,
// sum and output to the new maximum. `keys` is a multiple of 16.
HWY_INLINE void softmax_row(float* HWY_RESTRICT scores, std::int64_t keys, float& maximum,
                            float& sum, float* HWY_RESTRICT output, std::int64_t width) {
  const Floats d;
  auto largest0 = hn::LoadU(d, scores);
  auto largest1 = largest0;
  for (std::int64_t i = 0; i < keys; i += kPanelWidth) {
    for (int v = 0; v < kPanelVectors; v += 2) {
      largest0 = hn::Max(largest0, hn::LoadU(d, scores + i + v * kLanes));
      if (v + 1 < kPanelVectors)
        largest1 = hn::Max(largest1, hn::LoadU(d, scores + i + (v + 1) * kLanes));
    }
  }
  const float largest = hn::GetLane(hn::MaxOfLanes(d, hn::Max(largest0, largest1)));
  if (largest > maximum) {
    // exp2f(-infinity) is 0: nothing was summed yet.
    const float shrink = std::exp2(maximum - largest);
    maximum = largest;
    sum *= shrink;
    const auto factor = hn::Set(d, shrink);
    for (std::int64_t i = 0; i < width; i += kLanes) {
      hn::StoreU(hn::Mul(hn::LoadU(d, output + i), factor), d, output + i);
    }
  }
  const auto shift = hn::Set(d, maximum);
  hn::Vec<Floats> sums[kPanelVectors];
  for (int v = 0; v < kPanelVectors; ++v) sums[v] = hn::Zero(d);
  for (std::int64_t i = 0; i < keys; i += kPanelWidth) {
#pragma GCC unroll 4
    for (int v = 0; v < kPanelVectors; ++v) {
      float* p = scores + i + v * kLanes;
      const auto weight = exp2_nonpositive(d, hn::Sub(hn::LoadU(d, p), shift));
      sums[v] = hn::Add(sums[v], weight);
      hn::StoreU(weight, d, p);
    }
  }
  for (int v = 1; v < kPanelVectors; ++v) sums[0] = hn::Add(sums[0], sums[v]);
  sum += hn::GetLane(hn::SumOfLanes(d, sums[0]));
}

// Panels of keys, D lines each, and of values, whose lines are the block's tokens.
struct KeyBlock {
  const float* keys;
  const float* values;
  std::int64_t value_stride;  // floats between two panels of values
};

// Panels [panel0, panel1) of one head of one group; no group: nothing comes next.
struct KeyRange {
  const PackedKeysValues* group = nullptr;
  std::int64_t head = 0;
  std::int64_t panel0 = 0, panel1 = 0;

  std::int64_t num_keys() const { return (panel1 - panel0) * kPanelWidth; }
};

// Where a range's keys and values are stored.
struct StoredRange {
  const std::byte* keys;          // [panels, D, 16]
  const std::byte* values;        // [num_panels(D), num_keys, 16], panels value_stride apart
  const float* key_scales;        // [num_keys], int8 only
  const float* value_scales;      // [num_keys], int8 only
  std::int64_t element;           // bytes
  std::int64_t value_stride = 0;  // bytes
};

StoredRange stored_range(const KeyRange& range) {
  const PackedKeysValues& group = *range.group;
  const KeysValuesLayout layout =
      keys_values_layout(group.storage, group.num_heads, group.num_tokens, group.head_dim);
  const std::int64_t D = group.head_dim, panels = num_panels(group.num_tokens);
  const std::int64_t padded_tokens = panels * kPanelWidth;
  const auto bytes = static_cast<std::int64_t>(storage_bytes(group.storage));
  const std::int64_t scale0 = range.head * padded_tokens + range.panel0 * kPanelWidth;
  return {group.data + (range.head * panels + range.panel0) * D * kPanelWidth * bytes,
          group.data + layout.values +
              (range.head * num_panels(D) * padded_tokens + range.panel0 * kPanelWidth) *
                  kPanelWidth * bytes,
          reinterpret_cast<const float*>(group.data + layout.key_scales) + scale0,
          reinterpret_cast<const float*>(group.data + layout.value_scales) + scale0,
          bytes,
          padded_tokens * kPanelWidth * bytes};
}

// Keys and values of a range as floats, widened if they are stored narrow.
KeyBlock key_block(const KeyRange& range, const AttentionScratch& s) {
  const StoredRange stored = stored_range(range);
  const Storage storage = range.group->storage;
  if (storage == Storage::kF32) {
    return {reinterpret_cast<const float*>(stored.keys),
            reinterpret_cast<const float*>(stored.values), stored.value_stride / 4};
  }
  const std::int64_t D = range.group->head_dim, num_keys = range.num_keys();
  if (storage == Storage::kI8) {
    for (std::int64_t p = 0; p < range.panel1 - range.panel0; ++p) {
      widen_lines_by_lane(reinterpret_cast<const std::int8_t*>(stored.keys) + p * D * kPanelWidth,
                          D, stored.key_scales + p * kPanelWidth, s.keys + p * D * kPanelWidth);
    }
  } else {
    widen_lines(storage, stored.keys, (range.panel1 - range.panel0) * D, s.keys);
  }
  for (std::int64_t f = 0; f < num_panels(D); ++f) {
    const std::byte* panel = stored.values + f * stored.value_stride;
    float* to = s.values + f * num_keys * kPanelWidth;
    if (storage == Storage::kI8) {
      widen_lines_by_line(reinterpret_cast<const std::int8_t*>(panel), num_keys,
                          stored.value_scales, to);
    } else {
      widen_lines(storage, panel, num_keys, to);
    }
  }
  return {s.keys, s.values, num_keys * kPanelWidth};
}

// Keys of one range against all queries of the block, while those of the next one are fetched.
void attend_block(const KeyRange& range, const KeyRange& next, std::int64_t num_queries,
                  const AttentionScratch& s) {
  const std::int64_t D = range.group->head_dim;
  const std::int64_t feature_panels = num_panels(D);
  const std::int64_t width = feature_panels * kPanelWidth;
  const std::int64_t num_keys = range.num_keys();
  const std::int64_t valid_keys =
      std::min(num_keys, range.group->num_tokens - range.panel0 * kPanelWidth);
  const std::int64_t key_panels = range.panel1 - range.panel0;
  const KeyBlock block = key_block(range, s);

  const std::int64_t tiles = (num_queries + kTileRows - 1) / kTileRows;
  Prefetch next_keys, next_values;
  if (next.group != nullptr) {
    const StoredRange stored = stored_range(next);
    const std::int64_t bytes = next.num_keys() * kPanelWidth * stored.element;
    next_keys = {stored.keys, next.num_keys() * D * stored.element, 1, 0,
                 tiles * num_panel_groups(key_panels)};
    next_values = {stored.values, bytes, feature_panels, stored.value_stride,
                   tiles * num_panel_groups(feature_panels)};
  }
  for_panel_groups(key_panels, [&](std::int64_t first, std::int64_t count) HWY_ATTR {
    tile_column_of<false>(
        count,
        {s.query_rows, num_queries, 0, 1, 0, D, block.keys + first * D * kPanelWidth,
         D * kPanelWidth, s.scores + first * kPanelWidth, kScorePitch},
        next_keys, first / kTilePanels * tiles);
  });
  for (std::int64_t r = 0; r < num_queries; ++r) {
    float* scores = s.scores + r * kScorePitch;
    std::fill(scores + valid_keys, scores + num_keys, -std::numeric_limits<float>::infinity());
    softmax_row(scores, num_keys, s.maximum[r], s.sum[r], s.outputs + r * width, width);
  }
  for_panel_groups(feature_panels, [&](std::int64_t first, std::int64_t count) HWY_ATTR {
    tile_column_of<true>(
        count,
        {s.score_rows, num_queries, 0, 1, 0, num_keys, block.values + first * block.value_stride,
         block.value_stride, s.outputs + first * kPanelWidth, width},
        next_values, first / kTilePanels * tiles);
  });
}

// The ranges of at most kKeyPanels panels that one head's keys are cut into, group by group.
class KeyRanges {
 public:
  KeyRanges(std::span<const PackedKeysValues> past, std::int64_t head) : past_(past), head_(head) {}

  // The next range; one without a group when there is none.
  KeyRange next() {
    while (!past_.empty()) {
      const PackedKeysValues& group = past_.front();
      const std::int64_t panels = num_panels(group.num_tokens);
      const std::int64_t blocks = (panels + kKeyPanels - 1) / kKeyPanels;
      if (block_ < blocks) {
        const std::int64_t b = block_++;
        return {&group, head_, panels * b / blocks, panels * (b + 1) / blocks};
      }
      past_ = past_.subspan(1);
      block_ = 0;
    }
    return {};
  }

 private:
  std::span<const PackedKeysValues> past_;
  std::int64_t head_;
  std::int64_t block_ = 0;
};

// Queries [q0, q1) of one head over all groups.
void attend(View<float, 3> y, View<const float, 3> q, std::span<const PackedKeysValues> past,
            float scale, std::int64_t head, std::int64_t q0, std::int64_t q1,
            const AttentionScratch& s) {
  const Floats d;
  const std::int64_t D = q.extent(2);
  const std::int64_t width = num_panels(D) * kPanelWidth;
  const std::int64_t count = q1 - q0;
  // Exponentials are taken to base 2, so the scale carries log2(e).
  const auto factor = hn::Set(d, scale * std::numbers::log2e_v<float>);
  for (std::int64_t r = 0; r < kQueryBlock; ++r) {
    const float* from = q.data() + (q0 + std::min(r, count - 1)) * q.stride(0) + head * q.stride(1);
    float* to = s.queries + r * D;
    for (std::int64_t i = 0; i < D; i += kLanes) {
      store_first(hn::Mul(load_first(d, from + i, D - i), factor), d, to + i, D - i);
    }
    s.query_rows[r] = to;
    s.score_rows[r] = s.scores + r * kScorePitch;
  }
  std::fill_n(s.outputs, kQueryBlock * width, 0.0f);
  std::fill_n(s.maximum, kQueryBlock, -std::numeric_limits<float>::infinity());
  std::fill_n(s.sum, kQueryBlock, 0.0f);

  KeyRanges ranges(past, head);
  for (KeyRange range = ranges.next(); range.group != nullptr;) {
    const KeyRange next = ranges.next();
    attend_block(range, next, count, s);
    range = next;
  }

  for (std::int64_t r = 0; r < count; ++r) {
    const auto inverse = hn::Set(d, 1.0f / s.sum[r]);
    float* to = y.data() + (q0 + r) * y.stride(0) + head * y.stride(1);
    for (std::int64_t i = 0; i < D; i += kLanes) {
      store_first(hn::Mul(hn::LoadU(d, s.outputs + r * width + i), inverse), d, to + i, D - i);
    }
  }
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {

namespace kernels {
HWY_EXPORT(attend);
}  // namespace kernels

void scaled_dot_product_attention(View<float, 3> y, View<const float, 3> q,
                                  std::span<const PackedKeysValues> past, float scale,
                                  Context& ctx) {
  using namespace kernels;
  const auto [Nq, heads, D] = q.shape();
  LVGGT_CHECK(y.shape() == q.shape(), "attention: y is ", y.shape(), " but q is ", q.shape());
  std::int64_t num_keys = 0;
  bool narrow = false;
  for (const PackedKeysValues& group : past) {
    narrow = narrow || group.storage != Storage::kF32;
    LVGGT_CHECK(group.num_heads == heads && group.head_dim == D, "attention: q is ", q.shape(),
                " but the keys have ", group.num_heads, " heads of ", group.head_dim);
    num_keys += group.num_tokens;
  }
  LVGGT_CHECK(num_keys > 0, "attention: there are no keys for q ", q.shape());

  Arena::Scope scope(ctx.arena());
  const std::int64_t workers = ctx.num_threads();
  const std::int64_t width = num_panels(D) * kPanelWidth;
  const auto queries = ctx.arena().alloc(Shape{workers, kQueryBlock, D});
  const auto outputs = ctx.arena().alloc(Shape{workers, kQueryBlock, width});
  const auto scores = ctx.arena().alloc(Shape{workers, kQueryBlock, kScorePitch});
  const auto rows = ctx.arena().alloc<const float*>(Shape{workers, std::int64_t{2}, kQueryBlock});
  const std::int64_t widened_keys = narrow ? kKeyPanels * kPanelWidth : 0;
  const auto keys = ctx.arena().alloc(Shape{workers, widened_keys * D});
  const auto values = ctx.arena().alloc(Shape{workers, widened_keys * width});
  const auto running = ctx.arena().alloc(Shape{workers, std::int64_t{2}, kQueryBlock});
  const auto run = HWY_DYNAMIC_DISPATCH(attend);
  // Equal blocks, cut at a multiple of every tile's rows; more of them where threads would idle.
  // Rows do not depend on each other, nor on the cut.
  const std::int64_t tiles = (Nq + kQueryUnit - 1) / kQueryUnit;
  const std::int64_t blocks = std::min(
      tiles, std::max((Nq + kQueryBlock - 1) / kQueryBlock, (4 * workers + heads - 1) / heads));
  const std::int64_t num_queries = Nq;
  parallel_chunks(
      heads * blocks,
      [&](std::int64_t chunk, int worker) {
        const std::int64_t head = chunk / blocks, block = chunk % blocks;
        const std::int64_t q0 = tiles * block / blocks * kQueryUnit;
        const std::int64_t q1 = tiles * (block + 1) / blocks * kQueryUnit;
        run(y, q, past, scale, head, q0, std::min(num_queries, q1),
            {queries[worker].data(), outputs[worker].data(), scores[worker].data(),
             rows[worker][0].data(), rows[worker][1].data(), keys[worker].data(),
             values[worker].data(), running[worker][0].data(), running[worker][1].data()});
      },
      ctx);
}

}  // namespace lvggt
#endif
