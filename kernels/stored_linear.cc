// SPDX-License-Identifier: Apache-2.0
#include "lvggt/kernels/stored_linear.h"

#include <algorithm>
#include <cstring>

#include "lvggt/core/float16.h"
#include "lvggt/core/parallel.h"

#undef HWY_TARGET_INCLUDE
#define HWY_TARGET_INCLUDE "kernels/stored_linear.cc"
#include "hwy/foreach_target.h"
//
#include "hwy/highway.h"
#include "kernels/simd-inl.h"
#include "kernels/storage-inl.h"

#ifndef LVGGT_STORED_LINEAR_ONCE
#define LVGGT_STORED_LINEAR_ONCE
namespace lvggt::kernels {

// Weight rows multiplied together, and the part of them that is widened at a time: 4 x 512 floats
// are 8 KiB; with the same part of 6 rows of x (12 KiB) they stay in a first-level cache of 32 KiB.
inline constexpr std::int64_t kStoredRows = 4;
inline constexpr std::int64_t kStoredBlock = 512;
// Rows of x handled together: 96 x 512 floats (192 KiB) stay in a second-level cache of 512 KiB.
inline constexpr std::int64_t kStoredTokens = 96;  // a multiple of every tile's
// Weight rows of one chunk of parallel work: 64 x 4096 bf16 values (512 KiB) are read from memory
// once.
inline constexpr std::int64_t kStoredChunk = 64;

struct StoredScratch {
  float* widened = nullptr;  // [kStoredRows, kStoredBlock]
  float* sums = nullptr;     // [kStoredTokens, kStoredChunk]
};

// Rows [n0, n1) of the weight times rows [m0, m1) of x.
struct StoredPart {
  const float* x;
  std::int64_t x_stride;
  const std::byte* weight;
  Storage storage;
  std::int64_t K;
  std::int64_t n0, n1, m0, m1;
};

}  // namespace lvggt::kernels
#endif

HWY_BEFORE_NAMESPACE();
namespace lvggt::kernels::HWY_NAMESPACE {
namespace {

// Rows of x in a tile: with 4 weight rows and 32 registers 6 (24 sums, 4 weights, 1 value), with 16
// registers 2 (8 sums, 4 weights, 1 value).
inline constexpr int kTileTokens = kLanes == 16 ? 6 : 2;
inline constexpr int kTileWeights = static_cast<int>(kStoredRows);

// `count` values, zeros up to the next whole vector.
void widen(Storage storage, const std::byte* from, std::int64_t count, float* HWY_RESTRICT to) {
  const Floats d;
  std::int64_t i = 0;
  if (storage == Storage::kF32) {
    std::memcpy(to, from, static_cast<std::size_t>(count) * sizeof(float));
    i = count;
  } else {
    const auto* halves = reinterpret_cast<const std::uint16_t*>(from);
    const bool brain = storage == Storage::kBf16;
    for (; i + kLanes <= count; i += kLanes)
      hn::StoreU(brain ? widen_bf16(d, halves + i) : widen_f16(d, halves + i), d, to + i);
    for (; i < count; ++i)
      to[i] = brain ? to_float(bfloat16{halves[i]}) : to_float(float16{halves[i]});
  }
  for (; i % kLanes != 0; ++i) to[i] = 0;
}

// sums[t][r] += x[t] . weights[r] over `count` values, for the rows of one tile.
HWY_INLINE void stored_tile(const float* const* x, const float* HWY_RESTRICT weights,
                            std::int64_t count, float* HWY_RESTRICT sums) {
  const Floats d;
  hn::Vec<Floats> sum[kTileTokens][kTileWeights];
#pragma GCC unroll 8
  for (int t = 0; t < kTileTokens; ++t) {
#pragma GCC unroll 8
    for (int r = 0; r < kTileWeights; ++r) sum[t][r] = hn::Zero(d);
  }
  const auto step = [&](std::int64_t k, auto load) HWY_ATTR {
    hn::Vec<Floats> w[kTileWeights];
#pragma GCC unroll 8
    for (int r = 0; r < kTileWeights; ++r) w[r] = hn::LoadU(d, weights + r * kStoredBlock + k);
#pragma GCC unroll 8
    for (int t = 0; t < kTileTokens; ++t) {
      const auto value = load(x[t] + k);
#pragma GCC unroll 8
      for (int r = 0; r < kTileWeights; ++r) sum[t][r] = hn::MulAdd(value, w[r], sum[t][r]);
    }
  };
  std::int64_t k = 0;
  for (; k + kLanes <= count; k += kLanes)
    step(k, [d](const float* p) HWY_ATTR { return hn::LoadU(d, p); });
  if (k < count)
    step(k, [d, rest = count - k](const float* p) HWY_ATTR { return load_first(d, p, rest); });
#pragma GCC unroll 8
  for (int t = 0; t < kTileTokens; ++t) {
#pragma GCC unroll 8
    for (int r = 0; r < kTileWeights; ++r)
      sums[t * kStoredChunk + r] += hn::GetLane(hn::SumOfLanes(d, sum[t][r]));
  }
}

void run_stored_part(const StoredPart& part, const StoredScratch& scratch) {
  const auto element = static_cast<std::int64_t>(storage_bytes(part.storage));
  std::fill_n(scratch.sums, kStoredTokens * kStoredChunk, 0.0f);
  for (std::int64_t k0 = 0; k0 < part.K; k0 += kStoredBlock) {
    const std::int64_t count = std::min(kStoredBlock, part.K - k0);
    for (std::int64_t n = part.n0; n < part.n1; n += kStoredRows) {
      for (std::int64_t r = 0; r < kStoredRows; ++r) {
        // Rows beyond the last one repeat it, and their sums are dropped; so below with x.
        const std::int64_t row = std::min(n + r, part.n1 - 1);
        widen(part.storage, part.weight + (row * part.K + k0) * element, count,
              scratch.widened + r * kStoredBlock);
      }
      for (std::int64_t m = part.m0; m < part.m1; m += kTileTokens) {
        const float* x[kTileTokens];
        for (int t = 0; t < kTileTokens; ++t)
          x[t] = part.x + std::min(m + t, part.m1 - 1) * part.x_stride + k0;
        stored_tile(x, scratch.widened, count,
                    scratch.sums + (m - part.m0) * kStoredChunk + (n - part.n0));
      }
    }
  }
}

}  // namespace
}  // namespace lvggt::kernels::HWY_NAMESPACE
HWY_AFTER_NAMESPACE();

