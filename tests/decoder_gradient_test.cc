// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cmath>
#include <vector>

#include "lvggt/exact/decoder_trainer.h"
#include "tests/support/exact_batch.h"
#include "tests/support/training.h"

namespace lvggt {
namespace {

using test::ExactBatch;
using test::OwnedBatch;
using test::small_decoder_config;
using test::TrainingRun;

double dot(std::span<const double> a, std::span<const double> b) {
  double sum = 0;
  for (std::size_t i = 0; i < a.size(); ++i) sum += a[i] * b[i];
  return sum;
}

// |a - b| / |b|
double difference(std::span<const float> a, std::span<const double> b) {
  double squares = 0;
  for (std::size_t i = 0; i < a.size(); ++i) squares += (a[i] - b[i]) * (a[i] - b[i]);
  return std::sqrt(squares / dot(b, b));
}

// A random direction of unit length, with the gradient's own added: the first finds what is missing
// in a gradient, the second what is too much.
std::vector<double> direction_for(std::span<const double> gradient, std::uint32_t seed) {
  const Tensor<float, 1> noise = test::random_tensor(Shape{std::ssize(gradient)}, seed);
  std::vector<double> direction(noise.data(), noise.data() + noise.size());
  const double length = std::sqrt(dot(direction, direction));
  const double slope = std::max(std::sqrt(dot(gradient, gradient)), 1e-30);
  for (std::size_t i = 0; i < direction.size(); ++i)
    direction[i] = direction[i] / length + gradient[i] / slope;
  return direction;
}

// Values there and back along a direction: the slope of the loss is gradient times direction. The
// step is so short that it crosses no kink of a ReLU or an L1 term; the loss is good to 1e-15.
template <class Loss>
void check_slope(std::span<double> values, std::span<const double> gradient, std::uint32_t seed,
                 const Loss& loss) {
  constexpr double kStep = 1e-7;
  const std::vector<double> direction = direction_for(gradient, seed);
  const std::vector<double> before(values.begin(), values.end());
  std::array<double, 2> side{};
  for (std::size_t s = 0; s < 2; ++s) {
    for (std::size_t i = 0; i < before.size(); ++i)
      values[i] = before[i] + (s == 0 ? kStep : -kStep) * direction[i];
    side[s] = loss();
  }
  std::ranges::copy(before, values.begin());
  const double measured = (side[0] - side[1]) / (2 * kStep);
  CHECK(measured == doctest::Approx(dot(gradient, direction)).epsilon(1e-5).scale(1e-2));
}

// In float64, all parameters at once and the tokens; and the float32 trainer's gradients, which are
// the same but for rounding.
void check_gradients(const ModelConfig& config, TrainOptions options, std::int64_t H = 28,
                     std::int64_t W = 42) {
  options.loss = {0.7, 0.4, 0.6, 0.5};
  TrainingRun run(config, options);
  OwnedBatch data(config, 2, 2, 3, H, W);
  ExactBatch exact(data);
  ExactParameters parameters(run.store);
  ExactDecoderTrainer trainer(parameters, options, run.ctx);
  std::array<Tensor<double, 3>, 4> dtaps;
  TapGradients<double> dtap_views;
  for (std::size_t i = 0; i < 4; ++i)
    dtap_views[i] = dtaps[i] = Tensor<double, 3>(exact.taps[i].shape());
  const LossTerms terms = trainer.evaluate(exact.batch, {}, true, dtap_views);
  const auto loss = [&] { return trainer.evaluate(exact.batch, {}, false).total; };
  const std::span<double> block = parameters.block(StoreRole::kGradients);
  const std::vector<double> gradient(block.begin(), block.end());
  check_slope(parameters.block(StoreRole::kWeights), gradient, 100, loss);
  for (std::size_t i = config.sbd_dpt ? 0 : 3; i < 4; ++i) {
    const auto size = static_cast<std::size_t>(dtaps[i].size());
    check_slope({exact.taps[i].data(), size}, {dtaps[i].data(), size}, 101, loss);
  }

  std::array<Tensor<float, 3>, 4> fast_dtaps;
  TapGradients<float> fast_views;
  for (std::size_t i = 0; i < 4; ++i)
    fast_views[i] = fast_dtaps[i] = Tensor<float, 3>(data.taps[i].shape());
  const LossTerms fast = run.trainer.evaluate(data.batch, {}, true, fast_views);
  CHECK(fast.total == doctest::Approx(terms.total).epsilon(1e-6));
  // A ReLU input that float32 rounds to the other side of zero would be worth about 1e-3.
  for (const char* prefix : {"feature_extractor", "lang_encoder", "lang_decoder", "rgb"}) {
    const std::span<const float> part = run.store.range(StoreRole::kGradients, prefix);
    if (part.empty()) continue;
    CAPTURE(prefix);
    const auto offset = part.data() - run.store.block(StoreRole::kGradients).data();
    CHECK(difference(part, std::span(gradient).subspan(static_cast<std::size_t>(offset),
                                                       part.size())) < 1e-3);
  }
  for (std::size_t i = config.sbd_dpt ? 0 : 3; i < 4; ++i) {
    const auto size = static_cast<std::size_t>(dtaps[i].size());
    CHECK(difference({fast_dtaps[i].data(), size}, {dtaps[i].data(), size}) < 1e-3);
  }
}

TEST_CASE("decoder: gradients are the slopes of the loss, three levels and RGB") {
  check_gradients(small_decoder_config(), {});
}

TEST_CASE("decoder: gradients are the slopes of the loss, one level of six features") {
  ModelConfig config = small_decoder_config();
  config.sbd_levels = 1;
  config.lang_dim = 6;
  check_gradients(config, {});
}

TEST_CASE("decoder: gradients are the slopes of the loss in the ablations") {
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

TEST_CASE("decoder: gradients are the slopes of the loss for targets of another size") {
  ModelConfig config = small_decoder_config();
  config.sbd_levels = 1;
  SUBCASE("UNets") {}
  SUBCASE("MLP heads") { config.sbd_head = DecoderHead::kMlp; }
  check_gradients(config, {}, 20, 31);
}

TEST_CASE("decoder: gradients are the slopes of the loss under every option") {
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
  CHECK(difference(parts.copy_of(StoreRole::kGradients), std::vector<double>(g.begin(), g.end())) <
        1e-5);
}

}  // namespace
}  // namespace lvggt
