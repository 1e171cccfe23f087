// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/embeddings.h"

#include <doctest/doctest.h>

#include <limits>

#include "lvggt/io/npy.h"
#include "tests/support/safetensors_bytes.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

// words.npy and words.json in a folder of their own.
struct Lists {
  TempDir dir;
  std::string npy = dir / "words.npy", json = dir / "words.json";
  Lists() {
    Tensor<float, 2> rows(Shape{2, 3});
    rows(0, 0) = 3;
    rows(0, 1) = 4;
    rows(1, 2) = -2;
    write_npy(npy, rows);
    write_file(json, R"(["a cup", "a hand"])");
  }
  Outcome open() const {
    return outcome_of([&] { PrecomputedEmbeddings::open(npy); });
  }
};

}  // namespace

TEST_CASE("PrecomputedEmbeddings: gives the rows of the phrases, of length 1, in their order") {
  const Lists lists;
  Context ctx(1);
  const auto encoder = PrecomputedEmbeddings::open(lists.npy);
  CHECK(encoder.width() == 3);
  const std::string phrases[] = {"a hand", "a cup", "a hand"};
  const auto rows = encoder.encode(phrases, ctx);
  CHECK(rows(0, 2) == -1.0f);
  CHECK(rows(1, 0) == 0.6f);
  CHECK(rows(1, 1) == 0.8f);
  CHECK(rows(2, 2) == -1.0f);
  CHECK(encoder.warnings(phrases).empty());
}

TEST_CASE("PrecomputedEmbeddings: an unknown phrase is an error that names it and the list") {
  const Lists lists;
  Context ctx(1);
  const auto encoder = PrecomputedEmbeddings::open(lists.npy);
  const std::string unknown[] = {"a dog"}, empty[] = {" \t"};
  Outcome outcome = outcome_of([&] { encoder.encode(unknown, ctx); });
  CHECK(outcome.kind == ErrorKind::kMismatch);
  CHECK(outcome.says("\"a dog\" is not in the list of " + lists.npy));
  CHECK(outcome.says("\"a cup\", \"a hand\""));
  outcome = outcome_of([&] { encoder.encode(empty, ctx); });
  CHECK(outcome.kind == ErrorKind::kMismatch);
  CHECK(outcome.says("is empty"));
  const std::string long_text[] = {std::string(4097, 'a')};
  CHECK(outcome_of([&] { encoder.encode(long_text, ctx); }).kind == ErrorKind::kLimit);
}

TEST_CASE("PrecomputedEmbeddings: lists that do not fit are refused") {
  const Lists lists;
  write_file(lists.json, R"(["a cup"])");
  CHECK(lists.open().says("has 2 vectors, but " + lists.json + " has 1 phrases"));
  write_file(lists.json, R"(["a cup", "a cup"])");
  CHECK(lists.open().says("\"a cup\" is there twice"));
  write_file(lists.json, R"(["a cup", 7])");
  CHECK(lists.open().kind == ErrorKind::kFormat);
  write_file(lists.json, R"({"a cup": 1})");
  CHECK(lists.open().kind == ErrorKind::kFormat);
}

TEST_CASE("PrecomputedEmbeddings: a vector without length or with NaN is refused by its phrase") {
  const Lists lists;
  Tensor<float, 2> rows(Shape{2, 3});
  rows(0, 0) = 1;
  write_npy(lists.npy, rows);
  Outcome outcome = lists.open();
  CHECK(outcome.kind == ErrorKind::kNumeric);
  CHECK(outcome.says("\"a hand\" is all zeros"));
  rows(1, 1) = std::numeric_limits<float>::quiet_NaN();
  write_npy(lists.npy, rows);
  CHECK(lists.open().says("\"a hand\" holds NaN or infinity"));
}
