// SPDX-License-Identifier: Apache-2.0
// The passes of a batch norm over a row of pixels.
#if defined(LVGGT_KERNELS_BATCH_NORM2D_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LVGGT_KERNELS_BATCH_NORM2D_INL_H_
#undef LVGGT_KERNELS_BATCH_NORM2D_INL_H_
#else
#define LVGGT_KERNELS_BATCH_NORM2D_INL_H_
#endif

#include <cstdint>

#include "kernels/batch_norm2d.h"
#include "kernels/math-inl.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {

// As for_each_vector, in steps of a vector of doubles.
template <std::size_t kLanes, class Body>
HWY_INLINE void for_each_double_remainder(std::int64_t begin, std::int64_t end, const Body& body) {
  const hn::CappedTag<double, kLanes> d;
  const auto N = static_cast<std::int64_t>(hn::Lanes(d));
  for (; begin + N <= end; begin += N) body(d, begin);
  if constexpr (kLanes > 1) {
    if (begin < end) for_each_double_remainder<kLanes / 2>(begin, end, body);
  }
}
template <class Body>
HWY_INLINE void for_each_double_vector(std::int64_t count, const Body& body) {
  for_each_double_remainder<HWY_MAX_BYTES / sizeof(double)>(0, count, body);
}

// sums[0] += sum of a, sums[1] += sum of a b over the pixels of a row, for the (a, b) that
// terms(d, w, c) returns as doubles. Two pixels at a time, so that four chains of additions hide
// each other's latency.
template <class Terms>
HWY_INLINE void add_sums(double* HWY_RESTRICT sums, std::int64_t W, std::int64_t C,
                         const Terms& terms) {
  for_each_double_vector(C, [=](auto d, std::int64_t c) HWY_ATTR {
    auto first0 = hn::LoadU(d, sums + c), second0 = hn::LoadU(d, sums + C + c);
    auto first1 = hn::Zero(d), second1 = first1;
    std::int64_t w = 0;
    for (; w + 2 <= W; w += 2) {
      const auto even = terms(d, w, c);
      const auto odd = terms(d, w + 1, c);
      first0 = hn::Add(first0, even.a);
      first1 = hn::Add(first1, odd.a);
      second0 = hn::MulAdd(even.a, even.b, second0);
      second1 = hn::MulAdd(odd.a, odd.b, second1);
    }
    if (w < W) {
      const auto last = terms(d, w, c);
      first0 = hn::Add(first0, last.a);
      second0 = hn::MulAdd(last.a, last.b, second0);
    }
    hn::StoreU(hn::Add(first0, first1), d, sums + c);
    hn::StoreU(hn::Add(second0, second1), d, sums + C + c);
  });
}

template <class V>
struct TermPair {
  V a, b;
};

inline void batch_sums_row(double* HWY_RESTRICT sums, const BatchNormRow& row,
                           const double* HWY_RESTRICT pivot, std::int64_t C) {
  const float* HWY_RESTRICT x = row.x;
  const std::int64_t step = row.x_step;
  add_sums(sums, row.W, C, [=](auto d, std::int64_t w, std::int64_t c) HWY_ATTR {
    const hn::Rebind<float, decltype(d)> df;
    const auto wide = hn::PromoteTo(d, hn::LoadU(df, x + w * step + c));
    const auto deviation = hn::Sub(wide, hn::LoadU(d, pivot + c));
    return TermPair<hn::Vec<decltype(d)>>{deviation, deviation};
  });
}

// x - mean, and with it the layer's output before the activation: the same instructions in the
// forward and in the backward pass, so that both see the same sign.
template <class D>
HWY_INLINE hn::Vec<D> centered(D d, const float* HWY_RESTRICT x, const BatchNormChannels& ch,
                               std::int64_t c) {
  return hn::Sub(hn::LoadU(d, x + c), hn::LoadU(d, ch.mean + c));
}
template <class D>
HWY_INLINE hn::Vec<D> affine(D d, hn::Vec<D> centered_x, const BatchNormChannels& ch,
                             std::int64_t c) {
  return hn::MulAdd(centered_x, hn::LoadU(d, ch.scale + c), hn::LoadU(d, ch.beta + c));
}

