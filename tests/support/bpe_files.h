// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <utility>
#include <vector>

#include "lvggt/io/json.h"

namespace lvggt::test {

// A byte-level BPE vocabulary of CLIP's form in the published files: the bytes, the bytes at a
// word's end, one token for every merge, and the two special tokens.
using BpeMerges = std::vector<std::pair<std::string, std::string>>;

inline std::string code_point(int c) {
  if (c < 0x80) return std::string(1, static_cast<char>(c));
  return {static_cast<char>(0xC0 | c >> 6), static_cast<char>(0x80 | (c & 0x3F))};
}

// What stands for the bytes, in the order of their ids.
inline std::vector<std::string> byte_symbols() {
  std::vector<std::string> all;
  const auto prints = [](int b) { return (b >= 33 && b <= 126) || (b >= 161 && b != 173); };
  for (int b = 0; b < 256; ++b)
    if (prints(b)) all.push_back(code_point(b));
  for (int next = 256; all.size() < 256; ++next) all.push_back(code_point(next));
  return all;
}

inline std::vector<std::string> bpe_vocabulary(const BpeMerges& merges) {
  std::vector<std::string> tokens = byte_symbols();
  for (const std::string& symbol : byte_symbols()) tokens.push_back(symbol + "</w>");
  for (const auto& [left, right] : merges) tokens.push_back(left + right);
  tokens.push_back("<|startoftext|>");
  tokens.push_back("<|endoftext|>");
  return tokens;
}

// vocab.json
inline std::string vocabulary_json(const std::vector<std::string>& tokens) {
  std::string text = "{";
  for (std::size_t i = 0; i < tokens.size(); ++i)
    text += (i == 0 ? "" : ", ") + json_quote(tokens[i]) + ": " + std::to_string(i);
  return text + "}";
}

// merges.txt
inline std::string bpe_merges_text(const BpeMerges& merges, const char* line_end) {
  std::string text = std::string("#version: 0.2") + line_end;
  for (const auto& [left, right] : merges) text += left + " " + right + line_end;
  return text;
}

}  // namespace lvggt::test
