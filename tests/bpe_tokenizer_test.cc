// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/bpe_tokenizer.h"

#include <doctest/doctest.h>

#include <functional>

#include "lvggt/io/json.h"
#include "tests/support/bpe_files.h"
#include "tests/support/safetensors_bytes.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// A vocabulary in the published forms: the bytes, the bytes at a word's end, six merges, and the
// two special tokens, 520 in all.
const BpeMerges kMerges = {{"t", "h"},      {"th", "e</w>"}, {"c", "u"},
                           {"cu", "p</w>"}, {"'", "s</w>"},  {"a", "b"}};

std::vector<std::string> vocabulary() { return bpe_vocabulary(kMerges); }
std::string merges_text(const char* line_end) { return bpe_merges_text(kMerges, line_end); }

struct Folder {
  TempDir dir;
  Folder() {
    write_file(dir / "vocab.json", vocabulary_json(vocabulary()));
    write_file(dir / "merges.txt", merges_text("\n"));
  }
  Outcome open() const {
    return outcome_of([&] { BpeTokenizer::open(dir.path()); });
  }
};

constexpr std::int64_t kStart = 518, kEnd = 519;
constexpr std::int64_t kThe = 513, kCup = 515, kPossessive = 516;

// Id of a printing ASCII character inside and at the end of a word.
std::int64_t inner(char c) { return c - 33; }
std::int64_t last(char c) { return 256 + c - 33; }

}  // namespace

TEST_CASE("BpeTokenizer: words are merged by rank, their last bytes apart") {
  const Folder folder;
  const auto tokenizer = BpeTokenizer::open(folder.dir.path());
  CHECK(tokenizer.vocabulary_size() == 520);
  using Ids = std::vector<std::int64_t>;
  CHECK(tokenizer.encode("The  CUP", 77).ids == Ids{kStart, kThe, kCup, kEnd});
  CHECK(tokenizer.encode("cup's", 77).ids == Ids{kStart, kCup, kPossessive, kEnd});
  CHECK(tokenizer.encode("42", 77).ids == Ids{kStart, last('4'), last('2'), kEnd});
  CHECK(tokenizer.encode("abab x", 77).ids ==
        Ids{kStart, 517, inner('a'), last('b'), last('x'), kEnd});
  CHECK(tokenizer.encode("", 77).ids == Ids{kStart, kEnd});
  CHECK(tokenizer.encode("<end_of_text>the", 77).ids == Ids{kStart, kEnd, kThe, kEnd});
}

TEST_CASE("BpeTokenizer: tokenizer.json, with merges of either form, gives the same ids") {
  const Folder folder;
  const auto expected = BpeTokenizer::open(folder.dir.path()).encode("the cup's cup", 77).ids;
  std::string lines, pairs;
  for (const auto& [left, right] : kMerges) {
    lines += (lines.empty() ? "" : ", ") + json_quote(left + " " + right);
    pairs += (pairs.empty() ? "[" : ", [") + json_quote(left) + ", " + json_quote(right) + "]";
  }
  for (const std::string& merges : {lines, pairs}) {
    const TempDir dir;
    write_file(dir / "tokenizer.json",
               "{\"model\": {\"type\": \"BPE\", \"vocab\": " + vocabulary_json(vocabulary()) +
                   ", \"merges\": [" + merges + "]}}");
    CHECK(BpeTokenizer::open(dir.path()).encode("the cup's cup", 77).ids == expected);
  }
}

TEST_CASE("D06 BpeTokenizer: 76, 77 and 78 ids; what is cut is counted") {
  const Folder folder;
  const auto tokenizer = BpeTokenizer::open(folder.dir.path());
  for (const std::int64_t words : {74, 75, 76, 4000}) {
    std::string text;
    for (std::int64_t i = 0; i < words; ++i) text += "the ";
    const auto encoded = tokenizer.encode(text, 77);
    CHECK(encoded.full_length == words + 2);
    CHECK(static_cast<std::int64_t>(encoded.ids.size()) == std::min<std::int64_t>(words + 2, 77));
    CHECK(encoded.ids.back() == kEnd);
    CHECK(encoded.ids[encoded.ids.size() - 2] == kThe);
  }
}

TEST_CASE("B26 BpeTokenizer: CRLF line ends are fine") {
  const Folder folder;
  write_file(folder.dir / "merges.txt", merges_text("\r\n"));
  CHECK(BpeTokenizer::open(folder.dir.path()).encode("the", 77).ids[1] == kThe);
}

TEST_CASE("B26 BpeTokenizer: a merges file cut short, or with a merge twice, is refused") {
  const Folder folder;
  std::string text = merges_text("\n");
  write_file(folder.dir / "merges.txt", text.substr(0, text.rfind("a b")));
  Outcome outcome = folder.open();
  CHECK(outcome.kind == ErrorKind::kMismatch);
  CHECK(
      outcome.says("has 5 merges, but the vocabulary of 520 tokens needs 6; the file is cut "
                   "short or belongs to another vocabulary"));
  write_file(folder.dir / "merges.txt", text.substr(0, text.rfind(" b")));
  CHECK(folder.open().says("which is not two parts with a blank between them"));
  write_file(folder.dir / "merges.txt", text.substr(0, text.rfind("a b")) + "t h\n");
  CHECK(folder.open().says("the merge of \"t\" and \"h\" is there twice"));
  write_file(folder.dir / "merges.txt", text.substr(0, text.rfind("a b")) + "x y\n");
  CHECK(folder.open().says("the token \"xy\" is not in the vocabulary"));
  write_file(folder.dir / "merges.txt", "");
  CHECK(folder.open().says("has 0 merges"));
}

TEST_CASE("B26 BpeTokenizer: odd ids and missing tokens are refused") {
  const Folder folder;
  const auto with = [&](const std::function<void(std::vector<std::string>&)>& edit) {
    std::vector<std::string> tokens = vocabulary();
    edit(tokens);
    write_file(folder.dir / "vocab.json", vocabulary_json(tokens));
    return folder.open();
  };
  CHECK(with([](auto& tokens) { tokens.pop_back(); }).says("has no <|endoftext|>"));
  CHECK(with([](auto& tokens) {
          tokens.push_back("more");
        }).says("the end token is 519, but CLIP needs it to be the largest id, 520"));
  CHECK(with([](auto& tokens) { tokens[3] = "no byte"; }).says("is not in the vocabulary"));
  CHECK(with([](auto& tokens) { tokens.resize(10); }).says("has only 10 tokens"));
  std::string text = vocabulary_json(vocabulary());
  text.replace(text.find(": 7,"), 3, ": 6");
  write_file(folder.dir / "vocab.json", text);
  CHECK(folder.open().says("the id 6 of"));
  text.replace(text.find(": 6,"), 3, ": -6");
  write_file(folder.dir / "vocab.json", text);
  CHECK(folder.open().says("is out of range"));
}

TEST_CASE("BpeTokenizer: a folder without a vocabulary says what it looked for") {
  const TempDir dir;
  const Outcome outcome = outcome_of([&] { BpeTokenizer::open(dir.path()); });
  CHECK(outcome.kind == ErrorKind::kRead);
  CHECK(outcome.says("holds none of tokenizer.json, vocab.json with merges.txt, and"));
  write_file(dir / "bpe_simple_vocab_16e6.txt.gz", "no gzip\nt h\n");
  CHECK(outcome_of([&] {
          BpeTokenizer::open(dir.path());
        }).says("has 1 merges, but CLIP's vocabulary needs 48894; the file is cut short"));
}
