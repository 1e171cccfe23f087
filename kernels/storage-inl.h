// SPDX-License-Identifier: Apache-2.0
// Narrow storage widened to float lines, a block at a time: products read the block many times from
// the cache, so that widening costs a few percent and there is one inner loop for all storages.
#if defined(LVGGT_KERNELS_STORAGE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LVGGT_KERNELS_STORAGE_INL_H_
#undef LVGGT_KERNELS_STORAGE_INL_H_
#else
#define LVGGT_KERNELS_STORAGE_INL_H_
#endif

#include <cstdint>

#include "kernels/simd-inl.h"
#include "lvggt/core/storage.h"
#include "lvggt/kernels/packed_matrix.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {

HWY_INLINE hn::Vec<Floats> widen_bf16(Floats d, const std::uint16_t* p) {
  const hn::RebindToUnsigned<Floats> du;
  const hn::Rebind<std::uint16_t, Floats> dh;
  return hn::BitCast(d, hn::ShiftLeft<16>(hn::PromoteTo(du, hn::LoadU(dh, p))));
}

HWY_INLINE hn::Vec<Floats> widen_f16(Floats d, const std::uint16_t* p) {
  const hn::Rebind<hwy::float16_t, Floats> dh;
  const hn::Rebind<std::uint16_t, Floats> dbits;
  return hn::PromoteTo(d, hn::BitCast(dh, hn::LoadU(dbits, p)));
}

HWY_INLINE hn::Vec<Floats> widen_i8(Floats d, const std::int8_t* p) {
  const hn::RebindToSigned<Floats> di;
  const hn::Rebind<std::int8_t, Floats> db;
  return hn::ConvertTo(d, hn::PromoteTo(di, hn::LoadU(db, p)));
}

// num_lines lines of 16 bf16 or f16 values.
inline void widen_lines(Storage storage, const std::byte* HWY_RESTRICT from, std::int64_t num_lines,
                        float* HWY_RESTRICT to) {
  const Floats d;
  const auto* halves = reinterpret_cast<const std::uint16_t*>(from);
  if (storage == Storage::kBf16) {
    for (std::int64_t i = 0; i < num_lines * kPanelWidth; i += kLanes) {
      hn::StoreU(widen_bf16(d, halves + i), d, to + i);
    }
  } else {
    for (std::int64_t i = 0; i < num_lines * kPanelWidth; i += kLanes) {
      hn::StoreU(widen_f16(d, halves + i), d, to + i);
    }
  }
}

// num_lines lines of 16 integers; lane_scales[16] scales every line alike.
inline void widen_lines_by_lane(const std::int8_t* HWY_RESTRICT from, std::int64_t num_lines,
                                const float* HWY_RESTRICT lane_scales, float* HWY_RESTRICT to) {
  const Floats d;
  for (std::int64_t i = 0; i < num_lines * kPanelWidth; i += kLanes) {
    hn::StoreU(hn::Mul(widen_i8(d, from + i), hn::LoadU(d, lane_scales + i % kPanelWidth)), d,
               to + i);
  }
}

// num_lines lines of 16 integers; line_scales[num_lines] has one scale for each.
inline void widen_lines_by_line(const std::int8_t* HWY_RESTRICT from, std::int64_t num_lines,
                                const float* HWY_RESTRICT line_scales, float* HWY_RESTRICT to) {
  const Floats d;
  for (std::int64_t line = 0; line < num_lines; ++line) {
    const auto scale = hn::Set(d, line_scales[line]);
    for (std::int64_t i = line * kPanelWidth; i < (line + 1) * kPanelWidth; i += kLanes) {
      hn::StoreU(hn::Mul(widen_i8(d, from + i), scale), d, to + i);
    }
  }
}

}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif
