// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>

#include "lvggt/kernels/linear.h"
#include "lvggt/kernels/softmax.h"
#include "lvggt/model/aggregator.h"

namespace lvggt {

// Attention and its gradients, for fine-tuning or probing blocks of the geometry encoder with a
// training loop of one's own. lvggt's programs keep the encoder as it was published: they train the
// Semantic Bridging Decoder on its tokens.

// Which keys a query sees. Tokens come in frames of `frame_tokens`, and a token sees its own frame
// and, with earlier_frames, all before it. 0: every query sees every key.
struct FrameMask {
  std::int64_t frame_tokens = 0;
  bool earlier_frames = false;
};

// One head of all tokens, [N, D].
template <class T>
View<T, 2> head_rows(View<T, 3> x, std::int64_t head) {
  return View<T, 2>(x.data() + head * x.stride(1), Shape{x.extent(0), x.extent(2)},
                    {x.stride(0), 1});
}

inline void check_frame_mask(const char* op, const FrameMask& mask, const Shape<3>& q,
                             const Shape<3>& k) {
  LVGGT_CHECK(q[1] == k[1] && q[2] == k[2], op, ": q is ", q, " but k is ", k);
  const std::int64_t P = mask.frame_tokens;
  LVGGT_CHECK(P == 0 || (P > 0 && q[0] == k[0] && q[0] % P == 0), op, ": q ", q, " and k ", k,
              " are not the same whole frames of ", P, " tokens");
}

// y = softmax(q k^T / sqrt(D)) v, head by head, over the keys that a query sees.
//   y, q: [Nq, heads, D]   k, v: [Nk, heads, D]; Nq = Nk with a mask   y may be q.
inline void attention_forward(View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                              View<const float, 3> v, const FrameMask& mask, Context& ctx) {
  check_frame_mask("attention", mask, q.shape(), k.shape());
  const auto [Nk, heads, D] = k.shape();
  const std::int64_t P = mask.frame_tokens;
  if (P > 0 && mask.earlier_frames)
    return attend_across_frames(y, q, k, v, Nk / P, BatchMode::kCausal, ctx);
  if (P > 0) return attend_within_groups(y, q, k, v, P, ctx);
  Arena::Scope scope(ctx.arena());
  const PackedKeysValues all = alloc_keys_values(heads, Nk, D, ctx);
  pack_keys_values(all, k, v, ctx);
  scaled_dot_product_attention(y, q, std::span(&all, 1), ctx);
}

// Queries of one head whose weights exist at a time. Two blocks of Nq x Nk weights are all the
// memory beside the operands, 2 KiB a key; with fewer queries, packing the keys for a product would
// cost more than a tenth of it.
inline constexpr std::int64_t kQueriesPerBlock = 256;

// The gradients of one block of queries of one head, against the keys it sees: dq is written, dk
// and dv are added to. An empty one is not wanted.
//   dq, dy, q: [Nq, D]   dk, dv, k, v: [Nk, D]
//
// Derivation, with s = q k^T, p = softmax(scale s) and y = p v:
//   dp = dy v^T               dv += p^T dy
//   ds = softmax'(dp)         which is scale p (dp - sum(p dp)) row by row
//   dq = ds k                 dk += ds^T q
// Keys that a query does not see have p = 0 and so no part in any sum: they are left out. s and p
// are computed again rather than kept.
inline void attention_backward(View<float, 2> dq, View<float, 2> dk, View<float, 2> dv,
                               View<const float, 2> dy, View<const float, 2> q,
                               View<const float, 2> k, View<const float, 2> v, float scale,
                               Context& ctx) {
  Arena::Scope scope(ctx.arena());
  const View<float, 2> p = ctx.arena().alloc(Shape{q.extent(0), k.extent(0)});
  const View<float, 2> ds = ctx.arena().alloc(p.shape());
  linear_forward(p, q, k, {}, ctx);
  softmax_forward(p, p, scale, ctx);
  linear_forward(ds, dy, v, {}, ctx);
  softmax_backward(ds, ds, p, scale, ctx);
  if (dv) linear_backward({}, dv, {}, p, dy, v, ctx);
  linear_backward(dq, dk, {}, ds, q, k, ctx);
}

// Backward of attention_forward; an empty gradient is not wanted.
//   dq, dy, q: [Nq, heads, D]   dk, dv, k, v: [Nk, heads, D]
inline void attention_backward(View<float, 3> dq, View<float, 3> dk, View<float, 3> dv,
                               View<const float, 3> dy, View<const float, 3> q,
                               View<const float, 3> k, View<const float, 3> v,
                               const FrameMask& mask, Context& ctx) {
  check_frame_mask("attention_backward", mask, q.shape(), k.shape());
  LVGGT_CHECK(dy.shape() == q.shape() && v.shape() == k.shape(), "attention_backward: q is ",
              q.shape(), " and k ", k.shape(), " but dy is ", dy.shape(), " and v ", v.shape());
  LVGGT_CHECK((!dq || dq.shape() == q.shape()) && (!dk || dk.shape() == k.shape()) &&
                  (!dv || dv.shape() == v.shape()),
              "attention_backward: q is ", q.shape(), " and k ", k.shape(), " but dq is ",
              dq.shape(), ", dk ", dk.shape(), " and dv ", dv.shape());
  const auto [Nq, heads, D] = q.shape();
  const std::int64_t Nk = k.extent(0), P = mask.frame_tokens;
  for (const View<float, 3>& sum : {dk, dv}) {
    for (std::int64_t n = 0; sum && n < Nk; ++n)
      for (std::int64_t head = 0; head < heads; ++head) std::fill_n(sum[n][head].data(), D, 0.0f);
  }
  const float scale = 1.0f / std::sqrt(static_cast<float>(D));
  const auto part = [](auto x, std::int64_t head, std::int64_t begin, std::int64_t end) {
    return x ? head_rows(x.narrow(0, begin, end), head) : decltype(head_rows(x, head))();
  };
  // A block lies in one frame, so all of its queries see the same keys, which are neighbours.
  for (std::int64_t begin = 0, end = 0; begin < Nq; begin = end) {
    const std::int64_t frame_end = P == 0 ? Nq : (begin / P + 1) * P;
    const std::int64_t first_key = P == 0 || mask.earlier_frames ? 0 : begin / P * P;
    const std::int64_t keys_end = P == 0 ? Nk : frame_end;
    end = std::min(begin + kQueriesPerBlock, frame_end);
    for (std::int64_t head = 0; head < heads; ++head)
      attention_backward(part(dq, head, begin, end), part(dk, head, first_key, keys_end),
                         part(dv, head, first_key, keys_end), part(dy, head, begin, end),
                         part(q, head, begin, end), part(k, head, first_key, keys_end),
                         part(v, head, first_key, keys_end), scale, ctx);
  }
}

}  // namespace lvggt
