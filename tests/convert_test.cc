// SPDX-License-Identifier: Apache-2.0
#include "weights/convert.h"

#include <doctest/doctest.h>

#include <filesystem>
#include <limits>
#include <string>
#include <vector>

#include "tests/support/paths.h"
#include "tests/support/safetensors_bytes.h"

using lvggt::convert_weights;
using lvggt::ConvertOptions;
using lvggt::ConvertResult;
using lvggt::Dtype;
using lvggt::ErrorKind;
using lvggt::Safetensors;
using lvggt::WeightSource;
using lvggt::test::Outcome;
using lvggt::test::outcome_of;
using lvggt::test::TempDir;

namespace {

const std::string kGolden = lvggt::test::test_data("golden/");

ConvertResult convert(const std::string& in, const std::string& out,
                      const ConvertOptions& options = {}) {
  return convert_weights(*WeightSource::open(in), out, options);
}

std::vector<float> read_all(const Safetensors& file, const std::string& name) {
  std::vector<float> values(static_cast<std::size_t>(file.at(name).size()));
  file.read_into(name, values);
  return values;
}

void write_one(const std::string& path, const std::vector<float>& values) {
  lvggt::SafetensorsWriter out(path);
  out.set_metadata("config", "{}");
  out.add("w", {static_cast<std::int64_t>(values.size())}, values);
  out.finish();
}

}  // namespace

TEST_CASE("convert_weights: a checkpoint keeps names, types, shapes and values") {
  const TempDir dir;
  const ConvertResult result = convert(kGolden + "checkpoint_plain.pth", dir / "a.safetensors");
  CHECK(result.num_tensors == 11);
  const auto file = Safetensors::open(dir / "a.safetensors");
  CHECK(file.metadata().at("format") == "pt");
  CHECK(file.entries()[0].name == "a.weight");
  CHECK(file.at("a.bias").dtype == Dtype::kF16);
  CHECK(read_all(file, "a.bias") == std::vector<float>{1.5f, -2.0f, 3.25f});
  CHECK(read_all(file, "bf") == std::vector<float>{1, -0.5f, 3, 1024});
  CHECK(read_all(file, "slice") == std::vector<float>{8, 9, 10, 14, 15, 16});
  CHECK(file.at("transposed").shape == std::vector<std::int64_t>{6, 4});
  CHECK(read_all(file, "transposed")[1] == 6);
  CHECK(file.read_int64("count") == std::vector<std::int64_t>{7});
  CHECK(file.read_int64("mask") == std::vector<std::int64_t>{1, 0, 1});
  CHECK(file.at("empty").shape == std::vector<std::int64_t>{0, 3});
}

TEST_CASE("convert_weights: only floating-point tensors change their type") {
  const TempDir dir;
  ConvertOptions options;
  options.dtype = Dtype::kBF16;
  convert(kGolden + "checkpoint_plain.pth", dir / "a.safetensors", options);
  const auto file = Safetensors::open(dir / "a.safetensors");
  CHECK(file.at("a.weight").dtype == Dtype::kBF16);
  CHECK(file.at("double").dtype == Dtype::kBF16);
  CHECK(file.at("count").dtype == Dtype::kI64);
  CHECK(read_all(file, "a.weight")[11] == 2.75f);
}

TEST_CASE("convert_weights: shards become one file, metadata is kept, the configuration replaced") {
  const TempDir dir;
  write_one(dir / "x.safetensors", {1, 2});
  lvggt::write_file(dir / "model.safetensors.index.json",
                    R"({"weight_map":{"w":"x.safetensors"}})");
  convert(dir.path(), dir / "kept.out");
  CHECK(Safetensors::open(dir / "kept.out").metadata().at("config") == "{}");
  ConvertOptions options;
  options.config = "{\"lang_dim\": 6}";
  convert(dir / "model.safetensors.index.json", dir / "new.out", options);
  CHECK(Safetensors::open(dir / "new.out").metadata().at("config") == options.config);
}

TEST_CASE("convert_weights: dropped prefixes are left out and counted") {
  const TempDir dir;
  ConvertOptions options;
  options.drop = {"a.", "shared"};
  const ConvertResult result = convert(kGolden + "checkpoint_plain.pth", dir / "a", options);
  CHECK(result.num_dropped == 3);
  CHECK(Safetensors::open(dir / "a").find("a.weight") == nullptr);
}

TEST_CASE(
    "A56: NaN, infinity and values that a type cannot hold are refused by name, unless allowed") {
  const TempDir dir;
  ConvertOptions half;
  half.dtype = Dtype::kF16;
  const auto check = [&](const ConvertOptions& options, const char* says) {
    const Outcome outcome = outcome_of([&] { convert(dir / "in", dir / "out", options); });
    CAPTURE(outcome.message);
    CHECK(outcome.kind == ErrorKind::kFormat);
    CHECK(outcome.says("tensor 'w'"));
    CHECK(outcome.says(says));
    CHECK_FALSE(std::filesystem::exists(dir / "out"));
  };
  write_one(dir / "in",
            {1, std::numeric_limits<float>::quiet_NaN(), std::numeric_limits<float>::infinity()});
  check({}, "1 NaN and 1 infinite values among 3");
  write_one(dir / "in", {1, 65536});
  check(half, "once converted");
  half.allow_nonfinite = true;
  CHECK(convert(dir / "in", dir / "out", half).num_tensors == 1);
}

TEST_CASE("convert_weights: a tensor of zeros is reported") {
  const TempDir dir;
  write_one(dir / "in", {0, 0, 0});
  const ConvertResult result = convert(dir / "in", dir / "out");
  REQUIRE(result.warnings.size() == 1);
  CHECK(result.warnings[0] == "tensor 'w': all values are zero");
}