#if HWY_ONCE
namespace lvggt {

namespace kernels {
namespace {
HWY_EXPORT(run_stored_part);
}  // namespace
}  // namespace kernels

void stored_linear_forward(View<float, 2> y, View<const float, 2> x, const StoredMatrix& w,
                           View<const float, 2> residual, Context& ctx) {
  using namespace kernels;
  const std::int64_t M = x.extent(0), K = x.extent(1);
  LVGGT_CHECK(w.storage != Storage::kI8, "stored_linear: int8 weights have scales of their own");
  LVGGT_CHECK(K == w.K && y.shape() == (Shape{M, w.N}), "stored_linear: y is ", y.shape(),
              " and x ", x.shape(), " but the weight is ", Shape{w.N, w.K});
  LVGGT_CHECK(residual.empty() || residual.shape() == y.shape(), "stored_linear: residual is ",
              residual.shape(), " but y is ", y.shape());
  Arena::Scope scope(ctx.arena());
  const std::int64_t workers = ctx.num_threads();
  const auto widened = ctx.arena().alloc(Shape{workers, kStoredRows, kStoredBlock});
  const auto sums = ctx.arena().alloc(Shape{workers, kStoredTokens, kStoredChunk});
  const auto run = HWY_DYNAMIC_DISPATCH(run_stored_part);
  parallel_chunks((w.N + kStoredChunk - 1) / kStoredChunk,
                  [&](std::int64_t chunk, int worker) {
                    const std::int64_t n0 = chunk * kStoredChunk,
                                       n1 = std::min(w.N, n0 + kStoredChunk);
                    const StoredScratch scratch{widened[worker].data(), sums[worker].data()};
                    for (std::int64_t m0 = 0; m0 < M; m0 += kStoredTokens) {
                      const std::int64_t m1 = std::min(M, m0 + kStoredTokens);
                      run({x.data(), x.stride(0), w.data, w.storage, K, n0, n1, m0, m1}, scratch);
                      for (std::int64_t m = m0; m < m1; ++m) {
                        const float* from = scratch.sums + (m - m0) * kStoredChunk;
                        float* to = y[m].data() + n0;
                        const float* add = residual ? residual[m].data() + n0 : nullptr;
                        for (std::int64_t n = 0; n < n1 - n0; ++n)
                          to[n] = add ? add[n] + from[n] : from[n];
                      }
                    }
                  },
                  ctx);
}

void stored_row(View<float, 1> y, const StoredMatrix& w, std::int64_t row) {
  LVGGT_CHECK(y.extent(0) == w.K && row >= 0 && row < w.N, "stored_row: row ", row, " of ",
              Shape{w.N, w.K}, " does not become ", y.shape());
  const auto element = static_cast<std::int64_t>(storage_bytes(w.storage));
  const std::byte* from = w.data + row * w.K * element;
  for (std::int64_t k = 0; k < w.K; ++k) {
    if (w.storage == Storage::kF32) {
      std::memcpy(&y(k), from + 4 * k, sizeof(float));
    } else {
      std::uint16_t bits;
      std::memcpy(&bits, from + 2 * k, sizeof bits);
      y(k) = w.storage == Storage::kBf16 ? to_float(bfloat16{bits}) : to_float(float16{bits});
    }
  }
}

}  // namespace lvggt
#endif
