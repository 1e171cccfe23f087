// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <string>
#include <vector>

namespace lvggt {

// A SentencePiece model (tokenizer.model), as published beside e5-mistral. Needs lvggt::text.
class SentencePieceTokenizer {
 public:
  // `path`: the model file, or a folder that holds tokenizer.model. Errors: kRead, kFormat.
  static SentencePieceTokenizer open(const std::string& path);
  ~SentencePieceTokenizer();
  SentencePieceTokenizer(SentencePieceTokenizer&&) noexcept;
  SentencePieceTokenizer& operator=(SentencePieceTokenizer&&) = delete;

  const std::string& path() const { return path_; }
  std::int64_t vocabulary_size() const;

  struct Ids {
    std::vector<std::int64_t> ids;  // <s>, text, </s>
    std::int64_t full_length = 0;   // what their number would be without the limit
  };
  // At most `context` ids: a longer text is cut before its </s>. Errors: kFormat for text that is
  // not UTF-8.
  Ids encode(const std::string& text, std::int64_t context) const;

 private:
  struct Processor;
  explicit SentencePieceTokenizer(std::unique_ptr<Processor> processor);

  std::string path_;
  std::unique_ptr<Processor> processor_;
};

}  // namespace lvggt
