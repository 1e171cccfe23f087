// SPDX-License-Identifier: Apache-2.0
// Vector mathematics shared by the kernels: row loops with their remainder, exp, expm1, sigmoid,
// SiLU, GELU. Included once for every instruction set (see hwy/foreach_target.h).
//
// The polynomials are weighted minimax fits (Lawson's iteration on a Chebyshev basis in double,
// against 40 digit values), rounded to float. Errors are the worst measured over every 97th float
// of the range named, on SSE4, AVX2 and AVX-512.

#if defined(LVGGT_KERNELS_MATH_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LVGGT_KERNELS_MATH_INL_H_
#undef LVGGT_KERNELS_MATH_INL_H_
#else
#define LVGGT_KERNELS_MATH_INL_H_
#endif

#include <hwy/highway.h>

#include <cstdint>
#include <limits>

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace hn = hwy::HWY_NAMESPACE;

// Calls body(d, i) for consecutive, disjoint groups of Lanes(d) elements that cover [begin, end):
// full vectors first, then at most one vector of each smaller power of two. Nothing outside is
// touched, so the body may load and store whole vectors.
template <std::size_t kLanes, class Body>
HWY_INLINE void for_each_remainder(std::int64_t begin, std::int64_t end, const Body& body) {
  const hn::CappedTag<float, kLanes> d;
  const auto N = static_cast<std::int64_t>(hn::Lanes(d));
  for (; begin + N <= end; begin += N) body(d, begin);
  if constexpr (kLanes > 1) {
    if (begin < end) for_each_remainder<kLanes / 2>(begin, end, body);
  }
}
template <class Body>
HWY_INLINE void for_each_vector(std::int64_t count, const Body& body) {
  for_each_remainder<HWY_MAX_BYTES / sizeof(float)>(0, count, body);
}

// Sum over [0, count) of term(d, i), which returns the terms i .. i + Lanes(d) - 1. Four
// accumulators hide the latency of the additions and make each partial sum short.
template <std::size_t kLanes, class Term>
HWY_INLINE float sum_remainder(std::int64_t begin, std::int64_t end, const Term& term) {
  const hn::CappedTag<float, kLanes> d;
  const auto N = static_cast<std::int64_t>(hn::Lanes(d));
  auto sum = hn::Zero(d);
  for (; begin + N <= end; begin += N) sum = hn::Add(sum, term(d, begin));
  float total = hn::GetLane(hn::SumOfLanes(d, sum));
  if constexpr (kLanes > 1) {
    if (begin < end) total += sum_remainder<kLanes / 2>(begin, end, term);
  }
  return total;
}
template <class Term>
HWY_INLINE float sum_vectors(std::int64_t count, const Term& term) {
  const hn::ScalableTag<float> d;
  const auto N = static_cast<std::int64_t>(hn::Lanes(d));
  auto sum0 = hn::Zero(d), sum1 = sum0, sum2 = sum0, sum3 = sum0;
  std::int64_t i = 0;
  for (; i + 4 * N <= count; i += 4 * N) {
    sum0 = hn::Add(sum0, term(d, i));
    sum1 = hn::Add(sum1, term(d, i + N));
    sum2 = hn::Add(sum2, term(d, i + 2 * N));
    sum3 = hn::Add(sum3, term(d, i + 3 * N));
  }
  const auto sum = hn::Add(hn::Add(sum0, sum1), hn::Add(sum2, sum3));
  return hn::GetLane(hn::SumOfLanes(d, sum)) +
         sum_remainder<HWY_MAX_BYTES / sizeof(float)>(i, count, term);
}

// x = n ln2 + r with |r| <= ln2 / 2. Adding 1.5 * 2^23 rounds to an integer and leaves n in the low
// bits of the sum. ln2 is split so that n times the first part is exact for every |n| < 2^15, with
// or without FMA.
template <class V>
struct SplitExponent {
  V n;        // as a float
  V shifted;  // n + 1.5 * 2^23, its low bits are n
  V r;
};
template <class D, class V = hn::Vec<D>>
HWY_INLINE SplitExponent<V> split_exponent(D d, V x) {
  const V magic = hn::Set(d, 12582912.0f);
  const V shifted = hn::MulAdd(x, hn::Set(d, 1.44269504f), magic);
  const V n = hn::Sub(shifted, magic);
  V r = hn::NegMulAdd(n, hn::Set(d, 0.693359375f), x);
  r = hn::NegMulAdd(n, hn::Set(d, -2.12194440e-4f), r);
  return {n, shifted, r};
}

