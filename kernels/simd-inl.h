// SPDX-License-Identifier: Apache-2.0
// Vector helpers shared by the kernels; compiled once for every instruction set.
#if defined(LVGGT_KERNELS_SIMD_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LVGGT_KERNELS_SIMD_INL_H_
#undef LVGGT_KERNELS_SIMD_INL_H_
#else
#define LVGGT_KERNELS_SIMD_INL_H_
#endif

#include <cstdint>

#include "hwy/highway.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

// The widest vector that divides a panel line (16 floats).
using Floats = hn::CappedTag<float, 16>;
inline constexpr int kLanes = static_cast<int>(hn::MaxLanes(Floats()));

// The first n elements at p; the other lanes are zero. n may be more than a vector holds.
template <class D>
HWY_INLINE hn::Vec<D> load_first(D d, const float* p, std::int64_t n) {
  const std::int64_t lanes = static_cast<std::int64_t>(hn::Lanes(d));
  if (HWY_LIKELY(n >= lanes)) return hn::LoadU(d, p);
  if (n <= 0) return hn::Zero(d);
  return hn::MaskedLoad(hn::FirstN(d, static_cast<std::size_t>(n)), d, p);
}

// Stores the first n lanes of v; n may be more than a vector holds, or nothing.
template <class D>
HWY_INLINE void store_first(hn::Vec<D> v, D d, float* p, std::int64_t n) {
  const std::int64_t lanes = static_cast<std::int64_t>(hn::Lanes(d));
  if (HWY_LIKELY(n >= lanes)) {
    hn::StoreU(v, d, p);
  } else if (n > 0) {
    hn::BlendedStore(v, hn::FirstN(d, static_cast<std::size_t>(n)), d, p);
  }
}

}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif
