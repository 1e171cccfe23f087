// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/clip.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cmath>
#include <functional>
#include <limits>

#include "lvggt/io/json.h"
#include "tests/support/golden.h"
#include "tests/support/paths.h"
#include "tests/support/random.h"
#include "tests/support/safetensors_bytes.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

const std::string kFolder = test_data("golden/language/");
const std::string kWeights = kFolder + "weights_clip_tiny_seed1.safetensors";
const ClipConfig kConfig{3, 4, false, "", {}};  // heads of the tiny model's towers

Tensor<float, 2> text_embeddings(const ClipText& clip, View<const std::int64_t, 2> tokens,
                                 Context& ctx) {
  Tensor<float, 2> embeddings(Shape{tokens.extent(0), clip.width()});
  clip_text_forward(embeddings, tokens, clip, nullptr, ctx);
  return embeddings;
}

Tensor<float, 2> image_embeddings(const ClipImage& clip, View<const float, 4> pixels,
                                  Context& ctx) {
  Tensor<float, 2> embeddings(Shape{pixels.extent(0), clip.width()});
  clip_image_forward(embeddings, pixels, clip, nullptr, ctx);
  return embeddings;
}

// n phrases of 16 ids: start, words, end at various places, zeros.
Tensor<std::int64_t, 2> phrases(std::int64_t n) {
  Tensor<std::int64_t, 2> tokens(Shape{n, std::int64_t{16}});
  for (std::int64_t i = 0; i < n; ++i) {
    const std::int64_t end = 1 + i * 5 % 15;
    tokens(i, 0) = 598;
    for (std::int64_t p = 1; p < end; ++p) tokens(i, p) = (31 * i + 7 * p) % 598;
    tokens(i, end) = 599;
  }
  return tokens;
}

// The weights under other names or shapes: edit(name, values, shape) returns the tensors to write.
using Tensors = std::map<std::string, std::pair<std::vector<std::int64_t>, std::vector<float>>>;
void rewrite(const std::string& path, const std::function<void(Tensors&)>& edit) {
  const Safetensors file = Safetensors::open(kWeights);
  Tensors tensors;
  for (const TensorEntry& entry : file.entries()) {
    std::vector<float> values(static_cast<std::size_t>(entry.size()));
    file.read_into(entry.name, values);
    tensors[entry.name] = {entry.shape, std::move(values)};
  }
  edit(tensors);
  SafetensorsWriter out(path);
  for (const auto& [name, tensor] : tensors) out.add(name, tensor.first, tensor.second);
  out.finish();
}

// To Hugging Face's names by the table that came with the reference values.
void to_hugging_face(Tensors& tensors) {
  const Json json = Json::read(kFolder + "clip_config_tiny_seed1.json");
  Tensors renamed;
  for (const Json& row : json.find("names")->as_array("names")) {
    const auto& [shape, values] = tensors.at(row.find("open_clip")->as_string("open_clip"));
    const std::string& how = row.find("how")->as_string("how");
    auto& target = renamed[row.find("huggingface")->as_string("huggingface")];
    target = {shape, values};
    if (how == "transpose") {
      target.first = {shape[1], shape[0]};
      for (std::int64_t r = 0; r < shape[1]; ++r)
        for (std::int64_t c = 0; c < shape[0]; ++c)
          target.second[static_cast<std::size_t>(r * shape[0] + c)] =
              values[static_cast<std::size_t>(c * shape[1] + r)];
    } else if (how.starts_with("rows ")) {  // "rows k of 3" of the joint projection
      const std::size_t third = values.size() / 3, k = static_cast<std::size_t>(how[5] - '0');
      target.first[0] /= 3;
      target.second.assign(values.begin() + static_cast<std::ptrdiff_t>(k * third),
                           values.begin() + static_cast<std::ptrdiff_t>((k + 1) * third));
    }
  }
  tensors = std::move(renamed);
}

}  // namespace

