// SPDX-License-Identifier: Apache-2.0
// Attention of whole clips and its gradients for training on a CPU. PyTorch keeps all scores in
// memory, several times over, and spends half of a step there. attention.py calls it.
#include "tiles.h"

using namespace small_model;

namespace {

struct Head {  // of one clip
  Rows q, k, v, out, dout, dq, dk, dv;
  float *log_sums, *shaped_q, *shaped_k;  // [tokens]; [tokens, kHead] or null
  const float *dshaped_q, *dshaped_k;     // [tokens, kHead] or null
  float* dshape;                          // gradients of both shapes [4][kHead]
};

void forward(const Head& h, const Shape& of_q, const Shape& of_k, int64_t n, int64_t frame) {
  thread_local Side keys, values;
  thread_local std::vector<float> scores;
  const int64_t ld = padded(n);
  keys.take(h.k, of_k, n, ld);
  values.take(h.v, {}, n, ld);
  scores.resize(kTile * ld);
  if (h.shaped_k) std::copy_n(keys.rows.data(), n * kHead, h.shaped_k);
  float tile[kTile * kHead], result[kTile * kHead], sums[kTile], log_sums[kTile];
  tiles(n, frame, [&](int64_t begin, int count, int64_t seen) {
    take_tile(h.q, of_q, begin, count, kScale, tile);
    for (int i = 0; h.shaped_q && i < count; ++i)
      store_row(h.shaped_q + (begin + i) * kHead, 1 / kScale * load_row(tile + i * kHead));
    products(tile, keys.transposed.data(), ld, seen, scores.data());
    exponentials(scores.data(), ld, seen, sums, log_sums);
    std::copy_n(log_sums, count, h.log_sums + begin);
    gather(scores.data(), ld, values.rows.data(), seen, result);
    for (int i = 0; i < count; ++i)
      store_row(h.out[begin + i], 1 / sums[i] * load_row(result + i * kHead));
  });
}

void backward(const Head& h, const Shape& of_q, const Shape& of_k, int64_t n, int64_t frame) {
  thread_local Side keys, values;
  thread_local std::vector<float> weights, slopes, dkeys, dvalues;
  const int64_t ld = padded(n);
  keys.take(h.k, of_k, n, ld);
  values.take(h.v, {}, n, ld);
  weights.resize(kTile * ld);
  slopes.resize(kTile * ld);
  dkeys.assign(ld * kHead, 0);
  dvalues.assign(ld * kHead, 0);
  if (h.dshaped_k) std::copy_n(h.dshaped_k, n * kHead, dkeys.data());
  std::fill_n(h.dshape, 4 * kHead, 0.f);
  float queries[kTile * kHead], given[kTile * kHead], result[kTile * kHead];
  tiles(n, frame, [&](int64_t begin, int count, int64_t seen) {
    take_tile(h.q, of_q, begin, count, kScale, queries);
    take_tile(h.dout, {}, begin, count, 1, given);
    products(queries, keys.transposed.data(), ld, seen, weights.data());
    products(given, values.transposed.data(), ld, seen, slopes.data());
    for (int i = 0; i < kTile; ++i) {
      float *p = weights.data() + i * ld, *s = slopes.data() + i * ld;
      const float log_sum = i < count ? h.log_sums[begin + i] : 0;
      const float along =
          i < count ? kHead * mean(load_row(h.out[begin + i]) * load_row(given + i * kHead)) : 0;
      std::fill(p + seen, p + padded(seen), -INFINITY);
      for (int64_t j = 0; j < padded(seen); j += kLane) {
        const Lanes e = exponential(load(p + j) - log_sum);
        store(p + j, e);
        store(s + j, e * (load(s + j) - along));
      }
    }
    gather(slopes.data(), ld, keys.rows.data(), seen, result);
    for (int i = 0; i < count; ++i) {
      const int64_t token = begin + i;
      Row dq = kScale * load_row(result + i * kHead);
      if (h.dshaped_q) dq = dq + load_row(h.dshaped_q + token * kHead);
      store_row(h.dq[token], shaped_gradient(load_row(h.q[token]), dq, of_q, token, h.dshape));
    }
    scatter(weights.data(), ld, given, seen, dvalues.data());
    scatter(slopes.data(), ld, queries, seen, dkeys.data());
  });
  for (int64_t i = 0; i < n; ++i) {
    store_row(h.dk[i], shaped_gradient(load_row(h.k[i]), load_row(&dkeys[i * kHead]), of_k, i,
                                       h.dshape + 2 * kHead));
    store_row(h.dv[i], load_row(&dvalues[i * kHead]));
  }
}

}  // namespace

// What attention.py hands over. Values of all heads lie together: qkv [clips, tokens, 3, heads,
// kHead] and its gradient, out [clips, tokens, heads, kHead] and its gradient. shaped_q, shaped_k
// and their gradients: of each clip's first `shaped` heads, [clips, shaped, tokens, kHead], null
// for none. log_sums [clips, heads, tokens]: of the exponentials of each query's scores. dshape:
// [clips, heads, 4, kHead]. frame: tokens of a frame, which see those of their own and of earlier
// frames; it divides `tokens`.
struct Call {
  float *qkv, *out, *log_sums, *shaped_q, *shaped_k, *dout, *dqkv, *dshape;
  const float *dshaped_q, *dshaped_k;
  Shape of_q, of_k;
  int64_t clips, heads, tokens, frame, shaped, threads;
};

template <class Use>
void for_heads(const Call& c, Use use) {
#pragma omp parallel for num_threads(c.threads) schedule(dynamic)
  for (int64_t i = 0; i < c.clips * c.heads; ++i) {
    const int64_t clip = i / c.heads, head = i % c.heads, C = c.heads * kHead;
    const auto rows = [&](float* p, int64_t parts, int64_t part) {
      return Rows{p + (clip * c.tokens * parts + part) * C + head * kHead, parts * C};
    };
    const auto kept = [&](auto* p) {
      return p && head < c.shaped ? p + (clip * c.shaped + head) * c.tokens * kHead : nullptr;
    };
    use(Head{.q = rows(c.qkv, 3, 0),
             .k = rows(c.qkv, 3, 1),
             .v = rows(c.qkv, 3, 2),
             .out = rows(c.out, 1, 0),
             .dout = rows(c.dout, 1, 0),
             .dq = rows(c.dqkv, 3, 0),
             .dk = rows(c.dqkv, 3, 1),
             .dv = rows(c.dqkv, 3, 2),
             .log_sums = c.log_sums + i * c.tokens,
             .shaped_q = kept(c.shaped_q),
             .shaped_k = kept(c.shaped_k),
             .dshaped_q = kept(c.dshaped_q),
             .dshaped_k = kept(c.dshaped_k),
             .dshape = c.dshape + i * 4 * kHead});
  }
}

extern "C" void small_model_attention(const Call* c) {
  for_heads(*c, [&](const Head& h) { forward(h, c->of_q, c->of_k, c->tokens, c->frame); });
}

extern "C" void small_model_attention_gradients(const Call* c) {
  for_heads(*c, [&](const Head& h) { backward(h, c->of_q, c->of_k, c->tokens, c->frame); });
}
