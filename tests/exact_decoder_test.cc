// SPDX-License-Identifier: Apache-2.0
// The decoder's training in float64: its gradients are sharp enough for finite differences to tell
// any wrong term, and the float32 trainer's are the same but for rounding.
#include <doctest/doctest.h>

#include <cmath>
#include <vector>

#include "lvggt/exact/decoder_trainer.h"
#include "tests/support/random.h"
#include "tests/support/training.h"

namespace lvggt {
namespace {

using test::in_double;
using test::OwnedBatch;
using test::small_decoder_config;
using test::TrainingRun;

// A batch in float64.
struct ExactBatch {
  explicit ExactBatch(const OwnedBatch& data)
      : images(in_double(data.images)),
        mask(in_double(data.mask)),
        features(in_double(data.features)) {
    for (std::size_t i = 0; i < 4; ++i) taps[i] = in_double(data.taps[i]);
    batch = {data.batch.h, data.batch.w, {taps[0], taps[1], taps[2], taps[3]},
             images,       features,     mask};
  }
  std::array<Tensor<double, 3>, 4> taps;
  Tensor<double, 4> images, mask;
  Tensor<double, 5> features;
  BasicDecoderBatch<double> batch;
};

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

void check(const ModelConfig& config, TrainOptions options, std::int64_t H = 28,
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

  const LossTerms fast = run.trainer.evaluate(data.batch, {}, true);
  CHECK(fast.total == doctest::Approx(terms.total).epsilon(1e-6));
  // A ReLU input that float32 rounds to the other side of zero would be worth about 1e-3.
  CHECK(difference(run.store.block(StoreRole::kGradients), gradient) < 1e-3);
}

TEST_CASE("exact decoder: gradients are slopes to 1e-5, and the float32 trainer's are the same") {
  ModelConfig config = small_decoder_config();
  TrainOptions options;
  SUBCASE("three levels and RGB") {}
  SUBCASE("one level of six features") {
    config.sbd_levels = 1;
    config.lang_dim = 6;
  }
  SUBCASE("MLP heads without DPT") {
    config.sbd_head = DecoderHead::kMlp;
    config.sbd_dpt = false;
  }
  SUBCASE("without the RGB head, cosine over the width") {
    config.sbd_rgb = false;
    options.cosine_over_width = true;
  }
  SUBCASE("frozen statistics") { options.frozen_batch_norm = true; }
  check(config, options);
}

TEST_CASE("exact decoder: gradients are slopes to 1e-5 for targets of another size") {
  ModelConfig config = small_decoder_config();
  config.sbd_levels = 1;
  check(config, {}, 20, 31);
}

TEST_CASE(
    "exact decoder: three steps are those of the float32 trainer, one, two or three threads") {
  const ModelConfig config = small_decoder_config();
  TrainOptions options;
  options.schedule.learning_rate = 1e-4;
  std::vector<double> first;
  for (const int threads : {1, 2, 3}) {
    TrainingRun run(config, options, threads);
    OwnedBatch data(config, 2, 2, 3, 28, 42);
    ExactBatch exact(data);
    ExactParameters parameters(run.store);
    ExactDecoderTrainer trainer(parameters, options, run.ctx);
    for (int step = 0; step < 3; ++step) {
      const StepReport fast = run.trainer.step(data.batch), slow = trainer.step(exact.batch);
      CHECK(fast.loss.total == doctest::Approx(slow.loss.total).epsilon(1e-4));
      CHECK(fast.grad_norm == doctest::Approx(slow.grad_norm).epsilon(1e-2));
      CHECK(fast.learning_rate == slow.learning_rate);
    }
    CHECK(difference(run.store.block(StoreRole::kBuffers), parameters.block(StoreRole::kBuffers)) <
          1e-3);
    const std::span<double> weights = parameters.block(StoreRole::kWeights);
    if (first.empty()) first.assign(weights.begin(), weights.end());
    CHECK(std::ranges::equal(weights, first));
  }
}

TEST_CASE("exact decoder: options it does not compute are refused") {
  Context ctx(1);
  const ModelConfig config = small_decoder_config();
  ParameterStore store(config, true);
  ExactParameters parameters(store);
  TrainOptions options;
  SUBCASE("parts") { options.accumulate = 2; }
  SUBCASE("average") { options.ema_decay = 0.9; }
  CHECK_THROWS_AS(ExactDecoderTrainer(parameters, options, ctx), Error);
}

}  // namespace
}  // namespace lvggt
