// SPDX-License-Identifier: Apache-2.0
// The published forms of CLIP's vocabulary.
#include <zlib.h>

#include <algorithm>
#include <filesystem>
#include <limits>
#include <memory>
#include <optional>
#include <unordered_map>
#include <utility>
#include <vector>

#include "kernels/text/unicode.h"
#include "lvggt/core/error.h"
#include "lvggt/io/input_file.h"
#include "lvggt/io/json.h"
#include "lvggt/language/bpe_tokenizer.h"

namespace lvggt {

namespace {

namespace fs = std::filesystem;

constexpr const char* kGzName = "bpe_simple_vocab_16e6.txt.gz";
constexpr std::size_t kMaxTextBytes = std::size_t{64} << 20;  // of the unpacked .txt.gz
constexpr std::size_t kByteTokens = 512;                      // bytes, and the same with </w>
constexpr std::size_t kGzMerges = 48894;                      // what CLIP uses of the file's 262144

// The bytes in the order of their ids: those that print stand for themselves, the others for the
// code points from 256 on.
std::vector<std::pair<std::uint8_t, char32_t>> byte_symbols() {
  const auto prints = [](int b) { return (b >= 33 && b <= 126) || (b >= 161 && b != 173); };
  std::vector<std::pair<std::uint8_t, char32_t>> symbols;
  for (int b = 0; b < 256; ++b)
    if (prints(b)) symbols.emplace_back(static_cast<std::uint8_t>(b), static_cast<char32_t>(b));
  char32_t next = 256;
  for (int b = 0; b < 256; ++b)
    if (!prints(b)) symbols.emplace_back(static_cast<std::uint8_t>(b), next++);
  return symbols;
}

std::string symbol_text(char32_t symbol) { return text::encode_utf8({&symbol, 1}); }

std::vector<std::string> lines_of(const std::string& content) {
  std::vector<std::string> lines;
  for (std::size_t begin = 0; begin < content.size();) {
    const std::size_t at = std::min(content.find('\n', begin), content.size());
    std::string line = content.substr(begin, at - begin);
    if (!line.empty() && line.back() == '\r') line.pop_back();
    lines.push_back(std::move(line));
    begin = at + 1;
  }
  return lines;
}

std::string unpack(const std::string& path) {
  InputFile check(path);  // a missing or odd file is reported as everywhere
  const std::unique_ptr<gzFile_s, int (*)(gzFile)> file(gzopen(path.c_str(), "rb"), gzclose);
  if (file == nullptr) fail(ErrorKind::kRead, path, ": cannot be opened");
  std::string content;
  std::vector<char> block(1 << 16);
  while (true) {
    const int n = gzread(file.get(), block.data(), static_cast<unsigned>(block.size()));
    if (n < 0) {
      int code = 0;
      fail(ErrorKind::kFormat, path, " is no whole gzip file: ", gzerror(file.get(), &code));
    }
    if (n == 0) break;
    content.append(block.data(), static_cast<std::size_t>(n));
    if (content.size() > kMaxTextBytes)
      fail(ErrorKind::kLimit, path, " unpacks to more than ", kMaxTextBytes, " bytes");
  }
  return content;
}

}  // namespace

// Collects a vocabulary and its merges, then checks that they make a tokeniser.
class BpeBuilder {
 public:
  using Pair = std::pair<std::string, std::string>;

  explicit BpeBuilder(std::string path) : path_(std::move(path)) {}

  void add_vocabulary(const Json& json, const std::string& source) {
    for (const auto& [token, id] : json.as_object(source))
      add_token(token, id.as_int64(source + ": the id of a token"), source);
  }
  void add_token(const std::string& token, std::int64_t id, const std::string& source) {
    if (id < 0 || id > std::numeric_limits<std::int32_t>::max() - 1)
      fail(ErrorKind::kFormat, source, ": the id ", id, " of ", json_quote(token),
           " is out of range");
    if (!ids_.emplace(token, static_cast<std::int32_t>(id)).second)
      fail(ErrorKind::kFormat, source, ": the token ", json_quote(token), " is there twice");
  }

  // Lines "left right"; `place` says where they are from.
  void add_merge_line(const std::string& line, const std::string& source, std::size_t number) {
    const std::size_t space = line.find(' ');
    if (space == 0 || space == std::string::npos || space + 1 == line.size() ||
        line.find(' ', space + 1) != std::string::npos)
      fail(ErrorKind::kFormat, source, ": line ", number, " is ", json_quote(line),
           ", which is not two parts with a blank between them");
    merges_.emplace_back(line.substr(0, space), line.substr(space + 1));
  }
  void add_merge(std::string left, std::string right) {
    merges_.emplace_back(std::move(left), std::move(right));
  }
  std::size_t num_merges() const { return merges_.size(); }

  // The vocabulary that the merges alone define, as OpenCLIP builds it.
  void derive_vocabulary(const std::string& source) {
    std::int64_t id = 0;
    for (const char* end : {"", "</w>"})
      for (const auto& [byte, symbol] : byte_symbols())
        add_token(symbol_text(symbol) + end, id++, source);
    for (const auto& [left, right] : merges_) add_token(left + right, id++, source);
    for (const char* name : {"<start_of_text>", "<end_of_text>"}) add_token(name, id++, source);
  }

  BpeTokenizer finish(const std::string& merges_source) const {
    BpeTokenizer tokenizer;
    tokenizer.path_ = path_;
    tokenizer.num_ids_ = ids_.size();
    check_ids();
    tokenizer.start_ = special({"<|startoftext|>", "<start_of_text>"});
    tokenizer.end_ = special({"<|endoftext|>", "<end_of_text>"});
    LVGGT_CHECK(tokenizer.end_ + 1 == tokenizer.vocabulary_size(), path_, ": the end token is ",
                tokenizer.end_, ", but CLIP needs it to be the largest id, ",
                tokenizer.vocabulary_size() - 1);
    for (const auto& [byte, symbol] : byte_symbols()) {
      tokenizer.inner_[byte] = id_of(symbol_text(symbol), path_);
      tokenizer.last_[byte] = id_of(symbol_text(symbol) + "</w>", path_);
    }
    const std::size_t needed = ids_.size() - kByteTokens - 2;
    LVGGT_CHECK(merges_.size() == needed, merges_source, ": has ", merges_.size(),
                " merges, but the vocabulary of ", ids_.size(), " tokens needs ", needed,
                merges_.size() < needed ? "; the file is cut short or belongs to another vocabulary"
                                        : "; it belongs to another vocabulary");
    add_merges(tokenizer, merges_source);
    return tokenizer;
  }

 private:
  std::int32_t id_of(const std::string& token, const std::string& source) const {
    const auto found = ids_.find(token);
    if (found == ids_.end())
      fail(ErrorKind::kFormat, source, ": the token ", json_quote(token),
           " is not in the vocabulary");
    return found->second;
  }
  std::int32_t special(std::initializer_list<const char*> names) const {
    for (const char* name : names)
      if (const auto found = ids_.find(name); found != ids_.end()) return found->second;
    fail(ErrorKind::kFormat, path_, ": the vocabulary has no ", *names.begin());
  }
  void check_ids() const {
    LVGGT_CHECK(ids_.size() > kByteTokens + 2, path_, ": the vocabulary has only ", ids_.size(),
                " tokens, fewer than its ", kByteTokens + 2, " bytes and special tokens");
    std::vector<bool> used(ids_.size(), false);
    for (const auto& [token, id] : ids_) {
      const auto i = static_cast<std::size_t>(id);
      if (i >= used.size() || used[i])
        fail(ErrorKind::kFormat, path_, ": the id ", id, " of ", json_quote(token),
             i >= used.size() ? " is not below the number of tokens" : " is used twice");
      used[i] = true;
    }
  }
  void add_merges(BpeTokenizer& tokenizer, const std::string& source) const {
    for (std::size_t rank = 0; rank < merges_.size(); ++rank) {
      const auto& [left, right] = merges_[rank];
      const auto a = static_cast<std::uint32_t>(id_of(left, source));
      const auto b = static_cast<std::uint32_t>(id_of(right, source));
      const BpeTokenizer::Merge merge{static_cast<std::int32_t>(rank), id_of(left + right, source)};
      if (!tokenizer.merges_.emplace(std::uint64_t{a} << 32 | b, merge).second)
        fail(ErrorKind::kFormat, source, ": the merge of ", json_quote(left), " and ",
             json_quote(right), " is there twice");
    }
  }

  std::string path_;
  std::unordered_map<std::string, std::int32_t> ids_;
  std::vector<Pair> merges_;
};

namespace {

void add_merges_text(BpeBuilder& builder, const std::string& path) {
  const std::vector<std::string> lines = lines_of(read_text_file(path));
  for (std::size_t i = 0; i < lines.size(); ++i) {
    const bool version = i == 0 && lines[i].starts_with("#version");
    if (!version && !lines[i].empty()) builder.add_merge_line(lines[i], path, i + 1);
  }
}

BpeTokenizer open_pair(const fs::path& folder) {
  const std::string vocabulary = (folder / "vocab.json").string();
  const std::string merges = (folder / "merges.txt").string();
  BpeBuilder builder(vocabulary);
  builder.add_vocabulary(Json::read(vocabulary), vocabulary);
  add_merges_text(builder, merges);
  return builder.finish(merges);
}

BpeTokenizer open_tokenizer_json(const std::string& path) {
  const Json json = Json::read(path);
  const Json* model = json.find("model");
  const Json* vocabulary = model == nullptr ? nullptr : model->find("vocab");
  const Json* merges = model == nullptr ? nullptr : model->find("merges");
  if (vocabulary == nullptr || merges == nullptr)
    fail(ErrorKind::kFormat, path, ": has no model.vocab and model.merges, as a byte-level BPE ",
         "tokenizer.json has");
  BpeBuilder builder(path);
  builder.add_vocabulary(*vocabulary, path + ": model.vocab");
  const std::string place = path + ": model.merges";
  std::size_t number = 0;
  for (const Json& merge : merges->as_array(place)) {
    ++number;
    if (merge.is_string()) {  // "a b"; newer files have ["a", "b"]
      builder.add_merge_line(merge.as_string(place), place, number);
      continue;
    }
    const Json::Array& parts = merge.as_array(place);
    if (parts.size() != 2)
      fail(ErrorKind::kFormat, place, ": entry ", number, " has ", parts.size(), " parts, not two");
    builder.add_merge(parts[0].as_string(place), parts[1].as_string(place));
  }
  return builder.finish(place);
}

BpeTokenizer open_gz(const std::string& path) {
  BpeBuilder builder(path);
  const std::vector<std::string> lines = lines_of(unpack(path));
  for (std::size_t i = 1; i < lines.size() && builder.num_merges() < kGzMerges; ++i)
    builder.add_merge_line(lines[i], path, i + 1);
  LVGGT_CHECK(builder.num_merges() == kGzMerges, path, ": has ", builder.num_merges(),
              " merges, but CLIP's vocabulary needs ", kGzMerges, "; the file is cut short");
  builder.derive_vocabulary(path);
  return builder.finish(path);
}

}  // namespace

BpeTokenizer BpeTokenizer::open(const std::string& path) {
  std::error_code ignored;
  if (!fs::is_directory(path, ignored)) {
    const std::string name = fs::path(path).filename().string();
    if (name.ends_with(".gz")) return open_gz(path);
    if (name == "merges.txt" || name == "vocab.json")
      return open_pair(fs::path(path).parent_path());
    return open_tokenizer_json(path);
  }
  const fs::path folder = path;
  if (fs::exists(folder / "tokenizer.json", ignored))
    return open_tokenizer_json((folder / "tokenizer.json").string());
  if (fs::exists(folder / "vocab.json", ignored) || fs::exists(folder / "merges.txt", ignored))
    return open_pair(folder);
  if (fs::exists(folder / kGzName, ignored)) return open_gz((folder / kGzName).string());
  fail(ErrorKind::kRead, path, ": holds none of tokenizer.json, vocab.json with merges.txt, and ",
       kGzName);
}

}  // namespace lvggt
