// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>
#include <string>
#include <vector>

#include "tests/support/training.h"

namespace lvggt {
namespace {

using test::OwnedBatch;
using test::small_decoder_config;
using test::TrainingRun;

struct Slope {
  double measured = 0;  // central difference of the loss
  double expected = 0;  // gradient times direction
};

double norm(const std::vector<float>& v) {
  double sum = 0;
  for (const float x : v) sum += static_cast<double>(x) * x;
  return std::sqrt(sum);
}

// Along gradient / |gradient| + random / |random|: the first finds what is too much in a gradient,
// the second what is missing.
std::vector<float> direction_for(std::span<const float> gradient, std::uint32_t seed) {
  const auto n = static_cast<std::int64_t>(gradient.size());
  const Tensor<float, 1> noise = test::random_tensor(Shape{n}, seed);
  std::vector<float> g(gradient.begin(), gradient.end()), r(noise.data(), noise.data() + n);
  const double g_norm = norm(g), r_norm = norm(r);
  for (std::size_t i = 0; i < g.size(); ++i)
    g[i] = static_cast<float>(g[i] / std::max(g_norm, 1e-30) + r[i] / r_norm);
  return g;
}

// Moves values there and back along a direction. The step is short because of the kinks of ReLU and
// L1: what it crosses of them bends the slope in proportion to its length. The loss is good to
// about 1e-7, which such a step turns into 1e-3.
template <class Loss>
Slope slope_along(std::span<float> values, std::span<const float> gradient, std::uint32_t seed,
                  const Loss& loss) {
  constexpr double kStep = 5e-5;
  const std::vector<float> direction = direction_for(gradient, seed);
  const std::vector<float> before(values.begin(), values.end());
  Slope slope;
  std::array<double, 2> side{};
  for (int s = 0; s < 2; ++s) {
    for (std::size_t i = 0; i < before.size(); ++i)
      values[i] = static_cast<float>(before[i] + (s == 0 ? kStep : -kStep) * direction[i]);
    side[static_cast<std::size_t>(s)] = loss();
  }
  std::ranges::copy(before, values.begin());
  slope.measured = (side[0] - side[1]) / (2 * kStep);
  for (std::size_t i = 0; i < before.size(); ++i)
    slope.expected += static_cast<double>(gradient[i]) * direction[i];
  return slope;
}

// The gradients of all parameters, module by module, and of the tokens.
void check_gradients(const ModelConfig& config, TrainOptions options, std::int64_t H = 28,
                     std::int64_t W = 42) {
  options.loss = {0.7, 0.4, 0.6, 0.5};
  TrainingRun run(config, options);
  OwnedBatch data(config, 2, 2, 3, H, W);
  std::array<Tensor<float, 3>, 4> dtaps;
  std::array<View<float, 3>, 4> dtap_views;
  for (std::size_t i = 0; i < 4; ++i) {
    dtaps[i] = Tensor<float, 3>(data.taps[i].shape());
    dtap_views[i] = dtaps[i];
  }
  run.trainer.evaluate(data.batch, {}, true, dtap_views);
  const auto loss = [&] { return run.trainer.evaluate(data.batch, {}, false).total; };
  const auto check = [](const Slope& slope, const std::string& what) {
    CAPTURE(what);
    CHECK(slope.measured == doctest::Approx(slope.expected).epsilon(0.02).scale(0.1));
  };
  std::uint32_t seed = 100;
  for (const char* prefix :
       {"feature_extractor.norm", "feature_extractor.project", "feature_extractor.resize_layers",
        "feature_extractor.scratch.layer", "feature_extractor.scratch.refinenet1",
        "feature_extractor.scratch.refinenet2", "feature_extractor.scratch.refinenet3",
        "feature_extractor.scratch.refinenet4", "feature_extractor.scratch.output_conv1",
        "lang_encoder", "lang_decoder", "rgb_encoder", "rgb_decoder"}) {
    const std::span<float> weights = run.store.range(StoreRole::kWeights, prefix);
    if (weights.empty()) continue;
    check(slope_along(weights, run.store.range(StoreRole::kGradients, prefix), ++seed, loss),
          prefix);
  }
  for (std::size_t i = config.sbd_dpt ? 0 : 3; i < 4; ++i) {
    const auto size = static_cast<std::size_t>(dtaps[i].size());
    check(slope_along({data.taps[i].data(), size}, {dtaps[i].data(), size}, ++seed, loss),
          "tap " + std::to_string(i));
  }
}

TEST_CASE("decoder: gradients agree with finite differences, three levels and RGB") {
  check_gradients(small_decoder_config(), {});
}

TEST_CASE("decoder: gradients agree with finite differences, one level of six features") {
  ModelConfig config = small_decoder_config();
  config.sbd_levels = 1;
  config.lang_dim = 6;
  check_gradients(config, {});
}

TEST_CASE("decoder: gradients agree with finite differences in the ablations") {
  ModelConfig config = small_decoder_config();
  config.sbd_levels = 1;
  SUBCASE("without the RGB head") { config.sbd_rgb = false; }
  SUBCASE("MLP heads") { config.sbd_head = DecoderHead::kMlp; }
  SUBCASE("no DPT") { config.sbd_dpt = false; }
  SUBCASE("MLP heads without DPT and RGB") {
    config.sbd_head = DecoderHead::kMlp;
    config.sbd_dpt = false;
    config.sbd_rgb = false;
  }
  check_gradients(config, {});
}

TEST_CASE("decoder: gradients agree with finite differences for targets of another size") {
  ModelConfig config = small_decoder_config();
  config.sbd_levels = 1;
  SUBCASE("UNets") {}
  SUBCASE("MLP heads") { config.sbd_head = DecoderHead::kMlp; }
  check_gradients(config, {}, 20, 31);
}

TEST_CASE("decoder: gradients agree with finite differences under every option") {
  ModelConfig config = small_decoder_config();
  config.sbd_levels = 1;
  TrainOptions options;
  SUBCASE("cosine over the width") { options.cosine_over_width = true; }
  SUBCASE("frozen statistics") { options.frozen_batch_norm = true; }
  SUBCASE("in two parts") { options.accumulate = 2; }
  SUBCASE("recomputed activations") { options.activations = CheckpointActivations::kRecompute; }
  check_gradients(config, options);
}

// Weights, moments and running statistics after two steps.
std::vector<float> trained(const ModelConfig& config, const TrainOptions& options, int threads) {
  TrainingRun run(config, options, threads);
  const OwnedBatch data(config, 3, 2, 3, 28, 42);
  for (int i = 0; i < 2; ++i) CHECK(!run.trainer.step(data.batch).refused);
  std::vector<float> all;
  for (const StoreRole role : {StoreRole::kWeights, StoreRole::kFirstMoments,
                               StoreRole::kSecondMoments, StoreRole::kBuffers})
    for (const float v : run.copy_of(role)) all.push_back(v);
  return all;
}

TEST_CASE("decoder: recomputed activations give the same bits as kept ones") {
  for (const bool dpt : {true, false}) {
    ModelConfig config = small_decoder_config();
    config.sbd_dpt = dpt;
    TrainOptions keep, recompute;
    recompute.activations = CheckpointActivations::kRecompute;
    CHECK(trained(config, keep, 2) == trained(config, recompute, 2));
  }
}

TEST_CASE("decoder: one and several threads give the same bits") {
  for (const bool unet : {true, false}) {
    ModelConfig config = small_decoder_config();
    if (!unet) config.sbd_head = DecoderHead::kMlp;
    CHECK(trained(config, {}, 1) == trained(config, {}, 5));
  }
}

TEST_CASE("decoder: parts of a batch add up to the whole where statistics are frozen") {
  const ModelConfig config = small_decoder_config();
  TrainOptions options;
  options.frozen_batch_norm = true;
  TrainingRun whole(config, options);
  options.accumulate = 3;
  TrainingRun parts(config, options);
  const OwnedBatch data(config, 4, 2, 3, 28, 42);
  const LossTerms a = whole.trainer.evaluate(data.batch, {}, true);
  const LossTerms b = parts.trainer.evaluate(data.batch, {}, true);
  CHECK(b.total == doctest::Approx(a.total).epsilon(1e-6));
  const std::vector<float> g = whole.copy_of(StoreRole::kGradients);
  std::vector<float> difference = parts.copy_of(StoreRole::kGradients);
  for (std::size_t i = 0; i < g.size(); ++i) difference[i] -= g[i];
  CHECK(norm(difference) < 1e-5 * norm(g));
}

}  // namespace
}  // namespace lvggt
