// SPDX-License-Identifier: Apache-2.0
// weights_quantize as its users meet it, and its files in the other programs.
#include "weights/quantize.h"

#include <doctest/doctest.h>

#include <filesystem>
#include <string>
#include <vector>

#include "lvggt/io/json.h"
#include "lvggt/model/quantized_linear.h"
#include "tests/support/child_process.h"
#include "tests/support/paths.h"
#include "tests/support/tiny_model.h"
#include "weights/sensitivity.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

struct Result {
  int status = 0;
  std::string out, err;
};

Result run(const std::vector<std::string>& argv) {
  ChildProcess child(argv);
  const int status = child.wait();
  return {status, child.out(), child.err()};
}

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

// The reference model in a folder of its own.
struct Source {
  TempDir dir;
  std::string model = dir / "model.safetensors";
  Source() {
    const ModelConfig config = tiny_config();
    write_tensors(model, all_tensors(config), &config);
  }
  Result quantize(const std::string& out, std::vector<std::string> more = {}) const {
    more.insert(more.begin(), {program("weights_quantize"), model, dir / out});
    return run(more);
  }
};

std::vector<float> outputs(const LoadOptions& load) {
  Context ctx(2);
  const LangVggt model = LangVggt::load(load, ctx);
  Stream stream(model, ctx);
  const Tensor<float, 4> images = deterministic_images(1, 2, 56, 84);
  std::vector<float> values;
  for (std::int64_t i = 0; i < 2; ++i) {
    const Frame frame = stream.push(images[i]);
    const auto append = [&](auto view) {
      values.insert(values.end(), view.data(), view.data() + view.size());
    };
    append(frame.pose_encoding);
    append(frame.depth);
    append(frame.depth_confidence);
    append(frame.rgb);
    append(frame.language);
  }
  return values;
}

}  // namespace

TEST_CASE("weights_quantize: a file computes the same bits as its storage chosen at loading") {
  const Source source;
  for (const char* storage : {"int8", "bf16", "f16"}) {
    CAPTURE(storage);
    const Result result =
        source.quantize(std::string(storage) + ".safetensors", {"--storage", storage});
    CAPTURE(result.err);
    REQUIRE(result.status == 0);
    LoadOptions stored, chosen;
    stored.weights = source.dir / (std::string(storage) + ".safetensors");
    chosen.weights = source.model;
    chosen.storage = StoragePolicy::of(parse_storage(storage, ""));
    CHECK(outputs(stored) == outputs(chosen));
    CHECK(Checkpoint(stored).warnings().empty());
    // Asking for what the file is anyway changes nothing.
    stored.storage = chosen.storage;
    CHECK(outputs(stored) == outputs(chosen));
  }
}

TEST_CASE("weights_quantize: types by kind, scales, metadata, sizes") {
  const Source source;
  REQUIRE(source
              .quantize("out", {"--kind", "dino=f32", "--kind", "dino.fc2=int8", "--kind",
                                "camera.pose=f16", "--drop", "point_head."})
              .status == 0);
  const auto file = Safetensors::open(source.dir / "out");
  CHECK(file.metadata().at("quantization") == kInt8Scheme);
  CHECK(contains(file.metadata().at("storage"), "dino.fc2=int8"));
  CHECK(contains(file.metadata().at("config"), "embed_dim"));
  const auto dtype = [&](const std::string& name) { return file.at(name).dtype; };
  CHECK(dtype("aggregator.patch_embed.blocks.0.mlp.fc1.weight") == Dtype::kF32);
  CHECK(dtype("aggregator.patch_embed.blocks.0.mlp.fc2.weight") == Dtype::kI8);
  CHECK(file.find("aggregator.patch_embed.blocks.0.mlp.fc2.weight.scale") != nullptr);
  CHECK(dtype("aggregator.global_blocks.0.attn.qkv.weight") == Dtype::kI8);
  CHECK(dtype("aggregator.global_blocks.0.attn.qkv.bias") == Dtype::kF32);
  CHECK(dtype("aggregator.global_blocks.0.attn.q_norm.weight") == Dtype::kF32);
  CHECK(dtype("camera_head.trunk.0.attn.qkv.weight") == Dtype::kBF16);
  CHECK(dtype("camera_head.pose_branch.fc1.weight") == Dtype::kF16);
  CHECK(dtype("depth_head.scratch.layer1_rn.weight") == Dtype::kBF16);
  CHECK(dtype("lang_encoder.down1.0.weight") == Dtype::kF32);
  CHECK(file.find("point_head.norm.weight") == nullptr);

  const auto opened = WeightSource::open(source.model);
  QuantizeOptions options;
  options.drop = {"point_head."};
  const QuantizeResult plan = plan_quantization(*opened, options);
  const QuantizeResult done = quantize_weights(*opened, source.dir / "again", options);
  CHECK(plan.bytes_after == done.bytes_after);
  std::int64_t bytes = 0;
  const auto again = Safetensors::open(source.dir / "again");
  for (const TensorEntry& entry : again.entries()) bytes += entry.num_bytes;
  CHECK(bytes == done.bytes_after);
  for (const QuantizedKind& kind : done.kinds) {
    CAPTURE(kind.kind);
    // Uniform weights in steps of 1/63 of the largest: 1/63/sqrt(12) over 1/sqrt(3), 0.8%.
    if (kind.dtypes == "I8") CHECK(kind.relative_error == doctest::Approx(0.008).epsilon(0.1));
    if (kind.dtypes == "F32") CHECK(kind.relative_error == 0);
  }
}

