// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/mistral.h"

#include <algorithm>
#include <cmath>

#include "lvggt/core/context.h"
#include "lvggt/kernels/causal_attention.h"
#include "lvggt/kernels/elementwise.h"
#include "lvggt/kernels/rms_norm.h"
#include "lvggt/kernels/rope_1d.h"
#include "lvggt/kernels/swiglu.h"
#include "lvggt/language/clip.h"

namespace lvggt {
namespace {

void see(Observer* observer, const char* name, std::size_t idx, View<const float, 2> rows) {
  if (observer != nullptr) observer->observe(name, static_cast<std::int64_t>(idx), rows);
}

// [N, heads * D] as [N, heads, D]
View<float, 3> as_heads(View<float, 2> rows, std::int64_t D) {
  return View<float, 3>(rows.data(), Shape{rows.extent(0), rows.extent(1) / D, D},
                        {rows.stride(0), D, 1});
}

// Rotates q and k and attends, sequence by sequence; q becomes the result.
void attend_sequences(View<float, 3> q, View<float, 3> k, View<const float, 3> v,
                      std::span<const std::int64_t> lengths, double theta, Context& ctx) {
  const std::int64_t D = q.extent(2);
  const std::int64_t longest = *std::max_element(lengths.begin(), lengths.end());
  const Rope1dTable table = make_rope_1d_table(longest, D, theta);
  const float scale = 1.0f / std::sqrt(static_cast<float>(D));
  std::int64_t begin = 0;
  for (const std::int64_t length : lengths) {
    const std::int64_t end = begin + length;
    const View<float, 3> own_q = q.narrow(0, begin, end), own_k = k.narrow(0, begin, end);
    rope_1d_forward(own_q, own_q, table, ctx);
    rope_1d_forward(own_k, own_k, table, ctx);
    causal_attention(own_q, own_q, own_k, v.narrow(0, begin, end), length, scale, ctx);
    begin = end;
  }
}

}  // namespace

void Mistral::run_layer(View<float, 2> x, std::span<const std::int64_t> lengths, std::size_t idx,
                        Observer* observer, Context& ctx) const {
  const MistralLayer& layer = layers_[idx];
  const std::int64_t N = x.extent(0), D = config_.head_dim;
  Arena::Scope scope(ctx.arena());
  const View<float, 2> normed = ctx.arena().alloc(Shape{N, C_});
  rms_norm_forward(normed, x, layer.input_layernorm, config_.rms_norm_eps, ctx);
  see(observer, "input_layernorm", idx, normed);

  const View<float, 2> q = ctx.arena().alloc(Shape{N, heads_ * D});
  const View<float, 2> k = ctx.arena().alloc(Shape{N, key_heads_ * D});
  const View<float, 2> v = ctx.arena().alloc(Shape{N, key_heads_ * D});
  stored_linear_forward(q, normed, layer.q_proj, {}, ctx);
  stored_linear_forward(k, normed, layer.k_proj, {}, ctx);
  stored_linear_forward(v, normed, layer.v_proj, {}, ctx);
  attend_sequences(as_heads(q, D), as_heads(k, D), as_heads(v, D), lengths, config_.rope_theta,
                   ctx);
  const View<float, 2> branch = ctx.arena().alloc(Shape{N, C_});
  stored_linear_forward(branch, q, layer.o_proj, {}, ctx);
  see(observer, "attn", idx, branch);
  add(x, x, branch, ctx);

  rms_norm_forward(normed, x, layer.post_attention_layernorm, config_.rms_norm_eps, ctx);
  const View<float, 2> gate = ctx.arena().alloc(Shape{N, hidden_});
  const View<float, 2> up = ctx.arena().alloc(Shape{N, hidden_});
  stored_linear_forward(gate, normed, layer.gate_proj, {}, ctx);
  stored_linear_forward(up, normed, layer.up_proj, {}, ctx);
  swiglu_forward(gate, gate, up, ctx);
  stored_linear_forward(branch, gate, layer.down_proj, {}, ctx);
  see(observer, "mlp", idx, branch);
  add(x, x, branch, ctx);
  see(observer, "layer", idx, x);
}

void Mistral::forward(View<float, 2> embeddings,
                      std::span<const std::vector<std::int64_t>> sequences, Observer* observer,
                      Context& ctx) const {
  const auto n = static_cast<std::int64_t>(sequences.size());
  LVGGT_CHECK(embeddings.shape() == (Shape{n, C_}), "mistral: embeddings are ", embeddings.shape(),
              ", expected ", Shape{n, C_});
  if (n == 0) return;
  std::vector<std::int64_t> lengths;
  std::int64_t N = 0;
  for (const auto& ids : sequences) {
    LVGGT_CHECK(!ids.empty(), "mistral: a sequence has no tokens");
    lengths.push_back(static_cast<std::int64_t>(ids.size()));
    N += lengths.back();
  }
  Arena::Scope scope(ctx.arena());
  const View<float, 2> x = ctx.arena().alloc(Shape{N, C_});
  std::int64_t row = 0;
  for (const auto& ids : sequences) {
    for (const std::int64_t id : ids) {
      LVGGT_CHECK(id >= 0 && id < vocabulary_size(), "mistral: token ", id, " is not below the ",
                  vocabulary_size(), " rows of embed_tokens");
      stored_row(x[row++], embed_tokens_, id);
    }
  }
  see(observer, "embed", 0, x);
  for (std::size_t i = 0; i < layers_.size(); ++i) run_layer(x, lengths, i, observer, ctx);
  rms_norm_forward(x, x, norm_, config_.rms_norm_eps, ctx);
  see(observer, "norm", 0, x);
  row = 0;
  for (std::int64_t i = 0; i < n; ++i) {
    row += lengths[static_cast<std::size_t>(i)];
    std::copy_n(x[row - 1].data(), C_, embeddings[i].data());
    if (find_nonfinite(embeddings[i]) >= 0)
      fail(ErrorKind::kNumeric, path_, ": sequence ", i,
           " gives NaN or infinity: the weights are damaged");
  }
  see(observer, "pooled", 0, embeddings);
  normalize_rows(embeddings);
}

}  // namespace lvggt
