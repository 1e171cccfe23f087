// SPDX-License-Identifier: Apache-2.0
// Fetching the panels that a product needs next while it works on the present ones.
#if defined(LVGGT_KERNELS_PREFETCH_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LVGGT_KERNELS_PREFETCH_INL_H_
#undef LVGGT_KERNELS_PREFETCH_INL_H_
#else
#define LVGGT_KERNELS_PREFETCH_INL_H_
#endif

#include <algorithm>
#include <cstddef>
#include <cstdint>

#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {

// Stretches of memory of the same length, fetched into the second-level cache in equal parts, one
// before each tile. Without it, the first rows that meet a panel wait for it: an eighth of the time
// of a product whose weights come from the third-level cache (measured).
class Prefetch {
 public:
  Prefetch() = default;

  // `count` stretches of `bytes`, `stride` apart, in parts 0 .. parts-1.
  Prefetch(const std::byte* begin, std::int64_t bytes, std::int64_t count, std::int64_t stride,
           std::int64_t parts)
      : begin_(begin),
        bytes_(bytes),
        count_(count),
        stride_(stride),
        part_((bytes / std::max<std::int64_t>(parts, 1) / kLine + 1) * kLine) {}

  // Fetches `bytes` at byte `offset` of rows [first, last) too, in parts 0 .. parts-1.
  void add_rows(const float* const* rows, std::int64_t first, std::int64_t last,
                std::int64_t offset, std::int64_t bytes, std::int64_t parts) {
    rows_ = rows + first;
    offset_ = offset;
    lines_per_row_ = (bytes + kLine - 1) / kLine;
    row_lines_ = (last - first) * lines_per_row_;
    row_part_ = (row_lines_ + parts - 1) / parts;
  }

  // Always inlined: a function that only prefetches counts as one without effects, and GCC drops
  // calls of it.
  HWY_INLINE void fetch_part(std::int64_t part) const {
    const std::int64_t end = std::min(bytes_, (part + 1) * part_);
    for (std::int64_t i = 0; i < count_; ++i) {
      for (std::int64_t at = part * part_; at < end; at += kLine)
        __builtin_prefetch(begin_ + i * stride_ + at, 0, 2);
    }
    const std::int64_t last_line = std::min(row_lines_, (part + 1) * row_part_);
    for (std::int64_t line = part * row_part_; line < last_line; ++line) {
      const auto* row = reinterpret_cast<const std::byte*>(rows_[line / lines_per_row_]);
      __builtin_prefetch(row + offset_ + line % lines_per_row_ * kLine, 0, 2);
    }
  }

 private:
  static constexpr std::int64_t kLine = 64;
  const std::byte* begin_ = nullptr;
  std::int64_t bytes_ = 0;
  std::int64_t count_ = 0;
  std::int64_t stride_ = 0;
  std::int64_t part_ = kLine;

  const float* const* rows_ = nullptr;
  std::int64_t offset_ = 0;
  std::int64_t lines_per_row_ = 1;
  std::int64_t row_lines_ = 0;
  std::int64_t row_part_ = 0;
};

}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif
