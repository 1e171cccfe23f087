// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/embeddings.h"

#include <algorithm>
#include <cmath>
#include <filesystem>

#include "lvggt/io/json.h"
#include "lvggt/io/npy.h"
#include "lvggt/language/clip.h"

namespace lvggt {
namespace {

// Phrases named in a message at most.
constexpr std::size_t kMostNamed = 12;

std::vector<std::string> read_phrases(const std::string& path) {
  const Json json = Json::read(path);
  std::vector<std::string> phrases;
  for (const Json& phrase : json.as_array(path))
    phrases.push_back(phrase.as_string(concat(path, ": phrase ", phrases.size())));
  return phrases;
}

std::string listed(const std::vector<std::string>& phrases) {
  std::string text;
  for (std::size_t i = 0; i < std::min(phrases.size(), kMostNamed); ++i)
    text += (i == 0 ? "" : ", ") + json_quote(phrases[i]);
  if (phrases.size() > kMostNamed) text += concat(" and ", phrases.size() - kMostNamed, " more");
  return text;
}

}  // namespace

void check_phrase(const std::string& phrase) {
  LVGGT_CHECK(phrase.find_first_not_of(" \t\r\n\f\v") != std::string::npos, "the phrase ",
              json_quote(phrase), " is empty");
  if (static_cast<std::int64_t>(phrase.size()) > kMaxPhraseBytes)
    fail(ErrorKind::kLimit, "the phrase that begins ", json_quote(phrase.substr(0, 40)), " has ",
         phrase.size(), " bytes, above the limit of ", kMaxPhraseBytes);
}

PrecomputedEmbeddings PrecomputedEmbeddings::open(const std::string& npy,
                                                  const std::string& phrases) {
  const NpyFile file(npy);
  const std::string list =
      phrases.empty() ? std::filesystem::path(npy).replace_extension(".json").string() : phrases;
  PrecomputedEmbeddings result;
  result.path_ = npy;
  result.rows_ = file.read<2>();
  result.phrases_ = read_phrases(list);
  const auto [n, d] = result.rows_.shape();
  LVGGT_CHECK(n == static_cast<std::int64_t>(result.phrases_.size()), npy, ": has ", n,
              " vectors, but ", list, " has ", result.phrases_.size(), " phrases");
  LVGGT_CHECK(n > 0 && d > 0, npy, ": holds no vectors, its shape is ", result.rows_.shape());
  for (std::int64_t i = 0; i < n; ++i) {
    const std::string& phrase = result.phrases_[static_cast<std::size_t>(i)];
    if (!result.row_of_.emplace(phrase, i).second)
      fail(ErrorKind::kFormat, list, ": the phrase ", json_quote(phrase), " is there twice");
    double squares = 0;
    for (std::int64_t c = 0; c < d; ++c) squares += double{result.rows_(i, c)} * result.rows_(i, c);
    if (!std::isfinite(squares) || squares == 0)
      fail(ErrorKind::kNumeric, npy, ": the vector of ", json_quote(phrase),
           squares == 0 ? " is all zeros" : " holds NaN or infinity");
  }
  normalize_rows(result.rows_);
  return result;
}

Tensor<float, 2> PrecomputedEmbeddings::encode(std::span<const std::string> phrases,
                                               Context&) const {
  Tensor<float, 2> result(Shape{static_cast<std::int64_t>(phrases.size()), width()});
  for (std::size_t i = 0; i < phrases.size(); ++i) {
    check_phrase(phrases[i]);
    const auto found = row_of_.find(phrases[i]);
    LVGGT_CHECK(found != row_of_.end(), "the phrase ", json_quote(phrases[i]),
                " is not in the list of ", path_, ", which has ", listed(phrases_));
    std::copy_n(rows_[found->second].data(), width(), result[static_cast<std::int64_t>(i)].data());
  }
  return result;
}

std::string PrecomputedEmbeddings::describe() const {
  return concat(phrases_.size(), " precomputed vectors of width ", width(), " from ", path_);
}

}  // namespace lvggt
