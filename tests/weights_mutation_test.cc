// SPDX-License-Identifier: Apache-2.0
// Readers of weights against thousands of damaged files, the same ones in every run. A reader may
// accept or refuse each, but only with an Error; the sanitizers watch for everything else.
#include <doctest/doctest.h>

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "kernels/io/safetensors_header.h"
#include "lvggt/core/error.h"
#include "lvggt/io/json.h"
#include "tests/support/pth_bytes.h"
#include "tests/support/safetensors_bytes.h"
#include "weights/pickle.h"
#include "weights/pth.h"

namespace {

using lvggt::test::PickleWriter;
using lvggt::test::TempDir;
using lvggt::test::write_pth;

// splitmix64
class Random {
 public:
  explicit Random(std::uint64_t seed) : state_(seed) {}
  std::uint64_t next() {
    std::uint64_t z = state_ += 0x9E3779B97F4A7C15u;
    z = (z ^ (z >> 30)) * 0xBF58476D1CE4E5B9u;
    z = (z ^ (z >> 27)) * 0x94D049BB133111EBu;
    return z ^ (z >> 31);
  }
  std::size_t below(std::size_t n) { return static_cast<std::size_t>(next() % n); }

 private:
  std::uint64_t state_;
};

// One to four small edits: a byte changed, removed, inserted, a piece copied elsewhere, a token of
// the format put in, or the end cut off.
std::string mutated(std::string text, const std::vector<std::string>& tokens, Random& random) {
  const std::size_t edits = 1 + random.below(4);
  for (std::size_t i = 0; i < edits && !text.empty(); ++i) {
    const std::size_t at = random.below(text.size());
    switch (random.below(6)) {
      case 0:
        text[at] = static_cast<char>(random.next());
        break;
      case 1:
        text.erase(at, 1 + random.below(8));
        break;
      case 2:
        text.insert(at, 1, static_cast<char>(random.next()));
        break;
      case 3:
        text.insert(at, text.substr(random.below(text.size()), 1 + random.below(40)));
        break;
      case 4:
        text.insert(at, tokens[random.below(tokens.size())]);
        break;
      default:
        text.resize(at);
        break;
    }
  }
  return text;
}

// Runs `read` on `count` mutations; returns how many were accepted. Any other exception fails the
// test.
template <class Read>
int count_accepted(const std::string& seed_text, const std::vector<std::string>& tokens, int count,
                   Read&& read) {
  Random random(20251122);
  int accepted = 0;
  for (int i = 0; i < count; ++i) {
    const std::string text = mutated(seed_text, tokens, random);
    try {
      read(text);
      ++accepted;
    } catch (const lvggt::Error&) {
    }
  }
  return accepted;
}

std::string sample_pickle() {
  return PickleWriter()
      .global("collections", "OrderedDict")
      .op(')')
      .op('R')
      .op('q')
      .byte(0)
      .op('(')
      .text("a")
      .tensor("FloatStorage", "0", 4, 0, {2, 2}, {2, 1})
      .text("b")
      .tensor("HalfStorage", "1", 8, 1, {3, 2}, {1, 3})
      .text("epoch")
      .op('h')
      .byte(0)
      .op('u')
      .op('}')
      .text("_metadata")
      .op('}')
      .op('s')
      .op('b')
      .done();
}

}  // namespace

TEST_CASE("R1: 40,000 damaged safetensors headers are accepted or refused, nothing else") {
  const std::string header =
      R"({"__metadata__":{"config":"{}"},"a.weight":{"dtype":"F32","shape":[2,3],"data_offsets":[0,24]},)"
      R"("b":{"dtype":"BF16","shape":[],"data_offsets":[24,26],"x":[1,{"y":null}]},)"
      R"("\u00fc":{"dtype":"I64","shape":[1,0,7],"data_offsets":[26,26]}})";
  const std::vector<std::string> tokens{"{",
                                        "}",
                                        "[",
                                        "]",
                                        ",",
                                        ":",
                                        "\"",
                                        "-1",
                                        "1e999",
                                        "18446744073709551616",
                                        "9223372036854775807",
                                        "null",
                                        "true",
                                        "\"dtype\":",
                                        "\"shape\":",
                                        "\"data_offsets\":",
                                        "[0,0]",
                                        "\"__metadata__\":",
                                        "\\u0000",
                                        "\\ud800"};
  const int accepted = count_accepted(header, tokens, 40'000, [](const std::string& text) {
    lvggt::parse_safetensors_header(text, 26, "mutation", {});
  });
  CHECK(accepted > 0);
  CHECK(accepted < 20'000);
}

TEST_CASE("R1: 20,000 damaged JSON texts are accepted or refused, nothing else") {
  const std::string text =
      R"({"a":[1,-2,3.5e-7,true,null,"x\n\u00e9"],"b":{"c":{"d":[[[]]]}},"e":""})";
  const std::vector<std::string> tokens{"{",  "}",   "[",     "]",    ",",  ":",
                                        "\"", "\\u", "1e400", "\xff", "/*", "-"};
  const int accepted = count_accepted(
      text, tokens, 20'000, [](const std::string& json) { lvggt::Json::parse(json, "mutation"); });
  CHECK(accepted > 0);
}

TEST_CASE("R1: 40,000 damaged pickles are accepted or refused, nothing else") {
  const std::vector<std::string> tokens{"(",
                                        "t",
                                        "R",
                                        "Q",
                                        "u",
                                        "s",
                                        "a",
                                        "e",
                                        "}",
                                        "]",
                                        ")",
                                        "0",
                                        "b",
                                        "N",
                                        std::string("h\0", 2),
                                        std::string("q\0", 2),
                                        "\x85",
                                        "\x94",
                                        "\x93",
                                        "cos\nsystem\n",
                                        "ctorch\nFloatStorage\n",
                                        "\x8a\x08\xff\xff\xff\xff"};
  const int accepted =
      count_accepted(sample_pickle(), tokens, 40'000,
                     [](const std::string& pickle) { lvggt::read_pickle(pickle, "mutation"); });
  CHECK(accepted > 0);
  CHECK(accepted < 20'000);
}

TEST_CASE("R1: 300 damaged checkpoints are read or refused, nothing else") {
  const TempDir dir;
  write_pth(dir / "good.pth", sample_pickle(),
            {{"0", std::string(16, '\1')}, {"1", std::string(16, '\2')}});
  const std::string bytes = lvggt::read_text_file(dir / "good.pth");
  const auto read = [&](const std::string& damaged) {
    lvggt::write_file(dir / "bad.pth", damaged);
    lvggt::PthFile file(dir / "bad.pth");
    for (const auto& tensor : file.tensors()) {
      std::vector<std::byte> values(static_cast<std::size_t>(tensor.num_bytes));
      file.read(tensor, values);
    }
  };
  read(bytes);
  const std::vector<std::string> tokens{"PK\1\2", "PK\3\4", "PK\5\6", std::string(4, '\xff'),
                                        std::string(8, '\0')};
  count_accepted(bytes, tokens, 300, read);
}
