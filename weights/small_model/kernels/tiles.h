// SPDX-License-Identifier: Apache-2.0
// What attention.cc and matching.cc share: a tile of queries at a time against all keys that their
// frame may see, so that scores stay in the cache. Heads have 32 values.
#pragma once

#include <algorithm>
#include <bit>
#include <cmath>
#include <cstdint>
#include <vector>

namespace small_model {

constexpr int kHead = 32, kLane = 16, kTile = 36, kKeys = 64;
typedef float Lanes __attribute__((vector_size(4 * kLane)));
typedef int32_t Whole __attribute__((vector_size(4 * kLane)));
typedef float Loose __attribute__((vector_size(4 * kLane), aligned(4), may_alias));

inline Lanes load(const float* p) { return *reinterpret_cast<const Loose*>(p); }
inline void store(float* p, Lanes x) { *reinterpret_cast<Loose*>(p) = x; }
inline Lanes all(float x) { return Lanes{} + x; }

inline float sum(Lanes x) {
  float total = 0;
  for (int i = 0; i < kLane; ++i) total += x[i];
  return total;
}

// e to the x for x <= 0, to 2e-7 of its value; 0 below -87.
inline Lanes exponential(Lanes x) {
  const Lanes shifter = all(12582912.f);  // its last bit is 1: adding it rounds
  const Lanes n = (x * 1.44269504f + shifter) - shifter;
  const Lanes r = (x - n * 0.693359375f) + n * 2.12194440e-4f;
  Lanes y = all(1.f / 720);
  for (float c : {1.f / 120, 1.f / 24, 1.f / 6, 0.5f, 1.f, 1.f}) y = y * r + c;
  const Whole power = (__builtin_convertvector(n, Whole) + 127) << 23;
  return x < -87.f ? Lanes{} : y * std::bit_cast<Lanes>(power);
}

// LayerNorm of queries or keys and the rotary embedding of their places, or nothing (null).
struct Shape {
  const float *weight, *bias;    // [kHead]
  const float *cosines, *sines;  // [tokens, kHead]; a sine's sign is that with which the value a
                                 // quarter further is added
};

struct Row {
  Lanes low, high;
};

inline Row operator*(Row a, Row b) { return {a.low * b.low, a.high * b.high}; }
inline Row operator+(Row a, Row b) { return {a.low + b.low, a.high + b.high}; }
inline Row operator*(float a, Row b) { return {a * b.low, a * b.high}; }
inline Row load_row(const float* p) { return {load(p), load(p + kLane)}; }
inline void store_row(float* p, Row r) { store(p, r.low), store(p + kLane, r.high); }
inline float mean(Row r) { return sum(r.low + r.high) / kHead; }

// The values a quarter further, in each half.
inline Row turned(Row r) {
  const Whole swap = {8, 9, 10, 11, 12, 13, 14, 15, 0, 1, 2, 3, 4, 5, 6, 7};
  return {__builtin_shuffle(r.low, swap), __builtin_shuffle(r.high, swap)};
}

struct Normal {
  Row values;
  float scale;
};

inline Normal normal(Row x) {
  constexpr float kEpsilon = 1e-5f;
  const Row centred = x + Row{all(-mean(x)), all(-mean(x))};
  const float scale = 1 / std::sqrt(mean(centred * centred) + kEpsilon);
  return {scale * centred, scale};
}

inline Row shaped(Row x, const Shape& s, int64_t token) {
  if (s.weight) x = load_row(s.weight) * normal(x).values + load_row(s.bias);
  if (s.cosines)
    x = x * load_row(s.cosines + token * kHead) + turned(x) * load_row(s.sines + token * kHead);
  return x;
}

// From the gradient of shaped(x) that of x; adds those of weight and bias to sums [2][kHead].
inline Row shaped_gradient(Row x, Row given, const Shape& s, int64_t token, float* sums) {
  if (s.cosines)
    given = given * load_row(s.cosines + token * kHead) +
            turned(given * load_row(s.sines + token * kHead));
  if (!s.weight) return given;
  const Normal n = normal(x);
  store_row(sums, load_row(sums) + given * n.values);
  store_row(sums + kHead, load_row(sums + kHead) + given);
  const Row inner = given * load_row(s.weight);
  const float level = mean(inner), slope = mean(inner * n.values);
  return n.scale * (inner + Row{all(-level), all(-level)} + -slope * n.values);
}

// [tokens, kHead] of one head: rows `step` apart.
struct Rows {
  float* data;
  int64_t step;
  float* operator[](int64_t i) const { return data + i * step; }
};

// scores[q][k] = a[q] . b[k] for kTile rows a and `keys` columns of b's transpose.
inline void products(const float* a, const float* transposed, int64_t ld, int64_t keys,
                     float* scores) {
  constexpr int kRows = 6, kWide = kKeys / kLane;
  for (int64_t k = 0; k < keys; k += kKeys)
    for (int q = 0; q < kTile; q += kRows) {
      Lanes acc[kRows][kWide] = {};
      for (int d = 0; d < kHead; ++d) {
        Lanes b[kWide];
        for (int j = 0; j < kWide; ++j) b[j] = load(transposed + d * ld + k + j * kLane);
        for (int i = 0; i < kRows; ++i)
          for (int j = 0; j < kWide; ++j) acc[i][j] += a[(q + i) * kHead + d] * b[j];
      }
      for (int i = 0; i < kRows; ++i)
        for (int j = 0; j < kWide; ++j) store(scores + (q + i) * ld + k + j * kLane, acc[i][j]);
    }
}

// out[q] = sum over keys of weights[q][k] values[k].
inline void gather(const float* weights, int64_t ld, const float* values, int64_t keys,
                   float* out) {
  constexpr int kRows = 12;
  for (int q = 0; q < kTile; q += kRows) {
    Lanes acc[kRows][2] = {};
    for (int64_t k = 0; k < keys; ++k) {
      const Lanes low = load(values + k * kHead), high = load(values + k * kHead + kLane);
      for (int i = 0; i < kRows; ++i) {
        const float w = weights[(q + i) * ld + k];
        acc[i][0] += w * low;
        acc[i][1] += w * high;
      }
    }
    for (int i = 0; i < kRows; ++i)
      for (int j = 0; j < 2; ++j) store(out + (q + i) * kHead + j * kLane, acc[i][j]);
  }
}

// sums[k] += sum over the tile's queries of weights[q][k] rows[q].
inline void scatter(const float* weights, int64_t ld, const float* rows, int64_t keys,
                    float* sums) {
  constexpr int kCount = 8;
  for (int64_t k = 0; k < keys; k += kCount) {
    Lanes acc[kCount][2];
    for (int i = 0; i < kCount; ++i)
      for (int j = 0; j < 2; ++j) acc[i][j] = load(sums + (k + i) * kHead + j * kLane);
    for (int q = 0; q < kTile; ++q) {
      const Lanes low = load(rows + q * kHead), high = load(rows + q * kHead + kLane);
      for (int i = 0; i < kCount; ++i) {
        const float w = weights[q * ld + k + i];
        acc[i][0] += w * low;
        acc[i][1] += w * high;
      }
    }
    for (int i = 0; i < kCount; ++i)
      for (int j = 0; j < 2; ++j) store(sums + (k + i) * kHead + j * kLane, acc[i][j]);
  }
}

inline int64_t padded(int64_t n) { return (n + kKeys - 1) / kKeys * kKeys; }

struct Side {  // keys or values of one head, as rows and transposed, zeros behind the last
  std::vector<float> rows, transposed;
  void take(Rows from, const Shape& shape, int64_t n, int64_t ld) {
    rows.assign(ld * kHead, 0);
    transposed.assign(ld * kHead, 0);
    for (int64_t i = 0; i < n; ++i) {
      store_row(&rows[i * kHead], shaped(load_row(from[i]), shape, i));
      for (int d = 0; d < kHead; ++d) transposed[d * ld + i] = rows[i * kHead + d];
    }
  }
};

inline const float kScale = 1 / std::sqrt(static_cast<float>(kHead));

inline void take_tile(Rows from, const Shape& shape, int64_t begin, int count, float scale,
                      float* tile) {
  std::fill(tile, tile + kTile * kHead, 0.f);
  for (int q = 0; q < count; ++q)
    store_row(tile + q * kHead, scale * shaped(load_row(from[begin + q]), shape, begin + q));
}

// Calls use(first query, their count, keys they see) for tiles that do not cross frames.
template <class Use>
void tiles(int64_t n, int64_t frame, Use use) {
  for (int64_t start = 0; start < n; start += frame)
    for (int64_t q = start; q < start + frame; q += kTile)
      use(q, static_cast<int>(std::min<int64_t>(kTile, start + frame - q)), start + frame);
}

// scores [kTile][ld] to exponentials of their distance to each row's largest, `seen` of them; sums
// and logarithms of sums.
inline void exponentials(float* scores, int64_t ld, int64_t seen, float* sums, float* log_sums) {
  for (int i = 0; i < kTile; ++i) {
    float* row = scores + i * ld;
    std::fill(row + seen, row + padded(seen), -INFINITY);
    Lanes most = all(-INFINITY), total = {};
    for (int64_t j = 0; j < seen; j += kLane) {
      const Lanes x = load(row + j);
      most = x > most ? x : most;
    }
    float top = most[0];
    for (int l = 1; l < kLane; ++l) top = std::max(top, most[l]);
    for (int64_t j = 0; j < padded(seen); j += kLane) {
      const Lanes e = exponential(load(row + j) - top);
      store(row + j, e);
      total += e;
    }
    sums[i] = sum(total);
    log_sums[i] = top + std::log(sums[i]);
  }
}

}  // namespace small_model
