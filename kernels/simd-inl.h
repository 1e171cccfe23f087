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
  if constexpr (HWY_MEM_OPS_MIGHT_FAULT) {
    // Here MaskedLoad may load the whole vector, from an address it takes to be aligned.
    HWY_ALIGN float buffer[hn::MaxLanes(D())] = {};
    for (std::int64_t i = 0; i < n; ++i) buffer[i] = p[i];
    return hn::Load(d, buffer);
  } else {
    return hn::MaskedLoad(hn::FirstN(d, static_cast<std::size_t>(n)), d, p);
  }
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

// Lanes of four bytes each: sum + a.b, with a unsigned and b signed, |b| <= 63 so that a0 b0 + a1
// b1 fits 16 bits. Highway 1.0.3 has no operation for this, and it decides the speed of the int8
// product.
using Ints = hn::RebindToSigned<Floats>;

#if HWY_TARGET == HWY_SCALAR
HWY_INLINE hn::Vec<Ints> dot4_portable(Ints d, hn::Vec<Ints> sum, hn::Vec<Ints> a,
                                       hn::Vec<Ints> b) {
  const std::int32_t bytes_a = hn::GetLane(a), bytes_b = hn::GetLane(b);
  std::int32_t total = hn::GetLane(sum);
  for (int i = 0; i < 32; i += 8) {
    total += static_cast<std::uint8_t>(bytes_a >> i) * static_cast<std::int8_t>(bytes_b >> i);
  }
  return hn::Set(d, total);
}
#else
HWY_INLINE hn::Vec<Ints> dot4_portable(Ints d, hn::Vec<Ints> sum, hn::Vec<Ints> a,
                                       hn::Vec<Ints> b) {
  const hn::Repartition<std::int16_t, Ints> d16;
  const auto a16 = hn::BitCast(d16, a);
  const auto b16 = hn::BitCast(d16, b);
  const auto a_even = hn::And(a16, hn::Set(d16, 255));
  const auto a_odd = hn::And(hn::ShiftRight<8>(a16), hn::Set(d16, 255));
  const auto b_even = hn::ShiftRight<8>(hn::ShiftLeft<8>(b16));
  const auto b_odd = hn::ShiftRight<8>(b16);
  const auto pairs = hn::BitCast(d, hn::Add(hn::Mul(a_even, b_even), hn::Mul(a_odd, b_odd)));
  return hn::Add(sum,
                 hn::Add(hn::ShiftRight<16>(hn::ShiftLeft<16>(pairs)), hn::ShiftRight<16>(pairs)));
}
#endif

#if HWY_TARGET == HWY_AVX3_DL
// The CPU has the instruction whenever this target is chosen, but Highway does not enable it for
// the compiler.
HWY_INLINE hn::Vec<Ints> dot4(Ints, hn::Vec<Ints> sum, hn::Vec<Ints> a, hn::Vec<Ints> b) {
  asm("vpdpbusd %2, %1, %0" : "+v"(sum.raw) : "v"(a.raw), "v"(b.raw));
  return sum;
}
#elif HWY_TARGET == HWY_AVX3
HWY_INLINE hn::Vec<Ints> dot4(Ints d, hn::Vec<Ints> sum, hn::Vec<Ints> a, hn::Vec<Ints> b) {
  const auto pairs = _mm512_maddubs_epi16(a.raw, b.raw);
  return hn::Add(sum, hn::Vec<Ints>{_mm512_madd_epi16(pairs, hn::Set(d, 0x00010001).raw)});
}
#elif HWY_TARGET == HWY_AVX2
HWY_INLINE hn::Vec<Ints> dot4(Ints d, hn::Vec<Ints> sum, hn::Vec<Ints> a, hn::Vec<Ints> b) {
  const auto pairs = _mm256_maddubs_epi16(a.raw, b.raw);
  return hn::Add(sum, hn::Vec<Ints>{_mm256_madd_epi16(pairs, hn::Set(d, 0x00010001).raw)});
}
#elif HWY_TARGET == HWY_SSE4
HWY_INLINE hn::Vec<Ints> dot4(Ints d, hn::Vec<Ints> sum, hn::Vec<Ints> a, hn::Vec<Ints> b) {
  const auto pairs = _mm_maddubs_epi16(a.raw, b.raw);
  return hn::Add(sum, hn::Vec<Ints>{_mm_madd_epi16(pairs, hn::Set(d, 0x00010001).raw)});
}
#else
HWY_INLINE hn::Vec<Ints> dot4(Ints d, hn::Vec<Ints> sum, hn::Vec<Ints> a, hn::Vec<Ints> b) {
  return dot4_portable(d, sum, a, b);
}
#endif

}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif
