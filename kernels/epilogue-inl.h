// SPDX-License-Identifier: Apache-2.0
// What products do to their sums before storing them (see lvggt/kernels/epilogue.h).
#if defined(LVGGT_KERNELS_EPILOGUE_INL_H_) == defined(HWY_TARGET_TOGGLE)
#ifdef LVGGT_KERNELS_EPILOGUE_INL_H_
#undef LVGGT_KERNELS_EPILOGUE_INL_H_
#else
#define LVGGT_KERNELS_EPILOGUE_INL_H_
#endif

#include <cstdint>

#include "kernels/math-inl.h"
#include "kernels/product.h"
#include "kernels/simd-inl.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {

template <Activation kActivation>
HWY_INLINE hn::Vec<Floats> activate(Floats d, hn::Vec<Floats> x) {
  if constexpr (kActivation == Activation::kRelu)
    return hn::IfThenZeroElse(hn::Lt(x, hn::Zero(d)), x);
  if constexpr (kActivation == Activation::kGelu) return gelu(d, x);
  if constexpr (kActivation == Activation::kSilu) return silu(d, x);
  if constexpr (kActivation == Activation::kSigmoid) return sigmoid(d, x);
  return x;
}

// The epilogue of rows [first, last) of a chunk and channels [n0, n1); sums start at channel n0,
// rows are kSumPitch apart.
template <Activation kActivation>
void finish(const Product& p, const RowTable& table, const float* HWY_RESTRICT sums,
            std::int64_t first, std::int64_t last, std::int64_t n0, std::int64_t n1) {
  const Floats d;
  for (std::int64_t r = first; r < last; ++r) {
    const float* HWY_RESTRICT sum = sums + r * kSumPitch;
    float* y = table.y[r];
    for (std::int64_t n = n0; n < n1; n += kLanes, sum += kLanes) {
      const std::int64_t left = n1 - n;
      auto v = hn::LoadU(d, sum);
      if (p.bias) v = hn::Add(v, load_first(d, p.bias + n, left));
      v = activate<kActivation>(d, v);
      if (p.gamma) v = hn::Mul(v, load_first(d, p.gamma + n, left));
      if (p.has_residual) v = hn::Add(v, load_first(d, table.residual[r] + n, left));
      store_first(v, d, y + n, left);
    }
  }
}

inline void finish_any(const Product& p, const RowTable& table, const float* sums,
                       std::int64_t first, std::int64_t last, std::int64_t n0, std::int64_t n1) {
  switch (p.activation) {
    case Activation::kNone:
      return finish<Activation::kNone>(p, table, sums, first, last, n0, n1);
    case Activation::kRelu:
      return finish<Activation::kRelu>(p, table, sums, first, last, n0, n1);
    case Activation::kGelu:
      return finish<Activation::kGelu>(p, table, sums, first, last, n0, n1);
    case Activation::kSilu:
      return finish<Activation::kSilu>(p, table, sums, first, last, n0, n1);
    case Activation::kSigmoid:
      return finish<Activation::kSigmoid>(p, table, sums, first, last, n0, n1);
  }
}

}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#endif
