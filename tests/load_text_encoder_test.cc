// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/load_text_encoder.h"

#include <doctest/doctest.h>

#include <filesystem>

#include "lvggt/io/npy.h"
#include "tests/support/bpe_files.h"
#include "tests/support/files.h"
#include "tests/support/golden.h"
#include "tests/support/paths.h"
#include "tests/support/safetensors_bytes.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

const std::string kFolder = test_data("golden/language/");

// A model in the published layout around the tiny weights: 320 tokens of its own.
void write_mistral(const std::string& folder, std::int64_t vocabulary) {
  const Safetensors file = Safetensors::open(kFolder + "weights_mistral_tiny_seed1.safetensors");
  SafetensorsWriter out(folder + "/model.safetensors");
  for (const TensorEntry& entry : file.entries()) {
    std::vector<float> values(static_cast<std::size_t>(entry.size()));
    file.read_into(entry.name, values);
    std::vector<std::int64_t> shape = entry.shape;
    if (entry.name.ends_with("embed_tokens.weight")) {
      shape[0] = vocabulary;
      values.resize(static_cast<std::size_t>(vocabulary * shape[1]), 0.25f);
    }
    out.add(entry.name, shape, values);
  }
  out.finish();
  write_file(folder + "/config.json", R"({"model_type": "mistral", "head_dim": 16})");
  std::filesystem::copy_file(kFolder + "sentence_piece.model", folder + "/tokenizer.model");
}

// CLIP's tiny weights, whose token embedding has 600 rows, as a published folder with a vocabulary
// of 514 + merges tokens.
void write_clip(const std::string& folder, int merges) {
  std::filesystem::copy_file(kFolder + "weights_clip_tiny_seed1.safetensors",
                             folder + "/open_clip_model.safetensors",
                             std::filesystem::copy_options::overwrite_existing);
  write_file(folder + "/open_clip_config.json", R"({"vision_cfg": {"width": 48, "head_width": 16},
      "text_cfg": {"heads": 4}})");
  BpeMerges pairs;
  for (int i = 0; i < merges; ++i)
    pairs.emplace_back(std::string(1, static_cast<char>('a' + i / 10)),
                       std::string(1, static_cast<char>('a' + i % 10)));
  write_file(folder + "/vocab.json", vocabulary_json(bpe_vocabulary(pairs)));
  write_file(folder + "/merges.txt", bpe_merges_text(pairs, "\n"));
}

}  // namespace

TEST_CASE("load_text_encoder: vectors, CLIP and Mistral are told apart by content") {
  const TempDir dir;
  Tensor<float, 2> rows(Shape{1, 3});
  rows(0, 1) = 2;
  write_npy(dir / "words.of.mine", rows);  // the name says nothing
  write_file(dir / "list.json", R"(["a cup"])");
  const auto vectors = load_text_encoder(dir / "words.of.mine", {.vocabulary = dir / "list.json"});
  CHECK(vectors->width() == 3);
  CHECK(vectors->describe().find("1 precomputed vectors of width 3") == 0);

  write_mistral(dir.path(), 320);
  const auto mistral = load_text_encoder(dir.path());
  CHECK(mistral->width() == 64);
  CHECK(mistral->describe().find("Mistral, 3 layers of width 64") == 0);

  const Outcome outcome =
      outcome_of([&] { load_text_encoder(test_data("golden/ops_tiny_seed1.safetensors")); });
  CHECK(outcome.kind == ErrorKind::kMismatch);
  CHECK(outcome.says("is no text encoder"));
}

TEST_CASE("MistralTextEncoder: the prompt changes a sentence's vector, its neighbours do not") {
  const TempDir dir;
  write_mistral(dir.path(), 320);
  Context ctx(2);
  const auto plain = load_text_encoder(dir.path(), {.prompt = ""});
  const auto asking = load_text_encoder(dir.path());
  const std::string sentences[] = {"the cup is upright", "a dog runs — ü"};
  const auto both = plain->encode(sentences, ctx);
  const auto alone = plain->encode(std::span(sentences).first(1), ctx);
  CHECK_SAME_BITS(both.view().narrow(0, 0, 1), alone);
  const auto asked = asking->encode(std::span(sentences).first(1), ctx);
  double cosine = 0;
  for (std::int64_t c = 0; c < 64; ++c) cosine += double{asked(0, c)} * alone(0, c);
  CHECK(cosine < 0.999);
  CHECK(plain->warnings(sentences).empty());
}