TEST_CASE("weights_quantize: a plan prints sizes and writes nothing") {
  const Source source;
  const Result plan = run({program("weights_quantize"), "--dry-run", source.model});
  CHECK(plan.status == 0);
  CHECK(contains(plan.out, "global.fc2"));
  CHECK(contains(plan.out, "would become"));
  CHECK(std::distance(std::filesystem::directory_iterator(source.dir.path()), {}) == 1);
}

TEST_CASE("weights_quantize: what cannot be done is refused, and nothing is written") {
  const Source source;
  const auto fault = [&](const Result& result, int status, const std::string& says) {
    CAPTURE(result.err);
    CHECK(result.status == status);
    CHECK(contains(result.err, says));
  };
  fault(source.quantize("x", {"--kind", "depth=int8"}), 3, "depth cannot be int8");
  fault(source.quantize("x", {"--kind", "unknown=int8"}), 2, "'unknown'");
  fault(source.quantize("x", {"--kind", "dino"}), 2, "KIND=TYPE");
  fault(source.quantize("x", {"--kind", "dino=int4"}), 2, "int4");
  fault(source.quantize("x", {"--storage", "int4"}), 2, "int4");
  fault(run({program("weights_quantize"), source.model}), 2, "missing");
  fault(source.quantize("model.safetensors"), 2, "--force");
  REQUIRE(source.quantize("int8").status == 0);
  fault(run({program("weights_quantize"), source.dir / "int8", source.dir / "x"}), 3,
        "quantised already");
  write_tensors(source.model, all_tensors(tiny_config()), nullptr, [](WeightTensor& tensor) {
    if (tensor.name == "camera_head.pose_branch.fc2.weight") tensor.values[2] = 1e6f;
  });
  fault(source.quantize("x", {"--storage", "f16"}), 3, "camera_head.pose_branch.fc2.weight");
  fault(source.quantize("x", {"--storage", "f16"}), 3, "F16");
  CHECK_FALSE(std::filesystem::exists(source.dir / "x"));
}

TEST_CASE("quantised files: the other programs say what they are and what becomes of them") {
  const Source source;
  REQUIRE(source.quantize("int8").status == 0);
  const Result info = run({program("weights_info"), "--check", source.dir / "int8"});
  CHECK(contains(info.out, "I8 in"));
  CHECK(contains(info.out, "quantization = int8 per output channel"));
  CHECK(contains(info.out, "every tensor that it needs is there"));
  CHECK(contains(info.out, "all finite, none suspicious"));

  const std::string golden = test_data("golden/square56_tiny_seed1.safetensors");
  const auto check = [&](std::vector<std::string> more) {
    more.insert(more.begin(), {program("check_reference"), "--tolerance", "0.2", "--weights",
                               source.dir / "int8", golden});
    return run(more);
  };
  const Result stored = check({});
  CAPTURE(stored.err);
  CHECK(stored.status == 0);
  CHECK(contains(stored.err, "as int8"));
  const Result widened = check({"--weights-storage", "f32"});
  CHECK(widened.status == 0);
  CHECK(contains(widened.err, "does not bring back what rounding took"));
}

TEST_CASE("measure_sensitivity: one kind at a time, and the model is whole again for the next") {
  const Source source;
  LoadOptions load;
  load.weights = source.model;
  Context ctx(2);
  SensitivityOptions options;
  options.frames = 1;
  options.kinds = {"global.fc2", "patch_embed", "decoder.dpt"};
  const auto together = measure_sensitivity(load, options, ctx);
  REQUIRE(together.size() == 4);  // convolutions have no int8
  CHECK(together[0].what == "global.fc2");
  CHECK(together[1].weights == Storage::kI8);
  CHECK(together[1].relative_l2[1] > together[0].relative_l2[1]);
  CHECK(together[0].relative_l2[1] > 0);
  CHECK(together[3].relative_l2[1] == 0);  // the decoder has no say in the depth
  CHECK(together[3].relative_l2[2] > 0);
  options.kinds = {"decoder.dpt"};
  const auto alone = measure_sensitivity(load, options, ctx);
  REQUIRE(alone.size() == 1);
  CHECK(alone[0].relative_l2 == together[3].relative_l2);
  options.kinds = {"fc2"};
  CHECK_THROWS_WITH_AS(measure_sensitivity(load, options, ctx), doctest::Contains("'fc2'"), Error);
}
