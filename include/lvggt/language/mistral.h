// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>
#include <string>
#include <vector>

#include "lvggt/io/json.h"
#include "lvggt/io/mapped_file.h"
#include "lvggt/io/safetensors.h"
#include "lvggt/kernels/stored_linear.h"
#include "lvggt/nn/observer.h"

namespace lvggt {

// What the shapes of Mistral's weights do not tell.
struct MistralConfig {
  std::int64_t head_dim = 128;
  float rms_norm_eps = 1e-5f;
  double rope_theta = 10000;
  std::string source;  // the file it was read from; empty: these values, which are the 7B model's
};

// From Hugging Face's config.json. Errors: kFormat, kMismatch for another model_type than mistral,
// kUnsupported for another activation than silu.
MistralConfig parse_mistral_config(const Json& json, const std::string& source);

struct MistralLayer {
  Tensor<float, 1> input_layernorm;           // [C]
  StoredMatrix q_proj;                        // [heads * D, C]
  StoredMatrix k_proj, v_proj;                // [key_heads * D, C]
  StoredMatrix o_proj;                        // [C, heads * D]
  Tensor<float, 1> post_attention_layernorm;  // [C]
  StoredMatrix gate_proj, up_proj;            // [hidden, C]
  StoredMatrix down_proj;                     // [C, hidden]
};

// The language model under e5-mistral-7b-instruct, without its output head. The matrices stay where
// they are, in mapped files, in the type the files have (bf16, f16 or f32), and are widened a few
// rows at a time; only norms are copied. 7B parameters in bf16 are 14 GB of file, which one pass
// over any number of sentences reads once.
class Mistral {
 public:
  // `path`: a folder with an index and its shards, or one .safetensors file; names with or without
  // "model." in front. `config`: a JSON file; empty: config.json beside the weights, or the values
  // of the 7B model. Errors: those of Safetensors and MappedFile; kMismatch naming all missing
  // tensors, or one whose shape does not fit.
  static Mistral open(const std::string& path, const std::string& config = "");
  static Mistral open(const Safetensors& file, const MistralConfig& config);

  std::int64_t width() const { return C_; }
  std::int64_t vocabulary_size() const { return embed_tokens_.N; }
  std::size_t num_layers() const { return layers_.size(); }
  std::int64_t num_bytes() const { return num_bytes_; }  // of the weights, in the files

  // The state of each sequence's last token after the last norm, of length 1. All sequences go
  // through a layer together.
  //   embeddings: [n, C]   sequences: n lists of at least one id below the vocabulary
  // The observer sees, with all sequences one below the other, "embed", of every layer
  // "input_layernorm", "attn", "mlp" and "layer", then "norm" and, before normalisation, "pooled".
  // Errors: kNumeric for a state that is not finite, which damaged weights give.
  void forward(View<float, 2> embeddings, std::span<const std::vector<std::int64_t>> sequences,
               Observer* observer, Context& ctx) const;

 private:
  friend class MistralLoader;
  Mistral() = default;
  void run_layer(View<float, 2> x, std::span<const std::int64_t> lengths, std::size_t idx,
                 Observer* observer, Context& ctx) const;

  MistralConfig config_;
  std::int64_t C_ = 0, heads_ = 0, key_heads_ = 0, hidden_ = 0, num_bytes_ = 0;
  std::string path_;
  std::vector<MappedFile> files_;
  std::vector<std::vector<std::byte>> realigned_;  // matrices at odd addresses, copied
  StoredMatrix embed_tokens_;                      // [V, C]
  std::vector<MistralLayer> layers_;
  Tensor<float, 1> norm_;  // [C]
};

// Whether the file or folder holds such a model, by the names of its tensors.
bool is_mistral(const Safetensors& file);

}  // namespace lvggt