TEST_CASE("load_text_encoder: a vocabulary that is not the model's is refused with both sizes") {
  const TempDir dir;
  write_mistral(dir.path(), 321);
  const Outcome outcome = outcome_of([&] { load_text_encoder(dir.path()); });
  CHECK(outcome.kind == ErrorKind::kMismatch);
  CHECK(outcome.says("the vocabulary has 320 tokens, but embed_tokens of"));
  CHECK(outcome.says("has 321 rows"));
}

TEST_CASE("B26 load_text_encoder: a CLIP folder's vocabulary has to be that of its embedding") {
  const TempDir dir;
  write_clip(dir.path(), 86);
  CHECK(load_text_encoder(dir.path())->width() == 24);
  for (const int merges : {6, 85, 87}) {
    write_clip(dir.path(), merges);
    const Outcome outcome = outcome_of([&] { load_text_encoder(dir.path()); });
    CAPTURE(outcome.message);
    CHECK(outcome.kind == ErrorKind::kMismatch);
    CHECK(outcome.says(dir / "vocab.json"));
    CHECK(outcome.says(
        concat("the vocabulary has ", 514 + merges, " tokens, but token_embedding of")));
    CHECK(outcome.says(dir / "open_clip_model.safetensors"));
    CHECK(outcome.says("has 600 rows"));
  }
}

TEST_CASE("B26 load_text_encoder: a CLIP folder's merges cut short are refused with both numbers") {
  const TempDir dir;
  write_clip(dir.path(), 86);
  const std::string merges = read_bytes(dir / "merges.txt");
  write_file(dir / "merges.txt", merges.substr(0, merges.size() - 4 * 20));
  const Outcome outcome = outcome_of([&] { load_text_encoder(dir.path()); });
  CAPTURE(outcome.message);
  CHECK(outcome.kind == ErrorKind::kMismatch);
  CHECK(outcome.says(dir / "merges.txt"));
  CHECK(outcome.says("has 66 merges, but the vocabulary of 600 tokens needs 86"));
}

TEST_CASE("SentencePieceTokenizer: <s>, pieces, </s>; cut before the end, odd files refused") {
  const auto tokenizer = SentencePieceTokenizer::open(kFolder + "sentence_piece.model");
  const auto whole = tokenizer.encode("the cup is upright", 4096);
  CHECK(whole.ids == std::vector<std::int64_t>{1, 262, 278, 276, 298, 264, 269, 288, 299, 2});
  const auto cut = tokenizer.encode("the cup is upright", 5);
  CHECK(cut.ids == std::vector<std::int64_t>{1, 262, 278, 276, 2});
  CHECK(cut.full_length == 10);
  CHECK(outcome_of([&] { tokenizer.encode("\xff", 5); }).kind == ErrorKind::kFormat);

  const TempDir dir;
  CHECK(outcome_of([&] { SentencePieceTokenizer::open(dir.path()); }).kind == ErrorKind::kRead);
  write_file(dir / "tokenizer.model", "<html>404</html>");
  const Outcome outcome = outcome_of([&] { SentencePieceTokenizer::open(dir.path()); });
  CHECK(outcome.kind == ErrorKind::kFormat);
  CHECK(outcome.says("is no SentencePiece model"));
}

TEST_CASE("D06 text encoders: empty, blank, over-long and non-UTF-8 phrases") {
  const TempDir dir;
  write_mistral(dir.path(), 320);
  Context ctx(1);
  const auto encoder = load_text_encoder(dir.path());
  const auto encode = [&](const std::string& phrase) {
    return outcome_of([&] { encoder->encode({&phrase, 1}, ctx); });
  };
  CHECK(encode("").says("is empty"));
  CHECK(encode("  \n").kind == ErrorKind::kMismatch);
  CHECK(encode(std::string(4097, 'a')).kind == ErrorKind::kLimit);
  CHECK(encode("a \xc3 b").kind == ErrorKind::kFormat);
  CHECK(encode("😀 שלום").accepted);
  CHECK(encode("<script>alert(1)</script>").accepted);
  CHECK(encode(std::string(4096, 'a')).accepted);
}
