// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/token_cache.h"

#include <doctest/doctest.h>

#include <filesystem>

#include "lvggt/io/safetensors.h"
#include "tests/support/files.h"
#include "tests/support/safetensors_bytes.h"
#include "tests/support/tiny_scene.h"

using namespace lvggt;
namespace fs = std::filesystem;

namespace {

struct Taps {
  explicit Taps(const TokenManifest& m) {
    for (std::size_t i = 0; i < 4; ++i) {
      tensors[i] = Tensor<float, 2>(Shape{m.h() * m.w(), m.channels()});
      views[i] = tensors[i];
    }
  }
  std::array<Tensor<float, 2>, 4> tensors;
  std::array<View<float, 2>, 4> views;
};

// The manifest with one piece of its text replaced.
test::Outcome open_changed(const test::TinyScene& tiny, const std::string& from,
                           const std::string& to) {
  const std::string path = tiny.tokens() + "/manifest.json";
  const std::string text = test::read_bytes(path);
  const std::size_t at = text.find(from);
  REQUIRE(at != std::string::npos);
  test::write_bytes(path, text.substr(0, at) + to + text.substr(at + from.size()));
  const auto outcome = test::outcome_of([&] { TokenCache::open(tiny.tokens()); });
  test::write_bytes(path, text);
  return outcome;
}

}  // namespace

TEST_CASE("token_cache: what was written is read back, in float32 and in bfloat16") {
  for (const Dtype storage : {Dtype::kF32, Dtype::kBF16}) {
    test::TinyScene tiny(2);
    const TokenManifest manifest = tiny.make_tokens(storage);
    const TokenCache cache = TokenCache::open(tiny.tokens());
    CHECK(to_json(cache.manifest()) == to_json(manifest));
    CHECK(cache.manifest().h() == 2);
    CHECK(cache.manifest().w() == 3);
    CHECK(cache.manifest().channels() == 128);
    Taps taps(manifest);
    cache.check("000002");
    cache.read(taps.views, "000002");
    for (std::size_t t = 0; t < 4; ++t)
      for (std::int64_t k = 0; k < taps.tensors[t].size(); ++k)
        REQUIRE(taps.tensors[t].data()[k] == test::TinyScene::token(1, static_cast<int>(t), k));
  }
}

TEST_CASE("token_cache: a frame or a manifest that is not there is said") {
  test::TinyScene tiny(2);
  CHECK(test::outcome_of([&] { TokenCache::open(tiny.tokens()); }).says("make_tokens"));
  TokenManifest manifest = tiny.make_tokens();
  CHECK(test::outcome_of([&] {
          TokenCache::open(tiny.tokens()).check("000003");
        }).says("other frames"));
  manifest.frames.pop_back();
  manifest.complete = false;
  write_file(tiny.tokens() + "/manifest.json", to_json(manifest));
  CHECK(
      test::outcome_of([&] { TokenCache::open(tiny.tokens()).check("000002"); }).says("--resume"));
  fs::remove(tiny.tokens() + "/000001.safetensors");
  const auto gone = test::outcome_of([&] { TokenCache::open(tiny.tokens()).check("000001"); });
  CHECK(gone.kind == ErrorKind::kRead);
  CHECK(gone.says("000001.safetensors"));
}

TEST_CASE("B22: token files of another run, shape or type are refused, naming the file") {
  test::TinyScene tiny(2), other(2);
  tiny.make_tokens();
  const auto check_frame = [&] {
    return test::outcome_of([&] { TokenCache::open(tiny.tokens()).check("000002"); });
  };
  // The same frame in a stream with another first picture.
  test::TinyScene::add_picture(other.images() + "/000001.png", 28, 42, 99);
  other.make_tokens();
  fs::copy_file(other.tokens() + "/000002.safetensors", tiny.tokens() + "/000002.safetensors",
                fs::copy_options::overwrite_existing);
  auto outcome = check_frame();
  CHECK(outcome.kind == ErrorKind::kMismatch);
  CHECK(outcome.says("000002.safetensors"));
  CHECK(outcome.says("another run"));
  // No tokens at all.
  SafetensorsWriter foreign(tiny.tokens() + "/000002.safetensors");
  foreign.add("x", {1}, std::vector<float>{1});
  foreign.finish();
  CHECK(check_frame().says("no tokens that make_tokens wrote"));
  // Another type than the manifest says.
  const TokenManifest manifest = tiny.make_tokens(Dtype::kF32);
  Taps taps(manifest);
  std::array<View<const float, 2>, 4> values;
  for (std::size_t i = 0; i < 4; ++i) values[i] = taps.views[i];
  write_tokens(tiny.tokens(), manifest.frames[1], values, Dtype::kBF16);
  CHECK(check_frame().says("BF16"));
  for (std::size_t i = 0; i < 4; ++i) values[i] = taps.views[i].narrow(0, 0, 5);
  write_tokens(tiny.tokens(), manifest.frames[1], values, Dtype::kF32);
  CHECK(check_frame().says("[5,128]"));
}

TEST_CASE("B22: differences in weights, sizes, window and storage are named") {
  TokenSettings a;
  a.config = encoder_config({});
  a.encoder_sha256 = "one";
  CHECK(token_difference(a, a).empty());
  TokenSettings b = a;
  b.encoder_sha256 = "two";
  b.config.embed_dim = 192;
  b.preprocess.size = 168;
  b.preprocess.mode = FrameMode::kPad;
  b.max_past_frames = 8;
  b.cache_storage = Storage::kI8;
  b.storage = Dtype::kF32;
  const std::string text = token_difference(a, b);
  for (const char* part :
       {"encoder_sha256 is one, not two", "embed_dim is 1024, not 192", "size is 518, not 168",
        "mode is crop, not pad", "max_past_frames is 128, not 8", "cache_storage is f32, not int8",
        "storage is BF16, not F32"})
    CHECK(text.find(part) != std::string::npos);
  // What is not the encoder's does not count.
  ModelConfig decoder;
  decoder.lang_dim = 6;
  decoder.sbd_hidden_dim = 8;
  CHECK(encoder_config(decoder) == encoder_config({}));
}

TEST_CASE("B23: token files that are cut short or hold NaN are refused when read") {
  test::TinyScene tiny(1);
  const TokenManifest manifest = tiny.make_tokens();
  const TokenCache cache = TokenCache::open(tiny.tokens());
  Taps taps(manifest);
  const std::string path = tiny.tokens() + "/000001.safetensors";
  const std::string whole = test::read_bytes(path);
  for (const std::size_t size :
       {whole.size() - 1, whole.size() / 2, std::size_t{20}, std::size_t{0}}) {
    test::write_bytes(path, whole.substr(0, size));
    const auto outcome = test::outcome_of([&] { cache.read(taps.views, "000001"); });
    CHECK(outcome.kind == ErrorKind::kFormat);
    CHECK(outcome.says(path));
    CHECK_FALSE(has_tokens(tiny.tokens(), manifest.frames[0], manifest));
  }
  test::write_bytes(path, whole);
  CHECK(has_tokens(tiny.tokens(), manifest.frames[0], manifest));
  taps.tensors[2](1, 3) = std::nanf("");
  std::array<View<const float, 2>, 4> values;
  for (std::size_t i = 0; i < 4; ++i) values[i] = taps.views[i];
  write_tokens(tiny.tokens(), manifest.frames[0], values, Dtype::kF32);
  const auto outcome = test::outcome_of([&] { cache.read(taps.views, "000001"); });
  CHECK(outcome.kind == ErrorKind::kNumeric);
  CHECK(outcome.says("tap.2"));
}

TEST_CASE("token_cache: a manifest that was changed or damaged is refused by key") {
  test::TinyScene tiny(2);
  tiny.make_tokens();
  CHECK(open_changed(tiny, "\"format_version\": 1", "\"format_version\": 2").kind ==
        ErrorKind::kUnsupported);
  CHECK(open_changed(tiny, "\"size\": \"518\"", "\"size\": \"504\"").says("were changed"));
  CHECK(open_changed(tiny, "\"size\": \"518\"", "\"size\": \"x\"").says("size"));
  CHECK(open_changed(tiny, "\"size\": \"518\"", "\"size\": \"-14\"").says("size is -14"));
  CHECK(open_changed(tiny, "\"mode\"", "\"mood\"").says("mode"));
  CHECK(open_changed(tiny, "\"000002\"", "\"../../x\"").says("name"));
  CHECK(open_changed(tiny, "\"000002\"", "\"000001\"").says("twice"));
  CHECK(open_changed(tiny, "\"frames\": [", "\"frames\": 3, \"x\": [").says("frames"));
  CHECK(open_changed(tiny, "\"embed_dim\": 64", "\"embed_dim\": 32").says("were changed"));
  CHECK(open_changed(tiny, "\"model_width\": 42", "\"model_width\": 43").says("whole patches"));
  CHECK(open_changed(tiny, "{", "").kind == ErrorKind::kFormat);
}

TEST_CASE("token_cache: the encoder's hash does not depend on the decoder or the file's layout") {
  const test::TempDir dir;
  const ModelConfig config = test::tiny_config();
  Context ctx(2);
  const auto hash = [&](const std::vector<TensorSpec>& specs, const test::ChangeWeight& change) {
    const std::string path = dir / "model.safetensors";
    test::write_tensors(path, specs, &config, change);
    LoadOptions options;
    options.weights = path;
    return encoder_sha256(Checkpoint(options), ctx);
  };
  std::vector<TensorSpec> specs = test::all_tensors(config);
  const std::string first = hash(specs, {});
  CHECK(first.size() == 64);
  std::reverse(specs.begin(), specs.end());
  CHECK(hash(specs, [](test::WeightTensor& t) {
          if (!t.name.starts_with("aggregator.")) t.values[0] += 1;
        }) == first);
  CHECK(hash(test::all_tensors(config), [](test::WeightTensor& t) {
          if (t.name == "aggregator.global_blocks.1.mlp.fc2.bias") t.values[3] += 1e-6f;
        }) != first);
}
