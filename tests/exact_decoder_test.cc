// SPDX-License-Identifier: Apache-2.0
// The decoder's training in float64; its gradients are in decoder_gradient_test.cc.
#include <doctest/doctest.h>

#include <algorithm>
#include <vector>

#include "lvggt/exact/decoder_trainer.h"
#include "tests/support/compare.h"
#include "tests/support/exact_batch.h"
#include "tests/support/training.h"

namespace lvggt {
namespace {

using test::ExactBatch;
using test::OwnedBatch;
using test::small_decoder_config;
using test::TrainingRun;

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
    const std::span<const float> fast = run.store.block(StoreRole::kBuffers);
    const std::span<double> slow = parameters.block(StoreRole::kBuffers);
    CHECK_CLOSE((View<const float, 1>(fast.data(), Shape{std::ssize(fast)})),
                (View<const double, 1>(slow.data(), Shape{std::ssize(slow)})), 1e-4, 1e-3);
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
  SUBCASE("average") { options.ema_decay = 0.9; }
  SUBCASE("judge") {
    options.judge = [](const LossTerms&, double) { return std::nullopt; };
  }
  CHECK_THROWS_AS(ExactDecoderTrainer(parameters, options, ctx), Error);
}

}  // namespace
}  // namespace lvggt
