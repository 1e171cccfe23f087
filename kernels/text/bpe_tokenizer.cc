// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/bpe_tokenizer.h"

#include <algorithm>
#include <limits>

#include "kernels/text/unicode.h"
#include "lvggt/core/error.h"
#include "lvggt/language/text_cleaning.h"

namespace lvggt {
namespace {

constexpr std::u32string_view kStart = U"<start_of_text>", kEnd = U"<end_of_text>";
constexpr std::u32string_view kContractions[] = {U"'s", U"'t",  U"'re", U"'ve",
                                                 U"'m", U"'ll", U"'d"};

// Length of the contraction at the head of `rest`, or 0. The published pattern ignores case, which
// makes the long s an s.
std::size_t contraction_length(std::u32string_view rest) {
  for (const std::u32string_view contraction : kContractions) {
    if (rest.size() < contraction.size()) continue;
    bool same = true;
    for (std::size_t i = 0; i < contraction.size(); ++i)
      same = same && (rest[i] == 0x17F ? U's' : rest[i]) == contraction[i];
    if (same) return contraction.size();
  }
  return 0;
}

bool is_other(char32_t c) {
  return !text::is_space(c) && !text::is_letter(c) && !text::is_number(c);
}

// Length of the word that the pattern finds at the head of `rest`: a contraction, letters, one
// digit, or a run of anything else; 0 for white space.
std::size_t word_length(std::u32string_view rest) {
  if (const std::size_t length = contraction_length(rest); length > 0) return length;
  if (text::is_number(rest[0])) return 1;
  const bool letters = text::is_letter(rest[0]);
  if (!letters && !is_other(rest[0])) return 0;
  std::size_t length = 1;
  while (length < rest.size() && (letters ? text::is_letter(rest[length]) : is_other(rest[length])))
    ++length;
  return length;
}

std::uint64_t pair_key(std::int32_t left, std::int32_t right) {
  return static_cast<std::uint64_t>(static_cast<std::uint32_t>(left)) << 32 |
         static_cast<std::uint32_t>(right);
}

}  // namespace

void BpeTokenizer::add_word(std::string_view word, std::vector<std::int64_t>& ids) const {
  std::vector<std::int32_t> parts;
  for (std::size_t i = 0; i < word.size(); ++i) {
    const auto byte = static_cast<std::uint8_t>(word[i]);
    parts.push_back(i + 1 < word.size() ? inner_[byte] : last_[byte]);
  }
  while (parts.size() > 1) {
    Merge best{std::numeric_limits<std::int32_t>::max(), 0};
    std::uint64_t best_pair = 0;
    for (std::size_t i = 0; i + 1 < parts.size(); ++i) {
      const auto found = merges_.find(pair_key(parts[i], parts[i + 1]));
      if (found == merges_.end() || found->second.rank >= best.rank) continue;
      best = found->second;
      best_pair = found->first;
    }
    if (best_pair == 0 && best.rank == std::numeric_limits<std::int32_t>::max()) break;
    std::size_t kept = 0;
    for (std::size_t i = 0; i < parts.size(); ++kept) {
      const bool merged = i + 1 < parts.size() && pair_key(parts[i], parts[i + 1]) == best_pair;
      parts[kept] = merged ? best.result : parts[i];
      i += merged ? 2 : 1;
    }
    parts.resize(kept);
  }
  ids.insert(ids.end(), parts.begin(), parts.end());
}

BpeTokenizer::Ids BpeTokenizer::encode(std::string_view text, std::int64_t context) const {
  LVGGT_CHECK(context >= 2, "tokenizer: a context of ", context, " has no room for any text");
  const std::u32string clean = text::decode_utf8(clean_text(text), "the cleaned text");
  Ids result;
  result.ids.push_back(start_);
  for (std::u32string_view rest = clean; !rest.empty();) {
    std::size_t length = 1;
    if (rest.starts_with(kStart) || rest.starts_with(kEnd)) {
      const bool start = rest.starts_with(kStart);
      length = start ? kStart.size() : kEnd.size();
      result.ids.push_back(start ? start_ : end_);
    } else if (const std::size_t word = word_length(rest); word > 0) {
      length = word;
      add_word(text::encode_utf8(rest.substr(0, word)), result.ids);
    }
    rest.remove_prefix(length);
  }
  result.ids.push_back(end_);
  result.full_length = static_cast<std::int64_t>(result.ids.size());
  if (result.full_length > context) {
    result.ids.resize(static_cast<std::size_t>(context));
    result.ids.back() = end_;
  }
  return result;
}

}  // namespace lvggt
