// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/sentence_piece.h"

#include <sentencepiece_processor.h>

#include <filesystem>
#include <utility>

#include "lvggt/core/error.h"
#include "lvggt/io/input_file.h"
#include "lvggt/language/text_cleaning.h"

namespace lvggt {

struct SentencePieceTokenizer::Processor {
  sentencepiece::SentencePieceProcessor model;
};

namespace {

// A model of 32,000 pieces has half a megabyte.
constexpr std::uint64_t kMaxModelBytes = std::uint64_t{256} << 20;

}  // namespace

SentencePieceTokenizer::SentencePieceTokenizer(std::unique_ptr<Processor> processor)
    : processor_(std::move(processor)) {}
SentencePieceTokenizer::~SentencePieceTokenizer() = default;
SentencePieceTokenizer::SentencePieceTokenizer(SentencePieceTokenizer&&) noexcept = default;

SentencePieceTokenizer SentencePieceTokenizer::open(const std::string& path) {
  std::error_code ignored;
  const std::string file = std::filesystem::is_directory(path, ignored)
                               ? (std::filesystem::path(path) / "tokenizer.model").string()
                               : path;
  auto processor = std::make_unique<Processor>();
  const std::string bytes = read_text_file(file, kMaxModelBytes);
  const auto status = processor->model.LoadFromSerializedProto(bytes);
  if (!status.ok())
    fail(ErrorKind::kFormat, file, " is no SentencePiece model: ", status.ToString());
  const auto& model = processor->model;
  LVGGT_CHECK(
      model.bos_id() >= 0 && model.eos_id() >= 0, file,
      ": the model has no <s> or no </s>, which the encoder's sentences begin and end with");
  SentencePieceTokenizer tokenizer(std::move(processor));
  tokenizer.path_ = file;
  return tokenizer;
}

std::int64_t SentencePieceTokenizer::vocabulary_size() const {
  return processor_->model.GetPieceSize();
}

SentencePieceTokenizer::Ids SentencePieceTokenizer::encode(const std::string& text,
                                                           std::int64_t context) const {
  check_utf8(text, "the sentence");
  LVGGT_CHECK(context >= 2, "tokenizer: a context of ", context, " has no room for any text");
  std::vector<int> pieces;
  const auto status = processor_->model.Encode(text, &pieces);
  if (!status.ok()) fail(ErrorKind::kFormat, path_, ": cannot tokenise: ", status.ToString());
  Ids result;
  result.ids.push_back(processor_->model.bos_id());
  result.ids.insert(result.ids.end(), pieces.begin(), pieces.end());
  result.full_length = static_cast<std::int64_t>(result.ids.size()) + 1;
  if (result.full_length > context) result.ids.resize(static_cast<std::size_t>(context - 1));
  result.ids.push_back(processor_->model.eos_id());
  return result;
}

}  // namespace lvggt
