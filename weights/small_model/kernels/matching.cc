// SPDX-License-Identifier: Apache-2.0
// How well two heads of a global block attend to where patches were, and the gradients of that;
// matching.py calls it.
#include "tiles.h"

using namespace small_model;

namespace {

struct Head {            // the first or the second of one clip
  Rows q, k, dq, dk;     // [tokens, kHead]
  const float* wanted;   // [later frames, 2, patches, patches]
  const uint8_t* moved;  // [later frames, 2, patches]
  int which;
};

struct Found {
  double loss = 0;
  int64_t right = 0;
};

// The sum of wanted (log of all attention - score); dq and dk get its gradient. Of the `moved`
// patches, how many look most at a wanted place.
Found look(const Head& h, int64_t frames, int64_t frame, int64_t special) {
  thread_local Side keys;
  thread_local std::vector<float> scores, dkeys;
  const int64_t n = frames * frame, ld = padded(n), patches = frame - special;
  keys.take(h.k, {}, n, ld);
  scores.resize(kTile * ld);
  dkeys.assign(ld * kHead, 0);
  for (int64_t i = 0; i < n; ++i) std::fill_n(h.dq[i], kHead, 0.f);
  float queries[kTile * kHead], result[kTile * kHead], sums[kTile], log_sums[kTile];
  Found found;
  for (int64_t s = 1; s < frames; ++s)
    for (int64_t first = 0; first < patches; first += kTile) {
      const int count = static_cast<int>(std::min<int64_t>(kTile, patches - first));
      const int64_t begin = s * frame + special + first, seen = (s + 1) * frame;
      const int64_t at = (h.which == 0 ? 0 : s - 1) * frame + special,
                    row = ((s - 1) * 2 + h.which) * patches + first;
      take_tile(h.q, {}, begin, count, kScale, queries);
      products(queries, keys.transposed.data(), ld, seen, scores.data());
      float mass[kTile] = {};
      for (int i = 0; i < count; ++i) {
        const float *there = scores.data() + i * ld + at, *wanted = h.wanted + (row + i) * patches;
        double hit = 0;
        for (int64_t c = 0; c < patches; ++c) {
          mass[i] += wanted[c];
          hit += wanted[c] * there[c];
        }
        found.loss -= hit;
        found.right +=
            h.moved[row + i] && wanted[std::max_element(there, there + patches) - there] > 0;
      }
      exponentials(scores.data(), ld, seen, sums, log_sums);
      for (int i = 0; i < kTile; ++i) {
        float* slopes = scores.data() + i * ld;
        found.loss += mass[i] * log_sums[i];
        for (int64_t j = 0; j < padded(seen); ++j) slopes[j] *= mass[i] / sums[i];
        for (int64_t c = 0; i < count && c < patches; ++c)
          slopes[at + c] -= h.wanted[(row + i) * patches + c];
      }
      gather(scores.data(), ld, keys.rows.data(), seen, result);
      for (int i = 0; i < count; ++i)
        store_row(h.dq[begin + i], kScale * load_row(result + i * kHead));
      scatter(scores.data(), ld, queries, seen, dkeys.data());
    }
  for (int64_t i = 0; i < n; ++i) store_row(h.dk[i], load_row(&dkeys[i * kHead]));
  return found;
}

}  // namespace

// q, k and their gradients [clips, 2, frames * frame, kHead]; wanted [clips, frames - 1, 2,
// patches, patches]; moved [clips, frames - 1, 2, patches]; frame: its tokens, patches after
// `special` others. found: the loss and how many are right.
extern "C" void small_model_matching(float* q, float* k, float* dq, float* dk, const float* wanted,
                                     const uint8_t* moved, int64_t clips, int64_t frames,
                                     int64_t frame, int64_t special, int64_t threads,
                                     double* found) {
  double loss = 0;
  int64_t right = 0;
#pragma omp parallel for num_threads(threads) schedule(dynamic) reduction(+ : loss, right)
  for (int64_t i = 0; i < 2 * clips; ++i) {
    const int64_t patches = frame - special, clip = i / 2,
                  later = clip * (frames - 1) * 2 * patches;
    const auto rows = [&](float* p) { return Rows{p + i * frames * frame * kHead, kHead}; };
    const Head h{rows(q),
                 rows(k),
                 rows(dq),
                 rows(dk),
                 wanted + later * patches,
                 moved + later,
                 static_cast<int>(i % 2)};
    const Found f = look(h, frames, frame, special);
    loss += f.loss;
    right += f.right;
  }
  found[0] = loss;
  found[1] = static_cast<double>(right);
}