TEST_CASE("clip: OpenCLIP's and Hugging Face's names give the same bits") {
  const TempDir dir;
  rewrite(dir / "hf.safetensors", to_hugging_face);
  Context ctx(2);
  const auto tokens = phrases(5);
  const auto pixels = random_tensor(Shape{2, 32, 32, 3}, 1, -2, 2);
  const Safetensors own = Safetensors::open(kWeights);
  const Safetensors other = Safetensors::open(dir / "hf.safetensors");
  for (const bool quick : {false, true}) {
    ClipConfig config = kConfig;
    config.quick_gelu = quick;
    CHECK_SAME_BITS(text_embeddings(load_clip_text(own, config), tokens, ctx),
                    text_embeddings(load_clip_text(other, config), tokens, ctx));
    CHECK_SAME_BITS(image_embeddings(load_clip_image(own, config), pixels, ctx),
                    image_embeddings(load_clip_image(other, config), pixels, ctx));
  }
}

TEST_CASE("clip: a phrase's or picture's bits depend neither on the batch nor on threads") {
  Context one(1), many(8);
  const Safetensors file = Safetensors::open(kWeights);
  const ClipText text = load_clip_text(file, kConfig);
  const auto tokens = phrases(300);  // several batches
  const auto all = text_embeddings(text, tokens, many);
  for (const std::int64_t i : {0, 1, 150, 299})
    CHECK_SAME_BITS(all.view().narrow(0, i, i + 1),
                    text_embeddings(text, tokens.view().narrow(0, i, i + 1), one));
  const ClipImage image = load_clip_image(file, kConfig);
  const auto pixels = random_tensor(Shape{3, 32, 32, 3}, 1, -2, 2);
  CHECK_SAME_BITS(image_embeddings(image, pixels, many).view().narrow(0, 2, 3),
                  image_embeddings(image, pixels.view().narrow(0, 2, 3), one));
}

TEST_CASE("clip: rows have length 1, and none of no phrases at all") {
  Context ctx(1);
  const ClipText text = load_clip_text(Safetensors::open(kWeights), kConfig);
  const auto rows = text_embeddings(text, phrases(4), ctx);
  for (std::int64_t i = 0; i < 4; ++i) {
    double squares = 0;
    for (std::int64_t c = 0; c < 24; ++c) squares += double{rows(i, c)} * rows(i, c);
    CHECK(std::abs(squares - 1) < 1e-6);
  }
  CHECK(text_embeddings(text, phrases(0), ctx).extent(0) == 0);
}

TEST_CASE("clip: tokens outside of the vocabulary or the context are refused") {
  Context ctx(1);
  const ClipText text = load_clip_text(Safetensors::open(kWeights), kConfig);
  auto tokens = phrases(1);
  tokens(0, 3) = 600;
  CHECK(outcome_of([&] {
          text_embeddings(text, tokens, ctx);
        }).says("token 600 is not below the 600 rows of token_embedding"));
  const Tensor<std::int64_t, 2> wide(Shape{1, 17});
  CHECK(outcome_of([&] { text_embeddings(text, wide, ctx); }).says("the context length is 16"));
}

TEST_CASE("clip: all missing tensors are named, and one of another shape with both shapes") {
  const TempDir dir;
  const std::string path = dir / "clip.safetensors";
  const auto load = [&](const std::function<void(Tensors&)>& edit) {
    rewrite(path, edit);
    return outcome_of([&] { load_clip_text(Safetensors::open(path), kConfig); });
  };
  Outcome outcome = load([](Tensors& tensors) {
    tensors.erase("ln_final.bias");
    tensors.erase("transformer.resblocks.1.mlp.c_fc.weight");
  });
  CHECK(outcome.kind == ErrorKind::kMismatch);
  CHECK(outcome.says("2 tensors of CLIP's text tower are missing"));
  CHECK(outcome.says("transformer.resblocks.1.mlp.c_fc.weight, ln_final.bias"));

  outcome = load([](Tensors& tensors) {
    tensors["transformer.resblocks.0.mlp.c_proj.weight"].first = {128, 32};
  });
  CHECK(outcome.says("is [128,32], expected [32,128]; it looks transposed"));

  outcome = load([](Tensors& tensors) {
    tensors["text_projection"].second[5] = std::numeric_limits<float>::quiet_NaN();
  });
  CHECK(outcome.kind == ErrorKind::kFormat);
  CHECK(outcome.says("text_projection of CLIP's text tower holds nan at element 5"));
}

TEST_CASE("clip: half-precision weights stay narrow and give nearly the same") {
  const TempDir dir;
  const Safetensors file = Safetensors::open(kWeights);
  SafetensorsWriter out(dir / "half.safetensors");
  for (const TensorEntry& entry : file.entries()) out.declare(entry.name, Dtype::kF16, entry.shape);
  for (const TensorEntry& entry : file.entries()) {
    std::vector<float> values(static_cast<std::size_t>(entry.size()));
    file.read_into(entry.name, values);
    out.write(entry.name, std::span<const float>(values));
  }
  out.finish();
  Context ctx(1);
  const ClipText half = load_clip_text(Safetensors::open(dir / "half.safetensors"), kConfig);
  CHECK(half.transformer.resblocks[0].mlp.fc1.weight.storage == Storage::kF16);
  const auto tokens = phrases(3);
  CHECK_CLOSE(text_embeddings(half, tokens, ctx),
              text_embeddings(load_clip_text(file, kConfig), tokens, ctx), 5e-3);
}

TEST_CASE("clip_config: heads and activation from both published forms") {
  const auto parse = [](const char* text) {
    return parse_clip_config(Json::parse(text, "config.json"), "config.json");
  };
  ClipConfig config = parse(R"({"model_cfg": {"embed_dim": 1024, "vision_cfg": {"width": 1280,
      "head_width": 80}, "text_cfg": {"heads": 16}}})");
  CHECK(config.image_heads == 16);
  CHECK(config.text_heads == 16);
  CHECK(config.quick_gelu == false);
  config = parse(R"({"quick_gelu": true, "vision_cfg": {"width": 768}, "text_cfg": {}})");
  CHECK(config.image_heads == 12);
  CHECK(config.text_heads == 0);
  CHECK(config.quick_gelu == true);
  config = parse(R"({"model_type": "clip", "text_config": {"hidden_act": "gelu",
      "num_attention_heads": 8}, "vision_config": {"hidden_act": "gelu",
      "num_attention_heads": 12}})");
  CHECK(config.image_heads == 12);
  CHECK(config.text_heads == 8);
  CHECK(config.quick_gelu == false);
  CHECK(parse(R"({"model_type": "clip"})").quick_gelu == true);

  CHECK(outcome_of([&] { parse(R"({"model_type": "bert"})"); }).says("model_type is \"bert\""));
  CHECK(outcome_of([&] { parse(R"({"text_cfg": {"heads": 0}})"); }).kind == ErrorKind::kFormat);
  CHECK(outcome_of([&] {
          parse(R"({"model_type": "clip", "text_config": {"hidden_act": "relu"}})");
        }).kind == ErrorKind::kUnsupported);
}

TEST_CASE("clip_heads: 64 wide, except for the published towers with wider heads") {
  CHECK(clip_heads(512) == 8);
  CHECK(clip_heads(768) == 12);
  CHECK(clip_heads(1024) == 16);
  CHECK(clip_heads(1280) == 16);
  CHECK(clip_heads(1664) == 16);
}

TEST_CASE("find_clip_config: without a configuration the assumption is said") {
  const TempDir dir;
  const ClipConfig config = find_clip_config(dir / "model.safetensors");
  REQUIRE(config.notes.size() == 1);
  CHECK(config.notes[0].find("GELU (erf) is assumed") != std::string::npos);
  CHECK(!config.quick_gelu.has_value());
}
