// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/load_text_encoder.h"

#include <algorithm>
#include <array>
#include <filesystem>
#include <utility>

#include "lvggt/language/text_cleaning.h"

namespace lvggt {
namespace {

namespace fs = std::filesystem;

// Longest sentence for Mistral, its attention window.
constexpr std::int64_t kMistralContext = 4096;
// Tokens of sentences that go through Mistral together: as many again would read its 14 GB once
// more, which they then take no longer to compute than to read.
constexpr std::size_t kMistralBatchTokens = 1024;

std::string folder_of(const std::string& path) {
  std::error_code ignored;
  if (fs::is_directory(path, ignored)) return path;
  const std::string parent = fs::path(path).parent_path().string();
  return parent.empty() ? "." : parent;
}

bool is_npy(const std::string& path) {
  std::error_code ignored;
  if (fs::is_directory(path, ignored)) return false;
  const InputFile file(path);
  std::array<char, 6> head{};
  if (file.size() < static_cast<std::int64_t>(head.size())) return false;
  file.read_at(0, head.data(), head.size());
  return std::string_view(head.data(), head.size()) == "\x93NUMPY";
}

// The sentence that says a phrase is cut.
std::string cut_warning(const std::string& phrase, std::int64_t full_length, std::int64_t context) {
  return concat("the phrase that begins ", json_quote(phrase.substr(0, 40)), " has ", full_length,
                " tokens; only the first ", context - 1, " of them count");
}

// A phrase may vanish when it is cleaned: control characters, or a reference to nothing.
void check_something_left(const std::string& phrase, std::size_t num_ids) {
  LVGGT_CHECK(num_ids > 2, "the phrase ", json_quote(phrase),
              " is empty once its white space and control characters are removed");
}

}  // namespace

std::string weights_in(const std::string& path) {
  std::error_code ignored;
  if (!fs::is_directory(path, ignored)) return path;
  for (const char* name : {"open_clip_model.safetensors", "open_clip_pytorch_model.safetensors",
                           "model.safetensors"}) {
    const fs::path candidate = fs::path(path) / name;
    if (fs::exists(candidate, ignored)) return candidate.string();
  }
  return path;
}

std::unique_ptr<TextEncoder> load_text_encoder(const std::string& path,
                                               const TextEncoderOptions& options) {
  if (is_npy(path))
    return std::make_unique<PrecomputedEmbeddings>(
        PrecomputedEmbeddings::open(path, options.vocabulary));
  const std::string weights = weights_in(path);
  const Safetensors file = Safetensors::open(weights);
  const std::string vocabulary =
      options.vocabulary.empty() ? folder_of(weights) : options.vocabulary;
  if (is_clip_text(file)) {
    const ClipConfig config = options.config.empty()
                                  ? find_clip_config(weights)
                                  : parse_clip_config(Json::read(options.config), options.config);
    std::string source = weights;
    for (const std::string& note : config.notes) source += " (" + note + ")";
    return std::make_unique<ClipTextEncoder>(load_clip_text(file, config),
                                             BpeTokenizer::open(vocabulary), std::move(source));
  }
  if (is_mistral(file))
    return std::make_unique<MistralTextEncoder>(Mistral::open(weights, options.config),
                                                SentencePieceTokenizer::open(vocabulary),
                                                options.prompt, weights);
  fail(ErrorKind::kMismatch, weights, ": is no text encoder: it has neither CLIP's text tower nor ",
       "Mistral's layers",
       file.entries().empty() ? "" : "; its first tensor is " + file.entries().front().name);
}

ClipTextEncoder::ClipTextEncoder(ClipText clip, BpeTokenizer tokenizer, std::string source)
    : clip_(std::move(clip)), tokenizer_(std::move(tokenizer)), source_(std::move(source)) {
  LVGGT_CHECK(tokenizer_.vocabulary_size() == clip_.vocabulary_size(), tokenizer_.path(),
              ": the vocabulary has ", tokenizer_.vocabulary_size(),
              " tokens, but token_embedding of ", source_, " has ", clip_.vocabulary_size(),
              " rows");
}

Tensor<float, 2> ClipTextEncoder::encode(std::span<const std::string> phrases, Context& ctx) const {
  const auto n = static_cast<std::int64_t>(phrases.size());
  Tensor<std::int64_t, 2> tokens(Shape{n, clip_.context_length()});
  for (std::int64_t i = 0; i < n; ++i) {
    const std::string& phrase = phrases[static_cast<std::size_t>(i)];
    check_phrase(phrase);
    const auto ids = tokenizer_.encode(phrase, clip_.context_length()).ids;
    check_something_left(phrase, ids.size());
    std::copy(ids.begin(), ids.end(), tokens[i].data());
  }
  Tensor<float, 2> embeddings(Shape{n, width()});
  clip_text_forward(embeddings, tokens, clip_, nullptr, ctx);
  return embeddings;
}

std::vector<std::string> ClipTextEncoder::warnings(std::span<const std::string> phrases) const {
  std::vector<std::string> result;
  for (const std::string& phrase : phrases) {
    const auto encoded = tokenizer_.encode(phrase, clip_.context_length());
    if (encoded.full_length > clip_.context_length())
      result.push_back(cut_warning(phrase, encoded.full_length, clip_.context_length()));
  }
  return result;
}

std::string ClipTextEncoder::describe() const {
  const auto& blocks = clip_.transformer.resblocks;
  return concat("CLIP's text tower, ", blocks.size(), " layers of width ",
                clip_.token_embedding.extent(1), " with ",
                blocks.empty() ? 0 : blocks.front().attn.num_heads, " heads, ",
                clip_.transformer.quick_gelu.empty() ? "GELU" : "QuickGELU", ", to width ", width(),
                ", from ", source_);
}

MistralTextEncoder::MistralTextEncoder(Mistral model, SentencePieceTokenizer tokenizer,
                                       std::string prompt, std::string source)
    : model_(std::move(model)),
      tokenizer_(std::move(tokenizer)),
      prompt_(std::move(prompt)),
      source_(std::move(source)) {
  LVGGT_CHECK(tokenizer_.vocabulary_size() == model_.vocabulary_size(), tokenizer_.path(),
              ": the vocabulary has ", tokenizer_.vocabulary_size(),
              " tokens, but embed_tokens of ", source_, " has ", model_.vocabulary_size(), " rows");
}

Tensor<float, 2> MistralTextEncoder::encode(std::span<const std::string> phrases,
                                            Context& ctx) const {
  std::vector<std::vector<std::int64_t>> sequences;
  for (const std::string& phrase : phrases) {
    check_phrase(phrase);
    sequences.push_back(tokenizer_.encode(prompt_ + phrase, kMistralContext).ids);
    check_something_left(phrase, sequences.back().size());
  }
  Tensor<float, 2> embeddings(Shape{static_cast<std::int64_t>(phrases.size()), width()});
  for (std::size_t begin = 0; begin < sequences.size();) {
    std::size_t end = begin, tokens = 0;
    while (end < sequences.size() &&
           (end == begin || tokens + sequences[end].size() <= kMistralBatchTokens))
      tokens += sequences[end++].size();
    model_.forward(embeddings.view().narrow(0, static_cast<std::int64_t>(begin),
                                            static_cast<std::int64_t>(end)),
                   std::span(sequences).subspan(begin, end - begin), nullptr, ctx);
    begin = end;
  }
  return embeddings;
}

std::vector<std::string> MistralTextEncoder::warnings(std::span<const std::string> phrases) const {
  std::vector<std::string> result;
  for (const std::string& phrase : phrases) {
    const auto encoded = tokenizer_.encode(prompt_ + phrase, kMistralContext);
    if (encoded.full_length > kMistralContext)
      result.push_back(cut_warning(phrase, encoded.full_length, kMistralContext));
  }
  return result;
}

std::string MistralTextEncoder::describe() const {
  return concat("Mistral, ", model_.num_layers(), " layers of width ", width(), ", ",
                model_.num_bytes() >> 20, " MiB of weights used from their files, from ", source_);
}

}  // namespace lvggt
