// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/clip.h"

#include <algorithm>
#include <cmath>
#include <functional>

#include "lvggt/kernels/causal_attention.h"
#include "lvggt/kernels/elementwise.h"

namespace lvggt {
namespace {

// Rows of the residual stream computed together: enough to keep every product's weights busy, and
// little memory (the widest buffer holds 4 C floats a row).
constexpr std::int64_t kBatchRows = 2048;

// Who looks, and which tower it is: names become "text.block" and the like.
struct Watch {
  Observer* observer = nullptr;
  std::string tower;

  explicit operator bool() const { return observer != nullptr; }
  void see(const char* name, std::size_t idx, View<const float, 2> rows) const {
    if (observer != nullptr)
      observer->observe(tower + "." + name, static_cast<std::int64_t>(idx), rows);
  }
};

// x += c_proj(gelu(c_fc(ln_2(x)))), through `normed`, of x's shape.
void mlp_half(View<float, 2> x, View<float, 2> normed, const ClipBlock& block,
              View<const float, 1> quick_gelu, std::size_t idx, const Watch& watch, Context& ctx) {
  Arena::Scope scope(ctx.arena());
  layer_norm_forward(normed, x, block.ln_2, ctx);
  const View<float, 2> hidden = ctx.arena().alloc(Shape{x.extent(0), block.mlp.fc1.weight.N});
  if (watch && !quick_gelu) {
    linear_forward(hidden, normed, block.mlp.fc1, {}, ctx);
    watch.see("fc", idx, hidden);
  }
  const Activation activation = quick_gelu ? Activation::kSilu : Activation::kGelu;
  linear_forward(hidden, normed, block.mlp.fc1, {.activation = activation, .gamma = quick_gelu},
                 ctx);
  watch.see("act", idx, hidden);
  linear_forward(x, hidden, block.mlp.fc2, {.residual = x}, ctx);
}

// All blocks in place.   x: [N, C]
void transformer_forward(View<float, 2> x, const ClipTransformer& transformer, Attend attend,
                         const Watch& watch, Context& ctx) {
  const View<const float, 1> quick_gelu = view_or_empty(transformer.quick_gelu);
  for (std::size_t i = 0; i < transformer.resblocks.size(); ++i) {
    const ClipBlock& block = transformer.resblocks[i];
    Arena::Scope scope(ctx.arena());
    const View<float, 2> normed = ctx.arena().alloc(x.shape());
    layer_norm_forward(normed, x, block.ln_1, ctx);
    if (watch) {
      const View<float, 2> branch = ctx.arena().alloc(x.shape());
      self_attention_forward(branch, normed, block.attn, {}, {}, nullptr, attend, nullptr, 0, ctx);
      watch.see("attn", i, branch);
      add(x, x, branch, ctx);
    } else {
      self_attention_forward(x, normed, block.attn, {}, x, nullptr, attend, nullptr, 0, ctx);
    }
    mlp_half(x, normed, block, quick_gelu, i, watch, ctx);
    watch.see("block", i, x);
  }
}

// Row of the first largest id.
std::int64_t end_position(View<const std::int64_t, 1> ids) {
  const std::int64_t* first = ids.data();
  return std::max_element(first, first + ids.extent(0)) - first;
}

// The rows that count, normalised and projected.   embeddings: [n, width]   rows: [n, C]
void project(View<float, 2> embeddings, View<float, 2> rows, const LayerNorm& norm,
             const Linear& projection, const Watch& watch, Context& ctx) {
  layer_norm_forward(rows, rows, norm, ctx);
  linear_forward(embeddings, rows, projection, {}, ctx);
  watch.see("projected", 0, embeddings);
  normalize_rows(embeddings);
}

void check_tokens(View<const std::int64_t, 2> tokens, const ClipText& clip) {
  LVGGT_CHECK(tokens.extent(1) >= 1 && tokens.extent(1) <= clip.context_length(),
              "clip_text: tokens are ", tokens.shape(), " but the context length is ",
              clip.context_length());
  for (std::int64_t n = 0; n < tokens.extent(0); ++n)
    for (const std::int64_t id :
         std::span(tokens[n].data(), static_cast<std::size_t>(tokens.extent(1))))
      LVGGT_CHECK(id >= 0 && id < clip.vocabulary_size(), "clip_text: token ", id,
                  " is not below the ", clip.vocabulary_size(), " rows of token_embedding");
}

// One batch of phrases, each cut to P tokens.
void text_batch(View<float, 2> embeddings, View<const std::int64_t, 2> tokens, std::int64_t P,
                const ClipText& clip, const Watch& watch, Context& ctx) {
  const std::int64_t n = tokens.extent(0), C = clip.token_embedding.extent(1);
  Arena::Scope scope(ctx.arena());
  const View<float, 2> x = ctx.arena().alloc(Shape{n * P, C});
  for (std::int64_t i = 0; i < n * P; ++i) {
    const float* token = clip.token_embedding[tokens(i / P, i % P)].data();
    const float* position = clip.positional_embedding[i % P].data();
    for (std::int64_t c = 0; c < C; ++c) x(i, c) = token[c] + position[c];
  }
  watch.see("embed", 0, x);
  const auto attend = [&](View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                          View<const float, 3> v) {
    causal_attention(y, q, k, v, P, 1.0f / std::sqrt(static_cast<float>(q.extent(2))), ctx);
  };
  transformer_forward(x, clip.transformer, attend, watch, ctx);
  if (watch) {
    const View<float, 2> normed = ctx.arena().alloc(x.shape());
    layer_norm_forward(normed, x, clip.ln_final, ctx);
    watch.see("ln_final", 0, normed);
  }
  const View<float, 2> ends = ctx.arena().alloc(Shape{n, C});
  for (std::int64_t i = 0; i < n; ++i)
    std::copy_n(x[i * P + end_position(tokens[i])].data(), C, ends[i].data());
  project(embeddings, ends, clip.ln_final, clip.text_projection, watch, ctx);
}

// One batch of pictures.
void image_batch(View<float, 2> embeddings, View<const float, 4> pixels, const ClipImage& clip,
                 const Watch& watch, Context& ctx) {
  const std::int64_t n = pixels.extent(0), C = clip.class_embedding.extent(0);
  const Shape<3> grid = conv2d_shape(clip.conv1, pixels.extent(1), pixels.extent(2));
  const std::int64_t patches = grid[0] * grid[1], P = 1 + patches;
  Arena::Scope scope(ctx.arena());
  const View<float, 2> x = ctx.arena().alloc(Shape{n * P, C});
  for (std::int64_t i = 0; i < n; ++i) {
    const View<float, 2> tokens = x.narrow(0, i * P + 1, (i + 1) * P);
    conv2d_forward(View<float, 3>(tokens.data(), grid), pixels[i], clip.conv1, {}, ctx);
    watch.see("conv1", static_cast<std::size_t>(i), tokens);
    std::copy_n(clip.class_embedding.data(), C, x[i * P].data());
    const View<float, 2> all = x.narrow(0, i * P, (i + 1) * P);
    add(all, all, clip.positional_embedding, ctx);
  }
  layer_norm_forward(x, x, clip.ln_pre, ctx);
  watch.see("ln_pre", 0, x);
  const auto attend = [&](View<float, 3> y, View<const float, 3> q, View<const float, 3> k,
                          View<const float, 3> v) { attend_within_groups(y, q, k, v, P, ctx); };
  transformer_forward(x, clip.transformer, attend, watch, ctx);
  if (watch) {
    const View<float, 2> normed = ctx.arena().alloc(x.shape());
    layer_norm_forward(normed, x, clip.ln_post, ctx);
    watch.see("ln_post", 0, normed);
  }
  const View<float, 2> classes = ctx.arena().alloc(Shape{n, C});
  for (std::int64_t i = 0; i < n; ++i) std::copy_n(x[i * P].data(), C, classes[i].data());
  project(embeddings, classes, clip.ln_post, clip.proj, watch, ctx);
}

// Calls body(begin, end) for batches of at most kBatchRows tokens, or for all at once when somebody
// watches, who expects every value in one piece.
void for_each_batch(std::int64_t n, std::int64_t tokens, bool watched,
                    FunctionRef<void(std::int64_t, std::int64_t)> body) {
  const std::int64_t batch =
      watched ? std::max<std::int64_t>(n, 1) : std::max<std::int64_t>(1, kBatchRows / tokens);
  for (std::int64_t begin = 0; begin < n; begin += batch) body(begin, std::min(n, begin + batch));
}

}  // namespace

void clip_text_forward(View<float, 2> embeddings, View<const std::int64_t, 2> tokens,
                       const ClipText& clip, Observer* observer, Context& ctx) {
  LVGGT_CHECK(embeddings.shape() == (Shape{tokens.extent(0), clip.width()}),
              "clip_text: embeddings are ", embeddings.shape(), " but there are ", tokens.extent(0),
              " phrases and the width is ", clip.width());
  check_tokens(tokens, clip);
  for_each_batch(
      tokens.extent(0), tokens.extent(1), observer != nullptr,
      [&](std::int64_t begin, std::int64_t end) {
        const auto rows = tokens.narrow(0, begin, end);
        std::int64_t P = 0;
        for (std::int64_t i = 0; i < end - begin; ++i) P = std::max(P, end_position(rows[i]) + 1);
        if (observer != nullptr) P = tokens.extent(1);
        text_batch(embeddings.narrow(0, begin, end), rows, P, clip, {observer, "text"}, ctx);
      });
}

void clip_image_forward(View<float, 2> embeddings, View<const float, 4> pixels,
                        const ClipImage& clip, Observer* observer, Context& ctx) {
  const std::int64_t n = pixels.extent(0), S = clip.image_size;
  LVGGT_CHECK(pixels.shape() == (Shape{n, S, S, std::int64_t{3}}), "clip_image: pixels are ",
              pixels.shape(), ", expected ", Shape{n, S, S, std::int64_t{3}});
  LVGGT_CHECK(embeddings.shape() == (Shape{n, clip.width()}), "clip_image: embeddings are ",
              embeddings.shape(), ", expected ", Shape{n, clip.width()});
  for_each_batch(n, clip.positional_embedding.extent(0), observer != nullptr,
                 [&](std::int64_t begin, std::int64_t end) {
                   image_batch(embeddings.narrow(0, begin, end), pixels.narrow(0, begin, end), clip,
                               {observer, "visual"}, ctx);
                 });
}

void normalize_rows(View<float, 2> rows) {
  for (std::int64_t n = 0; n < rows.extent(0); ++n) {
    float* row = rows[n].data();
    double squares = 0;
    for (std::int64_t c = 0; c < rows.extent(1); ++c) squares += double{row[c]} * row[c];
    if (squares == 0) continue;
    const double inverse = 1 / std::sqrt(squares);
    for (std::int64_t c = 0; c < rows.extent(1); ++c) row[c] = static_cast<float>(row[c] * inverse);
  }
}

}  // namespace lvggt
