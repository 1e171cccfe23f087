// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <vector>

#include "lvggt/io/safetensors.h"
#include "lvggt/language/clip_config.h"
#include "lvggt/nn/mlp.h"
#include "lvggt/nn/observer.h"
#include "lvggt/nn/self_attention.h"

namespace lvggt {

// CLIP's two towers (OpenCLIP ViT): a picture and a phrase become vectors of one space. Names are
// OpenCLIP's.
struct ClipBlock {
  LayerNorm ln_1;      // [C]
  SelfAttention attn;  // in_proj, out_proj
  LayerNorm ln_2;      // [C]
  Mlp mlp;             // c_fc, c_proj; with QuickGELU c_fc holds 1.702 times the weights
};

struct ClipTransformer {
  std::vector<ClipBlock> resblocks;
  // QuickGELU is x sigmoid(1.702 x) = silu(1.702 x) / 1.702: the factor is in c_fc's weights, and
  // this, 1 / 1.702 for each hidden channel, in its epilogue. Empty with GELU (erf).
  Tensor<float, 1> quick_gelu;  // [hidden]
};

struct ClipText {
  Tensor<float, 2> token_embedding;       // [V, C]
  Tensor<float, 2> positional_embedding;  // [T, C]
  ClipTransformer transformer;
  LayerNorm ln_final;      // [C]
  Linear text_projection;  // [width, C]

  std::int64_t vocabulary_size() const { return token_embedding.extent(0); }
  std::int64_t context_length() const { return positional_embedding.extent(0); }
  std::int64_t width() const { return text_projection.weight.N; }
};

struct ClipImage {
  Conv2d conv1;                           // [C, 3, patch, patch], without bias
  Tensor<float, 1> class_embedding;       // [C]
  Tensor<float, 2> positional_embedding;  // [1 + side*side, C]
  LayerNorm ln_pre;                       // [C]
  ClipTransformer transformer;
  LayerNorm ln_post;  // [C]
  Linear proj;        // [width, C]

  std::int64_t image_size = 0;  // S = side * patch
  std::int64_t width() const { return proj.weight.N; }
};

// Mean and deviation of RGB in [0, 1] that every CLIP was trained with.
inline constexpr float kClipMean[3] = {0.48145466f, 0.4578275f, 0.40821073f};
inline constexpr float kClipStd[3] = {0.26862954f, 0.26130258f, 0.27577711f};

// Phrases as token ids to vectors of length 1. The state of the end token counts, which is the
// first of the largest id in its row; what follows it changes nothing and is not computed.
//   embeddings: [n, width]   tokens: [n, P], P at most the context length, ids below the vocabulary
// The observer sees "text.embed", "text.attn", "text.fc" (GELU only), "text.act" and "text.block"
// of every layer, "text.ln_final" and "text.projected"; then everything is computed for all tokens.
void clip_text_forward(View<float, 2> embeddings, View<const std::int64_t, 2> tokens,
                       const ClipText& clip, Observer* observer, Context& ctx);

// Pictures to vectors of length 1.
//   embeddings: [n, width]   pixels: [n, S, S, 3], (RGB in [0, 1] - mean) / deviation
// The observer sees "visual.conv1", "visual.ln_pre", the layers as above, "visual.ln_post" and
// "visual.projected".
void clip_image_forward(View<float, 2> embeddings, View<const float, 4> pixels,
                        const ClipImage& clip, Observer* observer, Context& ctx);

// Whether the file or folder holds CLIP's text or image tower, by the names of its tensors.
bool is_clip_text(const Safetensors& file);
bool is_clip_image(const Safetensors& file);

// One tower from published weights (safetensors, or converted from .pt, .pth, .bin by
// weights_convert), under OpenCLIP's or Hugging Face's names. Weights stay as narrow as the file
// has them. Errors: those of Safetensors; kMismatch naming all missing tensors, or one whose shape
// does not fit, with what was expected; kFormat for NaN or infinity.
ClipText load_clip_text(const Safetensors& file, const ClipConfig& config);
ClipImage load_clip_image(const Safetensors& file, const ClipConfig& config);

// Divides every row by its length; a row of zeros stays one.
void normalize_rows(View<float, 2> rows);

}  // namespace lvggt
