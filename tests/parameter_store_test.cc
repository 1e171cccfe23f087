// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/parameter_store.h"

#include <doctest/doctest.h>

#include <cmath>

#include "lvggt/model/tensor_list.h"
#include "tests/support/temp_dir.h"
#include "tests/support/training.h"

namespace lvggt {
namespace {

using test::small_decoder_config;

TEST_CASE("parameter store: every tensor of the decoder, in order, parameters apart from buffers") {
  const ModelConfig config = small_decoder_config();
  const ParameterStore store(config);
  std::size_t parameter = 0, buffer = 0;
  for (const TensorSpec& spec : decoder_tensors(config)) {
    const bool running = spec.name.find(".running_") != std::string::npos;
    const ParameterEntry& entry =
        running ? store.buffers().at(buffer++) : store.parameters().at(parameter++);
    CHECK(entry.name == spec.name);
    CHECK(entry.shape == spec.shape);
    CHECK(entry.offset % kStoreAlignment == 0);
    CHECK(entry.decays == (spec.shape.size() > 1));
  }
  CHECK(parameter == store.parameters().size());
  CHECK(buffer == store.buffers().size());
}

TEST_CASE("parameter store: initialised as PyTorch does, by seed") {
  Context ctx(2);
  ParameterStore store(small_decoder_config()), same(small_decoder_config()),
      other(small_decoder_config());
  store.initialise(1, ctx);
  same.initialise(1, ctx);
  other.initialise(2, ctx);
  const auto weights = [](const ParameterStore& s) {
    return std::vector<float>(s.block(StoreRole::kWeights).begin(),
                              s.block(StoreRole::kWeights).end());
  };
  CHECK(weights(store) == weights(same));
  CHECK(weights(store) != weights(other));
  const auto largest = [&](const char* name) {
    float most = 0;
    for (const float v : store.values(StoreRole::kWeights, name))
      most = std::max(most, std::abs(v));
    return static_cast<double>(most);
  };
  // down2.0 sums 4 channels of 3 x 3; up1 is counted by its 16 outputs of 2 x 2, as PyTorch does.
  CHECK(largest("lang_encoder.down2.0.weight") == doctest::Approx(1 / 6.0).epsilon(0.03));
  CHECK(largest("lang_encoder.down2.0.weight") <= 1 / 6.0);
  CHECK(largest("lang_encoder.down2.0.bias") <= 1 / 6.0);
  CHECK(largest("rgb_decoder.0.up1.weight") == doctest::Approx(1 / 8.0).epsilon(0.03));
  CHECK(store.values(StoreRole::kWeights, "lang_encoder.down1.1.weight")[0] == 1);
  CHECK(store.values(StoreRole::kWeights, "lang_encoder.down1.1.bias")[0] == 0);
  CHECK(store.values(StoreRole::kBuffers, "lang_encoder.down1.1.running_var")[0] == 1);
}

TEST_CASE("parameter store: the published rule covers every name, of a single level too") {
  Context ctx(2);
  ModelConfig config = small_decoder_config();
  SUBCASE("three levels") {}
  SUBCASE("one level") { config.sbd_levels = 1; }
  SUBCASE("ablations") {
    config.sbd_head = DecoderHead::kMlp;
    config.sbd_dpt = false;
  }
  ParameterStore store(config);
  CHECK_NOTHROW(store.initialise_deterministic(1, ctx));
}

TEST_CASE("parameter store: what is written is read back, weights or average") {
  Context ctx(2);
  ParameterStore store(small_decoder_config(), true), read(small_decoder_config());
  store.initialise_deterministic(1, ctx);
  store.start_average();
  store.block(StoreRole::kAverage)[0] += 1;
  test::TempDir dir;
  for (const bool averaged : {false, true}) {
    SafetensorsWriter out(dir / "decoder.safetensors");
    store.write(out, averaged);
    out.finish();
    read.load(Safetensors::open(dir / "decoder.safetensors"));
    CHECK(std::ranges::equal(read.block(StoreRole::kWeights),
                             store.block(averaged ? StoreRole::kAverage : StoreRole::kWeights)));
    CHECK(std::ranges::equal(read.block(StoreRole::kBuffers), store.block(StoreRole::kBuffers)));
  }
}

TEST_CASE("parameter store: a checkpoint of another configuration is refused whole") {
  Context ctx(2);
  ModelConfig other = small_decoder_config();
  other.sbd_levels = 1;
  other.sbd_hidden_dim = 8;
  ParameterStore written(other), store(small_decoder_config());
  written.initialise(1, ctx);
  store.initialise(2, ctx);
  const std::vector<float> before(store.block(StoreRole::kWeights).begin(),
                                  store.block(StoreRole::kWeights).end());
  test::TempDir dir;
  SafetensorsWriter out(dir / "decoder.safetensors");
  written.write(out);
  out.finish();
  try {
    store.load(Safetensors::open(dir / "decoder.safetensors"));
    FAIL("it was read");
  } catch (const Error& error) {
    const std::string what = error.what();
    CHECK(error.kind() == ErrorKind::kMismatch);
    CHECK(what.find("decoder.safetensors") != std::string::npos);
    CHECK(what.find("lang_decoder_small.up1.weight") != std::string::npos);
    CHECK(what.find("lang_encoder.down1.0.weight is [8,6,3,3], not [4,6,3,3]") !=
          std::string::npos);
  }
  CHECK(std::ranges::equal(before, store.block(StoreRole::kWeights)));
}

TEST_CASE("parameter store: names that it does not have are named") {
  ParameterStore store(small_decoder_config());
  CHECK_THROWS_WITH_AS(store.values(StoreRole::kWeights, "lang_decoder.up1.weight"),
                       "parameter store: the decoder of this configuration has no parameter "
                       "lang_decoder.up1.weight",
                       Error);
  CHECK_THROWS_AS(store.view<2>(StoreRole::kWeights, "lang_encoder.down1.0.weight"), Error);
  CHECK(store.range(StoreRole::kGradients, "nothing").empty());
}

}  // namespace
}  // namespace lvggt
