// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>

#include "lvggt/language/bpe_tokenizer.h"
#include "lvggt/language/clip.h"
#include "lvggt/language/embeddings.h"
#include "lvggt/language/mistral.h"
#include "lvggt/language/sentence_piece.h"
#include "lvggt/language/text_encoder.h"

namespace lvggt {

// What is written in front of a sentence that looks for others: the published prompt of the
// retrieval that time-sensitive queries are. Captions, which are found, have none.
inline constexpr const char* kSentenceQueryPrompt =
    "Instruct: Given a news summary, retrieve other semantically similar summaries\nQuery: ";

struct TextEncoderOptions {
  std::string vocabulary{};  // of the tokeniser: a folder or file; empty: beside the weights
  std::string config{};      // JSON; empty: beside the weights
  // In front of every sentence; Mistral only.
  std::string prompt = kSentenceQueryPrompt;
};

// The encoder that `path` holds, told apart by content: a .npy of precomputed vectors with its list
// of phrases beside it (options.vocabulary may name the list), CLIP's weights, or Mistral's; a file
// or a folder. Needs lvggt::text. Errors: those of the parts; kMismatch when a tokeniser's
// vocabulary is not that of the token embedding, or the file is none of these.
std::unique_ptr<TextEncoder> load_text_encoder(const std::string& path,
                                               const TextEncoderOptions& options = {});

// The safetensors of a published folder: the one named as OpenCLIP or Hugging Face name it, where a
// folder holds several.
std::string weights_in(const std::string& path);

// CLIP's text tower with its tokeniser.
class ClipTextEncoder : public TextEncoder {
 public:
  ClipTextEncoder(ClipText clip, BpeTokenizer tokenizer, std::string source);

  std::int64_t width() const override { return clip_.width(); }
  Tensor<float, 2> encode(std::span<const std::string> phrases, Context& ctx) const override;
  std::vector<std::string> warnings(std::span<const std::string> phrases) const override;
  std::string describe() const override;

 private:
  ClipText clip_;
  BpeTokenizer tokenizer_;
  std::string source_;
};

// Mistral with its tokeniser.
class MistralTextEncoder : public TextEncoder {
 public:
  MistralTextEncoder(Mistral model, SentencePieceTokenizer tokenizer, std::string prompt,
                     std::string source);

  std::int64_t width() const override { return model_.width(); }
  Tensor<float, 2> encode(std::span<const std::string> phrases, Context& ctx) const override;
  std::vector<std::string> warnings(std::span<const std::string> phrases) const override;
  std::string describe() const override;

 private:
  Mistral model_;
  SentencePieceTokenizer tokenizer_;
  std::string prompt_, source_;
};

}  // namespace lvggt