// g: dy where the activation passed it on.
template <bool kRelu, class D>
HWY_INLINE hn::Vec<D> passed_on(D d, const float* dy, hn::Vec<D> centered_x,
                                const BatchNormChannels& ch, std::int64_t c) {
  const auto v = hn::LoadU(d, dy + c);
  if constexpr (!kRelu) return v;
  return hn::IfThenElseZero(hn::Gt(affine(d, centered_x, ch, c), hn::Zero(d)), v);
}

template <bool kRelu>
inline void normalize_pixels(const BatchNormRow& row, const BatchNormChannels& ch) {
  for (std::int64_t w = 0; w < row.W; ++w) {
    const float* x = row.x + w * row.x_step;
    float* y = row.out + w * row.out_step;
    for_each_vector(ch.C, [=, &ch](auto d, std::int64_t c) HWY_ATTR {
      auto v = affine(d, centered(d, x, ch, c), ch, c);
      if constexpr (kRelu) v = hn::IfThenZeroElse(hn::Le(v, hn::Zero(d)), v);  // NaN stays NaN
      hn::StoreU(v, d, y + c);
    });
  }
}
inline void normalize_row(const BatchNormRow& row, const BatchNormChannels& ch, bool relu) {
  return relu ? normalize_pixels<true>(row, ch) : normalize_pixels<false>(row, ch);
}

template <bool kRelu>
inline void backward_sums_pixels(double* HWY_RESTRICT sums, const BatchNormRow& row,
                                 const BatchNormChannels& ch) {
  add_sums(sums, row.W, ch.C, [&](auto d, std::int64_t w, std::int64_t c) HWY_ATTR {
    const hn::Rebind<float, decltype(d)> df;
    const auto deviation = centered(df, row.x + w * row.x_step, ch, c);
    const auto g = passed_on<kRelu>(df, row.dy + w * row.dy_step, deviation, ch, c);
    const auto n = hn::Mul(deviation, hn::LoadU(df, ch.rstd + c));
    return TermPair<hn::Vec<decltype(d)>>{hn::PromoteTo(d, g), hn::PromoteTo(d, n)};
  });
}
inline void backward_sums_row(double* HWY_RESTRICT sums, const BatchNormRow& row,
                              const BatchNormChannels& ch, bool relu) {
  return relu ? backward_sums_pixels<true>(sums, row, ch)
              : backward_sums_pixels<false>(sums, row, ch);
}

template <bool kRelu, bool kFrozen>
inline void backward_input_pixels(const BatchNormRow& row, const BatchNormChannels& ch) {
  for (std::int64_t w = 0; w < row.W; ++w) {
    const float* x = row.x + w * row.x_step;
    const float* dy = row.dy + w * row.dy_step;
    float* dx = row.out + w * row.out_step;
    for_each_vector(ch.C, [=, &ch](auto d, std::int64_t c) HWY_ATTR {
      const auto deviation = centered(d, x, ch, c);
      auto v = passed_on<kRelu>(d, dy, deviation, ch, c);
      if constexpr (!kFrozen) {
        const auto n = hn::Mul(deviation, hn::LoadU(d, ch.rstd + c));
        v = hn::NegMulAdd(n, hn::LoadU(d, ch.avg_gn + c), hn::Sub(v, hn::LoadU(d, ch.avg_g + c)));
      }
      hn::StoreU(hn::Mul(v, hn::LoadU(d, ch.scale + c)), d, dx + c);
    });
  }
}
inline void backward_input_row(const BatchNormRow& row, const BatchNormChannels& ch, bool relu) {
  const bool frozen = ch.avg_g == nullptr;
  if (relu)
    return frozen ? backward_input_pixels<true, true>(row, ch)
                  : backward_input_pixels<true, false>(row, ch);
  return frozen ? backward_input_pixels<false, true>(row, ch)
                : backward_input_pixels<false, false>(row, ch);
}

}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif
