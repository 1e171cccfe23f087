// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/checkpoint.h"

#include <doctest/doctest.h>

#include <cmath>
#include <functional>

#include "lvggt/core/error.h"
#include "lvggt/model/deterministic_weights.h"
#include "tests/support/files.h"
#include "tests/support/tiny_model.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

struct Files {
  TempDir dir;
  LoadOptions options;

  // Geometry and decoder in one file, without metadata, so that the configuration is inferred.
  explicit Files(const ChangeWeight& change = {}) {
    options.weights = dir / "model.safetensors";
    write_tensors(options.weights, all_tensors(tiny_config()), nullptr, change);
  }
  void use_config(const ModelConfig& config) {
    options.config = dir / "config.json";
    write_bytes(options.config, to_json(config));
  }
  std::string refusal(ErrorKind kind = ErrorKind::kMismatch) const {
    try {
      read_all();
    } catch (const Error& e) {
      CHECK(e.kind() == kind);
      return e.what();
    }
    FAIL("accepted");
    return {};
  }
  std::vector<std::string> read_all() const {
    const Checkpoint checkpoint(options);
    for (const TensorSpec& spec : all_tensors(checkpoint.config()))
      if (!known_unused_tensor(spec.name)) checkpoint.read_as(spec.name, Shape{spec.volume()});
    return checkpoint.warnings();
  }
};

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

ChangeWeight change_of(const std::string& name, const std::function<void(WeightTensor&)>& change) {
  return [=](WeightTensor& tensor) {
    if (tensor.name == name) change(tensor);
  };
}

void drop(WeightTensor& tensor) { tensor.keep = false; }

}  // namespace

TEST_CASE("Checkpoint: names and shapes tell the whole configuration of the reference model") {
  const Files files;
  const Checkpoint checkpoint(files.options);
  CHECK(config_difference(checkpoint.config(), tiny_config()) == "");
  CHECK(checkpoint.has_decoder());
  CHECK(checkpoint.has_point_head());
  CHECK(checkpoint.warnings().empty());
}

TEST_CASE("Checkpoint: shapes tell the ablations of the decoder") {
  ModelConfig config = tiny_config();
  SUBCASE("MLP heads") { config.sbd_head = DecoderHead::kMlp; }
  SUBCASE("no DPT") { config.sbd_dpt = false; }
  SUBCASE("no RGB head, one level, six channels") {
    config.sbd_rgb = false;
    config.sbd_levels = 1;
    config.lang_dim = 6;
  }
  const TempDir dir;
  LoadOptions options;
  options.weights = dir / "geometry.safetensors";
  options.decoder = dir / "decoder.safetensors";
  write_tensors(options.weights, geometry_tensors(config), nullptr);
  write_tensors(options.decoder, decoder_tensors(config), nullptr);
  ModelConfig inferred = Checkpoint(options).config();
  if (!config.sbd_dpt) inferred.sbd_out_channels = config.sbd_out_channels;
  CHECK(config_difference(inferred, config) == "");
}

TEST_CASE("Checkpoint: the metadata's configuration comes before what shapes tell") {
  ModelConfig config = tiny_config();
  config.dpt_ln_eps = 1e-3;
  const TempDir dir;
  LoadOptions options;
  options.weights = dir / "model.safetensors";
  write_tensors(options.weights, all_tensors(config), &config);
  CHECK(Checkpoint(options).config().dpt_ln_eps == 1e-3);
}

TEST_CASE("A51: all missing tensors are listed, not only the first") {
  const Files files([](WeightTensor& t) {
    if (t.name == "aggregator.camera_token" || t.name == "depth_head.norm.bias" ||
        t.name == "lang_encoder.pool2.weight")
      t.keep = false;
  });
  const std::string message = files.refusal();
  CHECK(contains(message, "3 tensors are missing"));
  CHECK(contains(message, "aggregator.camera_token"));
  CHECK(contains(message, "depth_head.norm.bias"));
  CHECK(contains(message, "lang_encoder.pool2.weight"));
}

TEST_CASE(
    "A51: tensors that are known to be unused may be missing, and so may the whole point head") {
  const Files files([](WeightTensor& t) {
    t.keep = t.name != "aggregator.patch_embed.mask_token" && !t.name.starts_with("point_head.");
  });
  const Checkpoint checkpoint(files.options);
  CHECK_FALSE(checkpoint.has_point_head());
  CHECK(checkpoint.warnings().empty());
}

TEST_CASE("A51: half a point head is an error") {
  const Files files(change_of("point_head.norm.weight", drop));
  CHECK(contains(files.refusal(), "point_head.norm.weight"));
}

TEST_CASE("A52: extra tensors are listed in a warning, and refused when strict") {
  Files files(change_of("aggregator.patch_embed.mask_token",
                        [](WeightTensor& t) { t.name = "aggregator.surprise"; }));
  const std::vector<std::string> warnings = files.read_all();
  REQUIRE(warnings.size() == 1);
  CHECK(contains(warnings[0], "aggregator.surprise"));
  files.options.strict = true;
  CHECK(contains(files.refusal(), "aggregator.surprise"));
}

TEST_CASE("A52: the track head, the mask token and batch counters are no extra tensors") {
  Files files(change_of("aggregator.patch_embed.mask_token",
                        [](WeightTensor& t) { t.name = "track_head.tracker.norm.weight"; }));
  files.options.strict = true;
  CHECK(files.read_all().empty());
}

TEST_CASE(
    "A53: a wrong shape is named with what was expected and found, and whether it looks "
    "transposed") {
  const Files files([](WeightTensor& t) {
    if (t.name == "camera_head.pose_branch.fc1.weight") std::swap(t.shape[0], t.shape[1]);
    if (t.name == "depth_head.norm.bias") t.shape = {64, 2};
  });
  const std::string message = files.refusal();
  CHECK(contains(message,
                 "camera_head.pose_branch.fc1.weight is [128,64] where [64,128] is expected "
                 "(it looks transposed)"));
  CHECK(contains(message, "depth_head.norm.bias is [64,2] where [128] is expected"));
}

TEST_CASE("A54: a convertible type is converted, and said") {
  const TempDir dir;
  LoadOptions options;
  options.weights = dir / "model.safetensors";
  SafetensorsWriter out(options.weights);
  const auto specs = geometry_tensors(tiny_config());
  const auto dtype_of = [](const TensorSpec& spec) {
    return spec.name == "depth_head.norm.weight" ? Dtype::kBF16 : Dtype::kF32;
  };
  for (const auto& spec : specs) out.declare(spec.name, dtype_of(spec), spec.shape);
  for (const auto& spec : specs) {
    std::vector<float> values(static_cast<std::size_t>(spec.volume()));
    deterministic_values(spec.name, spec.shape, 1, values);
    out.write(spec.name, std::span<const float>(values));
  }
  out.finish();
  // A55: the other tensors of the same file are float32.
  const Checkpoint checkpoint(options);
  const auto warnings = checkpoint.warnings();
  REQUIRE(warnings.size() == 1);
  CHECK(contains(warnings[0], "depth_head.norm.weight (BF16)"));
  CHECK_FALSE(checkpoint.has_decoder());
}

TEST_CASE("A54: a type that is no floating-point number is refused by name") {
  const TempDir dir;
  LoadOptions options;
  options.weights = dir / "model.safetensors";
  SafetensorsWriter out(options.weights);
  for (const auto& spec : geometry_tensors(tiny_config())) {
    std::vector<float> values(static_cast<std::size_t>(spec.volume()));
    std::vector<std::int64_t> whole(values.size());
    if (spec.name == "depth_head.norm.bias") {
      out.add_int64(spec.name, spec.shape, whole);
    } else {
      out.add(spec.name, spec.shape, values);
    }
  }
  out.finish();
  CHECK_THROWS_WITH_AS(Checkpoint{options},
                       doctest::Contains("depth_head.norm.bias holds I64 values"), Error);
}

TEST_CASE(
    "A56: NaN or infinity in a weight is refused with the tensor and the count, unless allowed") {
  Files files(change_of("camera_head.trunk_norm.bias", [](WeightTensor& t) {
    t.values[3] = NAN;
    t.values[5] = -INFINITY;
  }));
  const std::string message = files.refusal(ErrorKind::kFormat);
  CHECK(contains(message, "camera_head.trunk_norm.bias"));
  CHECK(contains(message, "2 values"));
  files.options.allow_nonfinite = true;
  REQUIRE(files.read_all().size() == 1);
  CHECK(contains(files.read_all()[0], "camera_head.trunk_norm.bias"));
}

TEST_CASE("A57: all-zero and denormal-heavy tensors are mentioned") {
  const Files files([](WeightTensor& t) {
    if (t.name == "depth_head.norm.weight") t.values.assign(t.values.size(), 0.0f);
    if (t.name == "depth_head.norm.bias") t.values.assign(t.values.size(), 1e-40f);
  });
  const std::vector<std::string> warnings = files.read_all();
  REQUIRE(warnings.size() == 2);
  CHECK(contains(warnings[0], "zero"));
  CHECK(contains(warnings[0], "depth_head.norm.weight"));
  CHECK(contains(warnings[1], "denormal"));
  CHECK(contains(warnings[1], "depth_head.norm.bias"));
}

TEST_CASE("A58: weights of a model of other sizes say which it looks like") {
  Files files;
  ModelConfig other = tiny_config();
  SUBCASE("lang_dim") {
    other.lang_dim = 6;
    files.use_config(other);
    CHECK(contains(files.refusal(), "lang_dim is 3, not 6"));
  }
  SUBCASE("depth") {
    other.agg_depth = 5;
    files.use_config(other);
    CHECK(contains(files.refusal(), "agg_depth is 4, not 5"));
  }
  SUBCASE("width") {
    other.embed_dim = 128;
    files.use_config(other);
    CHECK(contains(files.refusal(), "embed_dim is 64, not 128"));
  }
}

TEST_CASE("A58: a decoder given as the geometry, the reverse, and other models are told apart") {
  const TempDir dir;
  const std::string geometry = dir / "g.safetensors", decoder = dir / "d.safetensors";
  write_tensors(geometry, geometry_tensors(tiny_config()), nullptr);
  write_tensors(decoder, decoder_tensors(tiny_config()), nullptr);
  const auto refusal = [](const std::string& weights, const std::string& decoder_file) {
    LoadOptions options;
    options.weights = weights;
    options.decoder = decoder_file;
    try {
      const Checkpoint checkpoint(options);
    } catch (const Error& e) {
      CHECK(e.kind() == ErrorKind::kMismatch);
      return std::string(e.what());
    }
    return std::string("accepted");
  };
  CHECK(contains(refusal(decoder, ""), "is a semantic bridging decoder"));
  CHECK(contains(refusal(geometry, geometry), "is a geometry model"));
  CHECK(refusal(geometry, decoder) == "accepted");

  const auto other_model = [&](const std::vector<std::string>& names) {
    const std::string path = dir / "other.safetensors";
    SafetensorsWriter out(path);
    for (const auto& name : names) out.add(name, {1}, std::vector<float>{1});
    out.finish();
    return refusal(path, "");
  };
  CHECK(contains(other_model({"cls_token", "pos_embed", "blocks.0.norm1.weight"}), "DINOv2"));
  CHECK(contains(other_model({"encoder.0.weight", "decoder.0.weight"}), "autoencoder"));
  CHECK(contains(other_model({"module.aggregator.camera_token"}), "\"module.\""));
  CHECK(contains(other_model({"resnet.conv"}), "resnet.conv"));
}
