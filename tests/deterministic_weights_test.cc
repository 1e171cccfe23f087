// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/deterministic_weights.h"

#include <doctest/doctest.h>

#include <bit>
#include <cmath>
#include <string>
#include <vector>

#include "lvggt/core/error.h"

namespace {

struct Check {
  std::int64_t index;
  std::uint32_t bits;
};

// One tensor of every kind, with seed 1: the values were computed by an independent implementation.
struct Row {
  const char* name;
  std::vector<std::int64_t> shape;
  double base;
  double scale;
  std::vector<Check> checks;
};

const std::vector<Row>& rows() {
  static const std::vector<Row> table = {
      {"aggregator.frame_blocks.0.attn.qkv.weight",
       {192, 64},
       0,
       0.21650635094610965,
       {{0, 0xbe531934},
        {1, 0xbcacd52f},
        {2, 0x3dd2f200},
        {6144, 0xbe5a624a},
        {12287, 0x3c887f27}}},
      {"lang_encoder.down1.0.weight",
       {8, 32, 3, 3},
       0,
       0.14433756729740643,
       {{0, 0x3c34cb49}, {1, 0x3dda6ff7}, {2, 0xbd80fb50}, {1152, 0x3e07f5ea}, {2303, 0x3e12284f}}},
      {"lang_decoder_small.up1.weight",
       {64, 32, 2, 2},
       0,
       0.21650635094610965,
       {{0, 0xbe2f0162}, {1, 0xbd72e160}, {2, 0xbddcd2b7}, {4096, 0xbe3b40b1}, {8191, 0xbda80ee9}}},
      {"aggregator.frame_blocks.0.norm1.weight",
       {64},
       1,
       0.1,
       {{0, 0x3f872e45}, {1, 0x3f834759}, {2, 0x3f8b0cd7}, {32, 0x3f6d3318}, {63, 0x3f7934a1}}},
      {"aggregator.frame_blocks.0.attn.qkv.bias",
       {192},
       0,
       0.02,
       {{0, 0x3c40a86c}, {1, 0xbc9b6f25}, {2, 0x3b0b5885}, {96, 0xbba016d2}, {191, 0xbc3a58e6}}},
      {"aggregator.frame_blocks.0.ls1.gamma",
       {64},
       0.5,
       0.1,
       {{0, 0x3f00667d}, {1, 0x3f067317}, {2, 0x3f05d6e0}, {32, 0x3ed0c7ca}, {63, 0x3ef84628}}},
      {"aggregator.patch_embed.pos_embed",
       {1, 17, 64},
       0,
       0.3,
       {{0, 0xbe96c1a3}, {1, 0x3e3fc255}, {2, 0x3e89608e}, {544, 0xbdb54958}, {1087, 0x3e88f6d2}}},
      {"aggregator.camera_token",
       {1, 2, 1, 64},
       0,
       0.5,
       {{0, 0xbe12c9b0}, {1, 0xbec1d1b8}, {2, 0x3b2b6800}, {64, 0xbe1b1cf4}, {127, 0x3e0384d0}}},
      {"lang_encoder.down1.1.running_mean",
       {8},
       0,
       0.1,
       {{0, 0x3d1a22c0}, {1, 0x3d9947ba}, {2, 0x3d6fbcad}, {4, 0x3d9769de}, {7, 0xbd4320a3}}},
      {"lang_encoder.down1.1.running_var",
       {8},
       1,
       0.3,
       {{0, 0x3f6e1d17}, {1, 0x3f44af41}, {2, 0x3f89fff8}, {4, 0x3f8d4f3e}, {7, 0x3f414a00}}},
      {"camera_head.pose_branch.fc2.weight",
       {9, 64},
       0,
       0.021650635094610966,
       {{0, 0xbb8957be}, {1, 0xbc0ecbb9}, {2, 0x3bea618d}, {288, 0x3c89b142}, {575, 0x39d3460f}}},
      {"camera_head.pose_branch.fc2.bias",
       {9},
       0,
       0.01,
       {{0, 0xbaa77948}, {5, 0xbb14cc8a}, {6, 0x3e843cc4}, {7, 0x3e790c30}, {8, 0x3e83921a}}},
      {"depth_head.scratch.output_conv2.2.weight",
       {2, 32, 1, 1},
       0,
       0.15309310892394862,
       {{0, 0xbc4bfd70}, {1, 0xbd0c7e2a}, {2, 0x3d39bfa3}, {32, 0x3ddf2888}, {63, 0x3d9e88d7}}},
  };
  return table;
}

std::vector<float> values_of(const std::string& name, const std::vector<std::int64_t>& shape,
                             std::uint64_t seed) {
  std::size_t size = 1;
  for (const std::int64_t extent : shape) size *= static_cast<std::size_t>(extent);
  std::vector<float> values(size);
  lvggt::deterministic_values(name, shape, seed, values);
  return values;
}

}  // namespace

TEST_CASE("deterministic_bits: hash and sequence are those of the specification") {
  CHECK(lvggt::fnv1a64("aggregator.camera_token") == 0x13d66c4a392db57bu);
  CHECK(lvggt::fnv1a64("image.pixel") == 0xebe67a0ca68c32acu);
  CHECK(lvggt::fnv1a64("") == 0xcbf29ce484222325u);
  CHECK(lvggt::deterministic_bits("aggregator.camera_token", 1, 0) == 0x5b4d94df3caa6053u);
  CHECK(lvggt::deterministic_bits("image.pixel", 1, 1) == 0xdb8116580604ec37u);
  CHECK(lvggt::deterministic_bits("", 1, 2) == 0xc9127e24e395ef11u);
}

TEST_CASE("deterministic_values: every kind of tensor has the specified values") {
  for (const Row& row : rows()) {
    CAPTURE(row.name);
    const auto scale = lvggt::deterministic_scale(row.name, row.shape);
    CHECK(scale.base == row.base);
    CHECK(scale.scale == row.scale);
    const std::vector<float> values = values_of(row.name, row.shape, 1);
    for (const Check& check : row.checks) {
      CAPTURE(check.index);
      CHECK(std::bit_cast<std::uint32_t>(values.at(static_cast<std::size_t>(check.index))) ==
            check.bits);
    }
  }
}

TEST_CASE("deterministic_values: threads do not change a bit") {
  lvggt::Context ctx(3);
  const std::vector<std::int64_t> shape{500, 401};
  std::vector<float> parallel(500 * 401);
  lvggt::deterministic_values("a.weight", shape, 7, parallel, ctx);
  CHECK(parallel == values_of("a.weight", shape, 7));
}

TEST_CASE("deterministic_scale: a component must match whole") {
  const std::vector<std::int64_t> shape{8, 2, 3, 3};
  CHECK(lvggt::deterministic_scale("x.up1.weight", shape).scale == std::sqrt(3 / 8.0));
  CHECK(lvggt::deterministic_scale("x.setup1.weight", shape).scale == std::sqrt(3 / 18.0));
  CHECK(lvggt::deterministic_scale("x.resize_layers.1.weight", shape).scale == std::sqrt(3 / 8.0));
  CHECK(lvggt::deterministic_scale("x.resize_layers.3.weight", shape).scale == std::sqrt(3 / 18.0));
}

TEST_CASE("deterministic_values: a name without a rule and a wrong size are refused") {
  std::vector<float> one(1);
  const std::vector<std::int64_t> shape{1};
  CHECK_THROWS_AS(lvggt::deterministic_values("bn.num_batches_tracked", shape, 1, one),
                  lvggt::Error);
  CHECK_THROWS_AS(lvggt::deterministic_values("a.bias", std::vector<std::int64_t>{2}, 1, one),
                  lvggt::Error);
  CHECK_THROWS_AS(lvggt::deterministic_values("a.weight", std::vector<std::int64_t>{1, -1}, 1, one),
                  lvggt::Error);
}

TEST_CASE("deterministic_images: pixels are those of the specification") {
  const auto images = lvggt::deterministic_images(1, 4, 56, 84);
  CHECK(images(0, 0, 0, 0) == 50.0f / 255.0f);
  CHECK(images(0, 0, 1, 0) == 88.0f / 255.0f);
  CHECK(images(0, 17, 33, 1) == 177.0f / 255.0f);
  CHECK(images(2, 55, 83, 2) == 133.0f / 255.0f);
  CHECK(images(3, 16, 16, 0) == 165.0f / 255.0f);
}

TEST_CASE("deterministic_uniform: values are those of the specification") {
  std::vector<float> values(2 * 3 * 3 * 56 * 84);
  lvggt::deterministic_uniform("train.features", 1, -1, 1, values);
  CHECK(values[0] == -0.07991433143615723f);
  CHECK(values[1] == -0.43863821029663086f);
  CHECK(values[1000] == 0.34943556785583496f);
  CHECK(values[84671] == 0.36080968379974365f);
}
