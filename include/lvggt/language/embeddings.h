// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>
#include <vector>

#include "lvggt/language/text_encoder.h"

namespace lvggt {

// Checks what every encoder asks of a phrase: something that is not white space, and at most
// kMaxPhraseBytes. Errors: kMismatch, kLimit.
void check_phrase(const std::string& phrase);

// Vectors computed elsewhere: a .npy file [n, d] of any number type and a JSON list of the n
// phrases they belong to. Rows are brought to length 1.
class PrecomputedEmbeddings : public TextEncoder {
 public:
  // `phrases` is the JSON file; empty: that of the same name beside `npy`. Errors: those of NpyFile
  // and Json; kMismatch when the numbers of rows and phrases differ; kFormat for a phrase given
  // twice; kNumeric for a vector with NaN or infinity, or without length.
  static PrecomputedEmbeddings open(const std::string& npy, const std::string& phrases = "");

  std::int64_t width() const override { return rows_.extent(1); }
  Tensor<float, 2> encode(std::span<const std::string> phrases, Context& ctx) const override;
  std::string describe() const override;

  // In the order of the file.
  const std::vector<std::string>& phrases() const { return phrases_; }
  View<const float, 2> rows() const { return rows_; }  // [n, d], of length 1

 private:
  PrecomputedEmbeddings() = default;

  std::string path_;
  std::vector<std::string> phrases_;
  std::map<std::string, std::int64_t, std::less<>> row_of_;
  Tensor<float, 2> rows_;
};

}  // namespace lvggt
