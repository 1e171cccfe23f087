// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/swiglu.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/swiglu.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

void swiglu_row(float* y, const float* gate, const float* up, std::int64_t C) {
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    hn::StoreU(hn::Mul(silu(d, hn::LoadU(d, gate + i)), hn::LoadU(d, up + i)), d, y + i);
  });
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(swiglu_row);
auto swiglu_row_function() { return &HWY_DYNAMIC_DISPATCH(swiglu_row); }

}  // namespace
}  // namespace kernels

void swiglu_forward(View<float, 2> y, View<const float, 2> gate, View<const float, 2> up,
                    Context& ctx) {
  LVGGT_CHECK(y.shape() == gate.shape() && y.shape() == up.shape(), "swiglu: y is ", y.shape(),
              " but gate is ", gate.shape(), " and up ", up.shape());
  const auto row = kernels::swiglu_row_function();
  const std::int64_t C = y.extent(1);
  parallel_rows(
      y.extent(0), kernels::rows_per_chunk(C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n)
          row(y[n].data(), gate[n].data(), up[n].data(), C);
      },
      ctx);
}

}  // namespace lvggt
#endif  // HWY_ONCE