// exp(x) for x <= 88.72 (where the result is finite), 0 below ln(2^-126) and for -inf. NaN for a
// NaN whose low 9 bits are zero, the only one that arithmetic makes. Within 1.1 ulp. For the
// softmax, whose argument is never positive.
template <class D, class V = hn::Vec<D>>
HWY_INLINE V exp_nonpositive(D d, V x) {
  const SplitExponent<V> split = split_exponent(d, x);
  const V r = split.r;
  // (exp(r) - 1 - r) / r^2, relative error of exp 3.1e-9.
  V p = hn::Set(d, 0.0013814433477818966f);
  p = hn::MulAdd(p, r, hn::Set(d, 0.008368796668946743f));
  p = hn::MulAdd(p, r, hn::Set(d, 0.041668396443128586f));
  p = hn::MulAdd(p, r, hn::Set(d, 0.1666651964187622f));
  p = hn::MulAdd(p, r, hn::Set(d, 0.4999999403953552f));
  p = hn::Add(hn::MulAdd(hn::Mul(r, r), p, r), hn::Set(d, 1.0f));
  // Times 2^n by adding n to the exponent field: p is in (0.7, 1.42), and the result is normal.
  const hn::RebindToSigned<D> di;
  const auto exponent = hn::ShiftLeft<23>(hn::BitCast(di, split.shifted));
  const V y = hn::BitCast(d, hn::Add(hn::BitCast(di, p), exponent));
  return hn::IfThenZeroElse(hn::Lt(x, hn::Set(d, -87.3365448f)), y);
}

// exp(x) for any x: infinity above 88.7228, 0 below -87.3365 (where the result would not be a
// normal number), NaN for NaN. Within 1.1 ulp.
template <class D, class V = hn::Vec<D>>
HWY_INLINE V exp(D d, V x) {
  const V infinity = hn::Set(d, std::numeric_limits<float>::infinity());
  return hn::IfThenElse(hn::Le(x, hn::Set(d, 88.7228394f)), exp_nonpositive(d, x),
                        hn::Add(x, infinity));
}

// exp(x) - 1 without cancellation: infinity above 88.7228, -1 below -25, NaN for NaN. Within 1.5
// ulp for positive x.
template <class D, class V = hn::Vec<D>>
HWY_INLINE V expm1(D d, V x) {
  const SplitExponent<V> split = split_exponent(d, x);
  const V r = split.r;
  // (exp(r) - 1 - r) / r^2, relative error of exp(r) - 1 2.4e-10.
  V p = hn::Set(d, 0.0001991433382499963f);
  p = hn::MulAdd(p, r, hn::Set(d, 0.0013941125944256783f));
  p = hn::MulAdd(p, r, hn::Set(d, 0.008333273231983185f));
  p = hn::MulAdd(p, r, hn::Set(d, 0.04166635498404503f));
  p = hn::MulAdd(p, r, hn::Set(d, 0.1666666716337204f));
  p = hn::MulAdd(p, r, hn::Set(d, 0.5f));
  const V expm1_r = hn::MulAdd(hn::Mul(r, r), p, r);
  // 2^n (exp(r) - 1) + (2^n - 1), computed at half its size because 2^128 is no float.
  const hn::RebindToSigned<D> di;
  const auto exponent =
      hn::ShiftLeft<23>(hn::Add(hn::BitCast(di, split.shifted), hn::Set(di, 126)));
  const V half_scale = hn::BitCast(d, exponent);
  V y = hn::MulAdd(half_scale, expm1_r, hn::Sub(half_scale, hn::Set(d, 0.5f)));
  y = hn::Add(y, y);
  y = hn::IfThenElse(hn::Lt(x, hn::Set(d, -25.0f)), hn::Set(d, -1.0f), y);
  const V infinity = hn::Set(d, std::numeric_limits<float>::infinity());
  return hn::IfThenElse(hn::Le(x, hn::Set(d, 88.7228394f)), y, hn::Add(x, infinity));
}

