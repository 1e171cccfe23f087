// SPDX-License-Identifier: Apache-2.0
// int8 weights in files: what is refused, and that what is loaded is what was stored.
#include "lvggt/model/quantized_linear.h"

#include <doctest/doctest.h>

#include <cmath>
#include <limits>
#include <span>
#include <string>
#include <vector>

#include "lvggt/kernels/packed_matrix.h"
#include "tests/support/random.h"
#include "tests/support/tiny_model.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

const std::string kName = "aggregator.global_blocks.1.mlp.fc2.weight";

// A weight of 3 channels of 4 on its way into a file, and what a test may do to it.
struct Weight {
  std::vector<std::int8_t> integers{63, -1, 0, 5, -63, 62, 1, 1, 0, 0, 0, 0};
  std::vector<float> scales{0.5f, 2, 1};
  std::vector<std::int64_t> shape{3, 4}, scale_shape{3};
  Dtype scale_dtype = Dtype::kF32;
  bool has_scale = true;
  std::string scheme = std::string(kInt8Scheme);
};

// The message of reading it, empty if it is read.
std::string refusal(const Weight& weight) {
  const TempDir dir;
  SafetensorsWriter out(dir / "w");
  if (!weight.scheme.empty()) out.set_metadata(std::string(kQuantizationKey), weight.scheme);
  out.declare(kName, Dtype::kI8, weight.shape);
  if (weight.has_scale) out.declare(scale_name(kName), weight.scale_dtype, weight.scale_shape);
  out.write(kName, std::as_bytes(std::span(weight.integers)));
  if (weight.has_scale) out.write(scale_name(kName), std::span<const float>(weight.scales));
  out.finish();
  const Safetensors file = Safetensors::open(dir / "w");
  try {
    const QuantizedLinear read = read_quantized_linear(file, file.at(kName));
    CHECK(std::equal(weight.integers.begin(), weight.integers.end(), read.integers.data()));
    CHECK(std::equal(weight.scales.begin(), weight.scales.end(), read.scales.data()));
  } catch (const Error& error) {
    CHECK((error.kind() == ErrorKind::kFormat || error.kind() == ErrorKind::kMismatch));
    return error.what();
  }
  return {};
}

bool contains(const std::string& text, const std::string& part) {
  return text.find(part) != std::string::npos;
}

// The reference model in a file with one linear weight as int8, its scale maybe of another shape.
std::string model_with_int8(const TempDir& dir, const std::string& name, std::int64_t num_scales,
                            const std::string& extra_scale = {}) {
  const std::string path = dir / "model.safetensors";
  const ModelConfig config = tiny_config();
  SafetensorsWriter out(path);
  out.set_metadata("config", to_json(config));
  out.set_metadata(std::string(kQuantizationKey), std::string(kInt8Scheme));
  const auto specs = geometry_tensors(config);
  for (const TensorSpec& spec : specs) {
    out.declare(spec.name, spec.name == name ? Dtype::kI8 : Dtype::kF32, spec.shape);
    if (spec.name == name && num_scales > 0)
      out.declare(scale_name(name), Dtype::kF32, {num_scales});
  }
  if (!extra_scale.empty()) out.declare(extra_scale, Dtype::kF32, {1});
  for (const TensorSpec& spec : specs) {
    const std::vector<float> values(static_cast<std::size_t>(spec.volume()), 0.5f);
    if (spec.name != name) {
      out.write(spec.name, std::span<const float>(values));
      continue;
    }
    const std::vector<std::int8_t> integers(values.size(), 63);
    out.write(spec.name, std::as_bytes(std::span(integers)));
    if (num_scales > 0)
      out.write(scale_name(name),
                std::span<const float>(values).first(static_cast<std::size_t>(num_scales)));
  }
  if (!extra_scale.empty()) out.write(extra_scale, std::span<const float>(std::vector<float>{1}));
  out.finish();
  return path;
}

}  // namespace

TEST_CASE("quantized linear: stored integers and scales are read as they are") {
  CHECK(refusal({}) == "");
}

TEST_CASE("quantized linear: scales that are missing or of another type or shape are refused") {
  Weight weight;
  SUBCASE("missing") {
    weight.has_scale = false;
    CHECK(
        contains(refusal(weight), kName + " holds I8 values, but " + kName + ".scale is missing"));
  }
  SUBCASE("shape") {
    weight.scale_shape = {3, 1};
    CHECK(contains(refusal(weight),
                   ".scale is F32 [3,1] where F32 [3] is expected for the I8 [3,4]"));
  }
  SUBCASE("length") {
    weight.scales = {1, 1};
    weight.scale_shape = {2};
    CHECK(contains(refusal(weight), ".scale is F32 [2] where F32 [3]"));
  }
  SUBCASE("type") {
    weight.scale_dtype = Dtype::kF16;
    CHECK(contains(refusal(weight), ".scale is F16 [3] where F32 [3]"));
  }
}

TEST_CASE("quantized linear: scales that are not positive numbers are refused by channel") {
  for (const float wrong : {0.0f, -1.0f, std::numeric_limits<float>::quiet_NaN(),
                            std::numeric_limits<float>::infinity()}) {
    Weight weight;
    weight.scales[1] = wrong;
    const std::string message = refusal(weight);
    CAPTURE(message);
    CHECK(contains(message, kName + ".scale"));
    CHECK(contains(message, "output channel 1"));
  }
}

