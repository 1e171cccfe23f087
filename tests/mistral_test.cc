// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/mistral.h"

#include <doctest/doctest.h>

#include <utility>

#include "tests/support/files.h"
#include "tests/support/golden.h"
#include "tests/support/paths.h"
#include "tests/support/safetensors_bytes.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

const std::string kFolder = test_data("golden/language/");
const std::string kWeights = kFolder + "weights_mistral_tiny_seed1.safetensors";
const MistralConfig kConfig{16, 1e-5f, 10000, ""};

const std::vector<std::vector<std::int64_t>> kSequences = {
    {1, 17, 80, 2}, {1, 5, 2}, {1, 199, 3, 44, 120, 9, 2}};

Tensor<float, 2> embeddings(const Mistral& model, Context& ctx) {
  Tensor<float, 2> rows(Shape{static_cast<std::int64_t>(kSequences.size()), model.width()});
  model.forward(rows, kSequences, nullptr, ctx);
  return rows;
}

// The tensors that `wanted` picks, as `dtype`, under names without "model.".
void write_part(const std::string& path, Dtype dtype, bool (*wanted)(const std::string&),
                const std::string& prefix) {
  const Safetensors file = Safetensors::open(kWeights);
  SafetensorsWriter out(path);
  const auto each = [&](auto&& body) {
    for (const TensorEntry& entry : file.entries())
      if (wanted(entry.name)) body(entry, prefix + entry.name.substr(6));
  };
  each([&](const TensorEntry& entry, const std::string& name) {
    out.declare(name, dtype, entry.shape);
  });
  each([&](const TensorEntry& entry, const std::string& name) {
    std::vector<float> values(static_cast<std::size_t>(entry.size()));
    file.read_into(entry.name, values);
    out.write(name, std::span<const float>(values));
  });
  out.finish();
}

bool all(const std::string&) { return true; }
bool first_layer(const std::string& name) { return name.find("layers.0.") != std::string::npos; }
bool other_layers(const std::string& name) { return !first_layer(name); }

}  // namespace

TEST_CASE("mistral: a sequence's bits depend neither on the others nor on threads") {
  Context one(1), many(8);
  const Mistral model = Mistral::open(Safetensors::open(kWeights), kConfig);
  const auto together = embeddings(model, many);
  Tensor<float, 2> alone(Shape{std::int64_t{1}, model.width()});
  for (std::size_t i = 0; i < kSequences.size(); ++i) {
    model.forward(alone, std::span(kSequences).subspan(i, 1), nullptr, one);
    const auto row = static_cast<std::int64_t>(i);
    CHECK_SAME_BITS(alone, together.view().narrow(0, row, row + 1));
  }
}

TEST_CASE("mistral: bf16 shards behind an index, without \"model.\", are used where they are") {
  const TempDir dir;
  write_part(dir / "model-00001-of-00002.safetensors", Dtype::kBF16, first_layer, "");
  write_part(dir / "model-00002-of-00002.safetensors", Dtype::kBF16, other_layers, "");
  std::string map;
  const Safetensors whole = Safetensors::open(kWeights);
  for (const TensorEntry& entry : whole.entries())
    map += (map.empty() ? "\"" : ", \"") + entry.name.substr(6) + "\": \"model-0000" +
           (first_layer(entry.name) ? "1" : "2") + "-of-00002.safetensors\"";
  write_file(dir / "model.safetensors.index.json", "{\"weight_map\": {" + map + "}}");
  write_file(dir / "config.json", R"({"model_type": "mistral", "head_dim": 16})");
  Context ctx(2);
  const Mistral sharded = Mistral::open(dir.path());
  write_part(dir / "rounded.safetensors", Dtype::kBF16, all, "model.");
  const Mistral single = Mistral::open(dir / "rounded.safetensors");
  CHECK(sharded.num_bytes() == single.num_bytes());
  CHECK_SAME_BITS(embeddings(sharded, ctx), embeddings(single, ctx));
  CHECK_CLOSE(embeddings(sharded, ctx), embeddings(Mistral::open(whole, kConfig), ctx), 5e-2);
}

TEST_CASE("A47 mistral: matrices at odd addresses are used too") {
  const TempDir dir;
  write_part(dir / "even.safetensors", Dtype::kBF16, all, "model.");
  // The same file with a header one byte longer: everything moves to odd addresses.
  std::string bytes = read_bytes(dir / "even.safetensors");
  std::uint64_t length;
  std::memcpy(&length, bytes.data(), sizeof length);
  bytes.insert(sizeof length + length, length % 2 == 0 ? " " : "  ");
  length += length % 2 == 0 ? 1 : 2;
  std::memcpy(bytes.data(), &length, sizeof length);
  write_bytes(dir / "odd.safetensors", bytes);
  Context ctx(1);
  CHECK_SAME_BITS(
      embeddings(Mistral::open(Safetensors::open(dir / "odd.safetensors"), kConfig), ctx),
      embeddings(Mistral::open(Safetensors::open(dir / "even.safetensors"), kConfig), ctx));
}

TEST_CASE("mistral: missing tensors, another head size and foreign tokens are refused") {
  const TempDir dir;
  write_part(dir / "part.safetensors", Dtype::kF32, other_layers, "model.");
  Outcome outcome =
      outcome_of([&] { Mistral::open(Safetensors::open(dir / "part.safetensors"), kConfig); });
  CHECK(outcome.kind == ErrorKind::kMismatch);
  CHECK(outcome.says("9 tensors of the Mistral model are missing"));

  outcome = outcome_of([&] { Mistral::open(kWeights); });  // heads of 128 without a configuration
  CHECK(outcome.says("which are not whole heads of 128; a config.json beside the weights"));

  Context ctx(1);
  const Mistral model = Mistral::open(Safetensors::open(kWeights), kConfig);
  Tensor<float, 2> row(Shape{std::int64_t{1}, model.width()});
  const std::vector<std::vector<std::int64_t>> foreign = {{1, 200, 2}}, empty = {{}};
  CHECK(outcome_of([&] {
          model.forward(row, foreign, nullptr, ctx);
        }).says("token 200 is not below the 200 rows of embed_tokens"));
  CHECK(outcome_of([&] { model.forward(row, empty, nullptr, ctx); }).says("has no tokens"));
}

TEST_CASE("parse_mistral_config: other models and activations are refused") {
  const auto parse = [](const char* text) {
    return parse_mistral_config(Json::parse(text, "config.json"), "config.json");
  };
  const MistralConfig config =
      parse(R"({"model_type": "mistral", "hidden_size": 64, "num_attention_heads": 4})");
  CHECK(config.head_dim == 16);
  CHECK(outcome_of([&] { parse(R"({"model_type": "llama"})"); }).kind == ErrorKind::kMismatch);
  CHECK(outcome_of([&] { parse(R"({"model_type": "mistral", "hidden_act": "gelu"})"); }).kind ==
        ErrorKind::kUnsupported);
  CHECK(outcome_of([&] { parse(R"({"model_type": "mistral", "rope_theta": -1})"); }).kind ==
        ErrorKind::kFormat);
}