// 1 / (1 + exp(-x)), NaN for NaN. Within 2.5 ulp down to x = -87, 0 below -88.7228.
template <class D, class V = hn::Vec<D>>
HWY_INLINE V sigmoid(D d, V x) {
  const V one = hn::Set(d, 1.0f);
  return hn::Div(one, hn::Add(one, exp(d, hn::Neg(x))));
}

// x / (1 + exp(-x)), NaN for NaN and, as in the reference, for -inf. Within 2.5 ulp down to x =
// -87.
template <class D, class V = hn::Vec<D>>
HWY_INLINE V silu(D d, V x) {
  return hn::Div(x, hn::Add(hn::Set(d, 1.0f), exp(d, hn::Neg(x))));
}

// P(Z > a) = erfc(a / sqrt 2) / 2 of a normal variable as 1 / (2 D(a)^8), where D is a polynomial
// of degree 9 with D(0) = 1 (fit on [0, 6.2], error of a P 9.1e-9). Returns D(a)^4; 0 <= a <= 10.
// The tail needs no exponential, and beyond 10 it is 0 to float accuracy.
template <class D, class V = hn::Vec<D>>
HWY_INLINE V normal_tail_root(D d, V a) {
  V p = hn::Set(d, 3.654438671674143e-07f);
  p = hn::MulAdd(p, a, hn::Set(d, -2.351391458432772e-06f));
  p = hn::MulAdd(p, a, hn::Set(d, 1.462867840018589e-05f));
  p = hn::MulAdd(p, a, hn::Set(d, -1.6191997929126956e-06f));
  p = hn::MulAdd(p, a, hn::Set(d, 0.00029232504311949015f));
  p = hn::MulAdd(p, a, hn::Set(d, 0.0007878931355662644f));
  p = hn::MulAdd(p, a, hn::Set(d, 0.008706885389983654f));
  p = hn::MulAdd(p, a, hn::Set(d, 0.04475419968366623f));
  p = hn::MulAdd(p, a, hn::Set(d, 0.09973636269569397f));
  p = hn::MulAdd(p, a, hn::Set(d, 1.0f));
  const V p2 = hn::Mul(p, p);
  return hn::Mul(p2, p2);
}

// x/2 (1 + erf(x / sqrt 2)) as max(x, 0) - h(|x|) with h(a) = a P(Z > a). Absolute error within
// 1.8e-7 max(1, |x|); NaN for NaN and for -inf.
template <class D, class V = hn::Vec<D>>
HWY_INLINE V gelu(D d, V x) {
  const V half = hn::Set(d, 0.5f);
  const V magnitude = hn::Abs(x);
  const V a = hn::Min(magnitude, hn::Set(d, 10.0f));
  const V p4 = normal_tail_root(d, a);
  const V h = hn::Div(a, hn::Mul(p4, hn::Add(p4, p4)));
  return hn::MulAdd(x, half, hn::MulSub(magnitude, half, h));
}

// The derivative of gelu, Phi(x) + x phi(x): with a = |x| and s its sign, that is 1/2 + s (1/2 -
// P(Z > a) + a phi(a)). Absolute error within 5e-7; NaN for NaN.
template <class D, class V = hn::Vec<D>>
HWY_INLINE V gelu_slope(D d, V x) {
  const V half = hn::Set(d, 0.5f);
  const V a = hn::Min(hn::Abs(x), hn::Set(d, 10.0f));
  const V p4 = normal_tail_root(d, a);
  const V tail = hn::Div(half, hn::Mul(p4, p4));
  const V density =
      hn::Mul(hn::Set(d, 0.3989422804f), exp_nonpositive(d, hn::Mul(hn::Mul(a, a), hn::Neg(half))));
  const V odd = hn::MulAdd(a, density, hn::Sub(half, tail));
  const V slope = hn::Add(half, hn::CopySign(odd, x));
  return hn::IfThenElse(hn::Eq(x, x), slope, x);
}

}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif  // LVGGT_KERNELS_MATH_INL_H_