TEST_CASE("quantized linear: integers beyond 7 bits, or that use fewer, are refused by channel") {
  for (const int wrong : {64, -64, 127, -128}) {
    Weight weight;
    weight.integers[2] = static_cast<std::int8_t>(wrong);
    const std::string message = refusal(weight);
    CAPTURE(message);
    CHECK(contains(message, "magnitude " + std::to_string(std::abs(wrong))));
    CHECK(contains(message, "output channel 0"));
  }
  Weight weight;
  weight.integers[0] = 62;
  CHECK(contains(refusal(weight), "the largest magnitude is 62, but the scheme scales it to 63"));
}

TEST_CASE("quantized linear: a file that does not say how it is quantised is refused") {
  Weight weight;
  weight.scheme = "";
  CHECK(contains(refusal(weight), "metadata have no \"quantization\""));
  weight.scheme = "int4 in groups";
  CHECK(contains(refusal(weight), "\"int4 in groups\", not \"int8 per output channel"));
}

TEST_CASE("quantized linear: int8 for anything but a linear layer is refused with its shape") {
  Weight weight;
  weight.shape = {3, 1, 2, 2};
  const std::string message = refusal(weight);
  CHECK(contains(message, "I8"));
  CHECK(contains(message, "[3,1,2,2]"));
  CHECK(contains(message, "linear"));
}

TEST_CASE("Checkpoint: a quantised weight loads with its scale, and is refused without") {
  const TempDir dir;
  const std::int64_t N = 64;
  LoadOptions load;
  load.weights = model_with_int8(dir, kName, N);
  {
    const Checkpoint checkpoint(load);
    CHECK(checkpoint.warnings().empty());
    CHECK(checkpoint.storage_of(kName) == Storage::kI8);
    CHECK(contains(checkpoint.storage_summary(), "1 as int8"));
    const PackedMatrix packed = checkpoint.read_linear(kName);
    CHECK(packed.storage == Storage::kI8);
    CHECK(packed.scales(5) == 0.5f);
    CHECK(packed.weight_sums(5) == 63 * packed.K);
    CHECK(checkpoint.read<2>(kName)(3, 7) == 31.5f);
  }
  load.storage = StoragePolicy::of(Storage::kBf16);
  const Checkpoint widened(load);
  CHECK(widened.storage_of(kName) == Storage::kBf16);
  REQUIRE(widened.warnings().size() == 1);
  CHECK(contains(widened.warnings()[0], kName + " (I8)"));

  load.weights = model_with_int8(dir, kName, 0);
  CHECK_THROWS_WITH_AS(Checkpoint{load}, doctest::Contains(".scale is missing"), Error);
  load.weights = model_with_int8(dir, kName, N - 1);
  CHECK_THROWS_WITH_AS(Checkpoint{load}, doctest::Contains("F32 [63] where F32 [64]"), Error);
  load.weights = model_with_int8(dir, "depth_head.projects.0.weight", 0);
  CHECK_THROWS_WITH_AS(Checkpoint{load}, doctest::Contains("depth_head.projects.0.weight"), Error);
  load.weights = model_with_int8(dir, "depth_head.norm.weight", 0);
  CHECK_THROWS_WITH_AS(Checkpoint{load}, doctest::Contains("holds I8 values"), Error);
}

TEST_CASE("Checkpoint: the scale of a weight that is no integer is an extra tensor") {
  const TempDir dir;
  LoadOptions load;
  load.weights = model_with_int8(dir, kName, 64, "depth_head.projects.0.weight.scale");
  const auto warnings = Checkpoint(load).warnings();
  REQUIRE(warnings.size() == 1);
  CHECK(contains(warnings[0], "depth_head.projects.0.weight.scale"));
  load.strict = true;
  CHECK_THROWS_AS(Checkpoint{load}, Error);
}

TEST_CASE("quantize_channel: the integers and scale are those of pack_linear") {
  const auto weight = random_tensor(Shape{20, 37}, 3);
  const PackedMatrix direct = pack_linear(weight, Storage::kI8);
  Tensor<std::int8_t, 2> integers(weight.shape());
  Tensor<float, 1> scales(Shape{20});
  for (std::int64_t n = 0; n < 20; ++n) {
    scales(n) = quantize_channel(integers[n].data(), weight.view()[n].data(), 37);
    for (std::int64_t k = 0; k < 37; ++k)
      CHECK(std::abs(scales(n) * static_cast<float>(integers(n, k)) - weight(n, k)) <=
            0.5001f * scales(n));
  }
  const PackedMatrix stored = pack_linear(integers.view(), scales.view());
  CHECK(std::equal(direct.panels.data(), direct.panels.data() + direct.panels.size(),
                   stored.panels.data()));
  CHECK_SAME_BITS(direct.scales, stored.scales);
  CHECK(std::equal(direct.weight_sums.data(), direct.weight_sums.data() + direct.weight_sums.size(),
                   stored.weight_sums.data()));
}

TEST_CASE("quantize_channel: zeros, denormals and what is not finite") {
  std::int8_t integers[3] = {1, 1, 1};
  const float tiny[3] = {1e-40f, 0, -1e-39f};
  CHECK(quantize_channel(integers, tiny, 3) == 0);
  CHECK(integers[0] == 0);
  const float infinite[3] = {1, std::numeric_limits<float>::infinity(), 0};
  CHECK(std::isnan(quantize_channel(integers, infinite, 3)));
  CHECK(integers[0] == 0);
}
