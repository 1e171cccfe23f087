// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/elementwise.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/elementwise.cc"
#include <hwy/foreach_target.h>
#include <hwy/highway.h>

#include <algorithm>
#include <cmath>

#include "kernels/grain.h"
#include "kernels/math-inl.h"
#include "lvggt/core/parallel.h"

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

void add_row(float* y, const float* a, const float* b, std::int64_t C) {
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    hn::StoreU(hn::Add(hn::LoadU(d, a + i), hn::LoadU(d, b + i)), d, y + i);
  });
}

void modulate_row(float* y, const float* x, const float* HWY_RESTRICT shift,
                  const float* HWY_RESTRICT scale, const float* HWY_RESTRICT gate, const float* t,
                  std::int64_t C) {
  for_each_vector(C, [=](auto d, std::int64_t i) HWY_ATTR {
    const auto factor = hn::Add(hn::LoadU(d, scale + i), hn::Set(d, 1.0f));
    const auto modulated = hn::MulAdd(hn::LoadU(d, x + i), factor, hn::LoadU(d, shift + i));
    hn::StoreU(hn::MulAdd(hn::LoadU(d, gate + i), modulated, hn::LoadU(d, t + i)), d, y + i);
  });
}

// 0 x is 0 for every finite x and NaN for the others, so one sum tells for the whole block.
bool all_finite(const float* HWY_RESTRICT x, std::int64_t count) {
  return sum_vectors(count, [=](auto d, std::int64_t i) HWY_ATTR {
           return hn::Mul(hn::LoadU(d, x + i), hn::Zero(d));
         }) == 0.0f;
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {
namespace kernels {
namespace {

HWY_EXPORT(add_row);
HWY_EXPORT(modulate_row);
HWY_EXPORT(all_finite);
auto add_row_function() { return &HWY_DYNAMIC_DISPATCH(add_row); }
auto modulate_row_function() { return &HWY_DYNAMIC_DISPATCH(modulate_row); }
auto all_finite_function() { return &HWY_DYNAMIC_DISPATCH(all_finite); }

// Calls visit(pixel, channel, count) for tiles of up to 64 pixels of a row: the tile's pixels stay
// in L1 while its channels are walked one by one (64 pixels of 128 channels are 32 KiB).
template <class Visit>
void for_each_channel_run(std::int64_t W, std::int64_t C, const Visit& visit) {
  constexpr std::int64_t kTile = 64;
  for (std::int64_t w = 0; w < W; w += kTile)
    for (std::int64_t c = 0; c < C; ++c) visit(w, c, std::min(kTile, W - w));
}

void check_planes(const char* op, const Shape<3>& planes, const Shape<3>& pixels) {
  LVGGT_CHECK(planes[0] == pixels[2] && planes[1] == pixels[0] && planes[2] == pixels[1], op,
              ": planes are ", planes, " but pixels are ", pixels);
}

}  // namespace
}  // namespace kernels

void add(View<float, 2> y, View<const float, 2> a, View<const float, 2> b, Context& ctx) {
  LVGGT_CHECK(a.shape() == y.shape() && b.shape() == y.shape(), "add: y is ", y.shape(),
              " but a is ", a.shape(), " and b is ", b.shape());
  const auto row = kernels::add_row_function();
  parallel_rows(
      y.extent(0), kernels::rows_per_chunk(y.extent(1)),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n)
          row(y[n].data(), a[n].data(), b[n].data(), y.extent(1));
      },
      ctx);
}

void modulate(View<float, 2> y, View<const float, 2> x, View<const float, 2> shift,
              View<const float, 2> scale, View<const float, 2> gate, View<const float, 2> t,
              Context& ctx) {
  for (const auto& operand : {x, shift, scale, gate, t})
    LVGGT_CHECK(operand.shape() == y.shape(), "modulate: y is ", y.shape(), " but an operand is ",
                operand.shape());
  const auto row = kernels::modulate_row_function();
  parallel_rows(
      y.extent(0), kernels::rows_per_chunk(y.extent(1)),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n)
          row(y[n].data(), x[n].data(), shift[n].data(), scale[n].data(), gate[n].data(),
              t[n].data(), y.extent(1));
      },
      ctx);
}

void copy_rows(View<float, 2> y, View<const float, 2> x, Context& ctx) {
  LVGGT_CHECK(y.shape() == x.shape(), "copy_rows: y is ", y.shape(), " but x is ", x.shape());
  parallel_rows(
      y.extent(0), kernels::rows_per_chunk(y.extent(1)),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t n = begin; n < end; ++n)
          std::copy_n(x[n].data(), y.extent(1), y[n].data());
      },
      ctx);
}

void to_planes(View<float, 3> planes, View<const float, 3> pixels, Context& ctx) {
  kernels::check_planes("to_planes", planes.shape(), pixels.shape());
  const std::int64_t W = planes.extent(2), C = planes.extent(0), step = pixels.stride(1);
  parallel_rows(
      planes.extent(1), kernels::rows_per_chunk(W * C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t h = begin; h < end; ++h)
          kernels::for_each_channel_run(W, C,
                                        [&](std::int64_t w, std::int64_t c, std::int64_t count) {
                                          const float* from = pixels[h][w].data() + c;
                                          float* to = planes[c][h].data() + w;
                                          for (std::int64_t i = 0; i < count; ++i)
                                            to[i] = from[i * step];
                                        });
      },
      ctx);
}

void from_planes(View<float, 3> pixels, View<const float, 3> planes, Context& ctx) {
  kernels::check_planes("from_planes", planes.shape(), pixels.shape());
  const std::int64_t W = planes.extent(2), C = planes.extent(0), step = pixels.stride(1);
  parallel_rows(
      planes.extent(1), kernels::rows_per_chunk(W * C),
      [&](std::int64_t begin, std::int64_t end) {
        for (std::int64_t h = begin; h < end; ++h)
          kernels::for_each_channel_run(W, C,
                                        [&](std::int64_t w, std::int64_t c, std::int64_t count) {
                                          const float* from = planes[c][h].data() + w;
                                          float* to = pixels[h][w].data() + c;
                                          for (std::int64_t i = 0; i < count; ++i)
                                            to[i * step] = from[i];
                                        });
      },
      ctx);
}

std::int64_t find_nonfinite(View<const float, 1> x) {
  const auto all_finite = kernels::all_finite_function();
  constexpr std::int64_t kBlock = 4096;  // half of a 32 KiB L1, should it have to be searched
  for (std::int64_t begin = 0; begin < x.extent(0); begin += kBlock) {
    const std::int64_t end = std::min(begin + kBlock, x.extent(0));
    if (all_finite(x.data() + begin, end - begin)) continue;
    for (std::int64_t i = begin; i < end; ++i)
      if (!std::isfinite(x[i])) return i;
  }
  return -1;
}

}  // namespace lvggt
#endif  // HWY_ONCE
