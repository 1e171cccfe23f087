// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

namespace lvggt {

// CLIP's tokeniser: cleaned text (language/text_cleaning.h) split into words, the bytes of each
// word merged by rank. Needs lvggt::text.
class BpeTokenizer {
 public:
  // `path` is one of the published forms: a folder with tokenizer.json, with vocab.json and
  // merges.txt, or with bpe_simple_vocab_16e6.txt.gz; or tokenizer.json, merges.txt (vocab.json
  // beside it) or that .txt.gz itself. Of several in a folder the first in this order counts.
  // Errors: kRead, kFormat (a merge without two parts, one given twice, one whose parts or result
  // the vocabulary does not have, an id out of range or used twice), kMismatch (as many merges as
  // the vocabulary needs are not there: a file cut short), kLimit.
  static BpeTokenizer open(const std::string& path);

  // The file that holds the vocabulary.
  const std::string& path() const { return path_; }
  std::int64_t vocabulary_size() const { return static_cast<std::int64_t>(num_ids_); }
  std::int64_t start_token() const { return start_; }
  std::int64_t end_token() const { return end_; }

  struct Ids {
    std::vector<std::int64_t> ids;  // start token, text, end token
    std::int64_t full_length = 0;   // what their number would be without the limit
  };
  // At most `context` ids: of a longer text the first ones, the last replaced by the end token, as
  // published. Errors: kFormat for text that is not UTF-8.
  Ids encode(std::string_view text, std::int64_t context) const;

 private:
  struct Merge {
    std::int32_t rank = 0;
    std::int32_t result = 0;
  };
  friend class BpeBuilder;
  BpeTokenizer() = default;

  void add_word(std::string_view word, std::vector<std::int64_t>& ids) const;

  std::string path_;
  std::size_t num_ids_ = 0;
  std::int64_t start_ = 0, end_ = 0;
  std::array<std::int32_t, 256> inner_{}, last_{};  // ids of a byte inside and at the end of a word
  std::unordered_map<std::uint64_t, Merge> merges_;  // by (left id << 32 | right id)
};

}  // namespace lvggt
