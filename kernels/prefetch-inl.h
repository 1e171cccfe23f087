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

// A few stretches of memory of the same length, fetched into the second-level cache in `parts`
// equal parts, one between two tiles. Without it, the first rows that meet a panel wait for it: an
// eighth of the time of a product whose weights come from the third-level cache (measured).
class Prefetch {
 public:
  Prefetch() = default;
  Prefetch(const std::byte* begin, std::int64_t bytes, std::int64_t count, std::int64_t stride,
           std::int64_t parts)
      : begin_(begin),
        bytes_(bytes),
        count_(count),
        stride_(stride),
        part_((bytes / std::max<std::int64_t>(parts, 1) / kLine + 1) * kLine) {}

  // Always inlined: a function that only prefetches counts as one without effects, and GCC drops
  // calls of it.
  HWY_INLINE void fetch_part(std::int64_t part) const {
    const std::int64_t end = std::min(bytes_, (part + 1) * part_);
    for (std::int64_t i = 0; i < count_; ++i) {
      for (std::int64_t at = part * part_; at < end; at += kLine)
        __builtin_prefetch(begin_ + i * stride_ + at, 0, 2);
    }
  }

 private:
  static constexpr std::int64_t kLine = 64;
  const std::byte* begin_ = nullptr;
  std::int64_t bytes_ = 0;
  std::int64_t count_ = 0;
  std::int64_t stride_ = 0;
  std::int64_t part_ = kLine;
};

}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif
