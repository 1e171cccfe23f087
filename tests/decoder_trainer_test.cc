// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/decoder_trainer.h"

#include <doctest/doctest.h>

#include <barrier>
#include <cmath>
#include <limits>
#include <thread>

#include "lvggt/model/parameters.h"
#include "tests/support/compare.h"
#include "tests/support/temp_dir.h"
#include "tests/support/training.h"

namespace lvggt {
namespace {

using test::OwnedBatch;
using test::small_decoder_config;
using test::TrainingRun;

std::vector<float> everything(const TrainingRun& run) {
  std::vector<float> all;
  for (const StoreRole role : {StoreRole::kWeights, StoreRole::kFirstMoments,
                               StoreRole::kSecondMoments, StoreRole::kAverage, StoreRole::kBuffers})
    for (const float v : run.copy_of(role)) all.push_back(v);
  return all;
}

TEST_CASE("decoder trainer: the loss falls and the report says what was done") {
  TrainOptions options;
  options.schedule.learning_rate = 2e-3;
  options.schedule.warmup_steps = 4;
  options.ema_decay = 0.9;
  TrainingRun run(small_decoder_config(), options);
  run.store.start_average();
  const OwnedBatch data(small_decoder_config(), 2, 2, 3, 28, 42);
  const StepReport first = run.trainer.step(data.batch);
  CHECK(first.learning_rate == doctest::Approx(5e-4));
  CHECK(first.grad_norm > 0);
  CHECK(first.labelled_pixels ==
        std::count(data.mask.data(), data.mask.data() + data.mask.size(), 1));
  CHECK(first.frames_without_label == 0);
  CHECK(first.loss.total == doctest::Approx(0.2 * first.loss.l1 + 0.01 * first.loss.cos +
                                            0.5 * first.loss.img_l1 + 0.5 * first.loss.img_l2));
  StepReport last;
  for (int i = 0; i < 30; ++i) last = run.trainer.step(data.batch);
  CHECK(last.loss.total < 0.9 * first.loss.total);
  CHECK(run.trainer.steps() == 31);
  CHECK(run.copy_of(StoreRole::kAverage) != run.copy_of(StoreRole::kWeights));
}

TEST_CASE("decoder trainer: E18 a loss that is not finite refuses the step and changes nothing") {
  TrainOptions options;
  options.ema_decay = 0.9;
  TrainingRun run(small_decoder_config(), options);
  OwnedBatch data(small_decoder_config(), 2, 2, 3, 28, 42);
  CHECK(!run.trainer.step(data.batch).refused);
  const std::vector<float> before = everything(run);
  std::string term;
  SUBCASE("language") {
    data.features.data()[5] = std::numeric_limits<float>::quiet_NaN();
    data.mask.data()[1] = 1;
    term = "the loss term l1";
  }
  SUBCASE("colour") {
    data.images.data()[7] = std::numeric_limits<float>::infinity();
    term = "the loss term img_l1";
  }
  const StepReport report = run.trainer.step(data.batch);
  REQUIRE(report.refused);
  CHECK(report.refused->starts_with(term));
  CHECK(everything(run) == before);
  CHECK(run.trainer.steps() == 1);
}

TEST_CASE("decoder trainer: E18 a gradient that is not finite refuses the step and is named") {
  TrainOptions options;
  options.loss.img_l2 = 1e300;  // the loss is finite in double, its gradient is not in float
  TrainingRun run(small_decoder_config(), options);
  const OwnedBatch data(small_decoder_config(), 2, 2, 3, 28, 42);
  const std::vector<float> before = everything(run);
  const StepReport report = run.trainer.step(data.batch);
  REQUIRE(report.refused);
  CHECK(report.refused->starts_with("the gradient of "));
  CHECK(everything(run) == before);
  CHECK(run.trainer.steps() == 0);
}

TEST_CASE("decoder trainer: D23 a frame without labels is counted and has RGB terms only") {
  const ModelConfig config = small_decoder_config();
  OwnedBatch data(config, 2, 2, 3, 28, 42);
  std::fill_n(data.mask[1].data(), data.mask[1].size(), 0.0f);
  TrainOptions options;
  options.frozen_batch_norm = true;  // frames do not see each other
  TrainingRun run(config, options);
  const LossTerms both = run.trainer.evaluate(data.batch, {}, true);
  const LossTerms first = run.trainer.evaluate(frames_of(data.batch, 0, 1), {}, true);
  CHECK(both.l1 == doctest::Approx(first.l1).epsilon(1e-6));
  CHECK(both.cos == doctest::Approx(first.cos).epsilon(1e-6));
  CHECK(both.img_l1 != doctest::Approx(first.img_l1).epsilon(1e-3));
  const StepReport report = run.trainer.step(data.batch);
  CHECK(report.frames_without_label == 1);
}

TEST_CASE("decoder trainer: D23 a batch without any label has language terms of 0") {
  const ModelConfig config = small_decoder_config();
  TrainingRun run(config);
  OwnedBatch data(config, 2, 2, 3, 28, 42);
  std::fill_n(data.mask.data(), data.mask.size(), 0.0f);
  const StepReport report = run.trainer.step(data.batch);
  CHECK(!report.refused);
  CHECK(report.frames_without_label == 2);
  CHECK(report.labelled_pixels == 0);
  CHECK(report.loss.l1 == 0);
  CHECK(report.loss.cos == 0);
  CHECK(report.loss.img_l1 > 0);
  for (const float g : run.store.range(StoreRole::kGradients, "lang_encoder")) CHECK(g == 0);
}

TEST_CASE("decoder trainer: batches and options that do not fit are refused") {
  const ModelConfig config = small_decoder_config();
  TrainingRun run(config);
  const OwnedBatch data(config, 1, 2, 3, 28, 42);
  DecoderBatch batch = data.batch;
  batch.h = 3;
  CHECK_THROWS_WITH_AS(run.trainer.step(batch), "training: tap 0 is [1,6,12], expected [1,9,12]",
                       Error);
  ModelConfig one_level = config;
  one_level.sbd_levels = 1;
  const OwnedBatch other(one_level, 1, 2, 3, 28, 42);
  CHECK_THROWS_AS(run.trainer.step(other.batch), Error);
  const auto refused = [&](const TrainOptions& options) {
    CHECK_THROWS_AS(DecoderTrainer(run.store, options, run.alone, run.ctx), Error);
  };
  TrainOptions options;
  options.ema_decay = 0.99;  // the store has no average
  refused(options);
  options = {};
  options.loss.cos = -1;
  refused(options);
  options = {};
  options.accumulate = 0;
  refused(options);
  options = {};
  options.schedule.learning_rate = 0;
  refused(options);
}

TEST_CASE("decoder trainer: a resumed run goes on with the same bits") {
  const ModelConfig config = small_decoder_config();
  TrainOptions options;
  options.schedule = {1e-3, 1e-5, 2, 8, Decay::kCosine};
  TrainingRun whole(config, options), first(config, options), second(config, options);
  const OwnedBatch data(config, 2, 2, 3, 28, 42);
  for (int i = 0; i < 4; ++i) whole.trainer.step(data.batch);
  for (int i = 0; i < 2; ++i) first.trainer.step(data.batch);
  for (const StoreRole role : {StoreRole::kWeights, StoreRole::kFirstMoments,
                               StoreRole::kSecondMoments, StoreRole::kBuffers})
    std::ranges::copy(first.copy_of(role), second.store.block(role).begin());
  second.trainer.resume_at(first.trainer.steps());
  for (int i = 0; i < 2; ++i) second.trainer.step(data.batch);
  CHECK(everything(second) == everything(whole));
}

TEST_CASE("decoder trainer: predictions are those of the written checkpoint in inference") {
  ModelConfig config = small_decoder_config();
  SUBCASE("published") {}
  SUBCASE("ablations") {
    config.sbd_head = DecoderHead::kMlp;
    config.sbd_dpt = false;
  }
  TrainingRun run(config);
  const OwnedBatch data(config, 2, 2, 3, 20, 31);
  for (int i = 0; i < 3; ++i) run.trainer.step(data.batch);
  Tensor<float, 5> language(data.features.shape());
  Tensor<float, 4> rgb(data.images.shape());
  run.trainer.predict({language, rgb}, data.batch);

  test::TempDir dir;
  SafetensorsWriter out(dir / "decoder.safetensors");
  run.store.write(out);
  out.finish();
  ParameterStore read(config);
  read.load(Safetensors::open(dir / "decoder.safetensors"));
  DecoderTrainer trainer(read, {}, run.alone, run.ctx);
  Tensor<float, 5> again(data.features.shape());
  trainer.predict({again, {}}, data.batch);
  CHECK_SAME_BITS(again, language);

  // With frozen statistics the training pass computes the same function.
  TrainOptions frozen;
  frozen.frozen_batch_norm = true;
  DecoderTrainer frozen_trainer(read, frozen, run.alone, run.ctx);
  Tensor<float, 4> trained_rgb(data.images.shape());
  frozen_trainer.evaluate(data.batch, {again, trained_rgb}, false);
  CHECK_CLOSE(again, language, 1e-4);
  CHECK_CLOSE(trained_rgb, rgb, 1e-4);
}

// Two ranks as threads of one process.
class Pair {
 public:
  class Member final : public Communicator {
   public:
    Member(Pair& pair, int rank) : pair_(pair), rank_(rank) {}
    int rank() const override { return rank_; }
    int size() const override { return 2; }
    void sum(std::span<double> values) override { pair_.add(rank_, values); }
    void sum(std::span<float> values) override { pair_.add(rank_, values); }
    void start_sum(std::span<float> bucket) override { started_.push_back(bucket); }
    void finish_sums() override {
      for (const std::span<float> bucket : started_) {
        summed += bucket.size();
        sum(bucket);
      }
      started_.clear();
    }
    bool any(bool value) override {
      std::array<double, 1> count{value ? 1.0 : 0.0};
      sum(std::span<double>(count));
      return count[0] > 0;
    }
    std::size_t summed = 0;

   private:
    Pair& pair_;
    int rank_;
    std::vector<std::span<float>> started_;
  };

 private:
  template <class T>
  void add(int rank, std::span<T> values) {
    given_[static_cast<std::size_t>(rank)].assign(values.begin(), values.end());
    barrier_.arrive_and_wait();
    for (std::size_t i = 0; i < values.size(); ++i)
      values[i] = static_cast<T>(given_[0][i] + given_[1][i]);
    barrier_.arrive_and_wait();
  }
  std::array<std::vector<double>, 2> given_;
  std::barrier<> barrier_{2};
};

TEST_CASE("decoder trainer: two ranks with half a batch each train as one with the whole") {
  const ModelConfig config = small_decoder_config();
  TrainOptions options;
  options.schedule.learning_rate = 1e-3;
  const OwnedBatch data(config, 4, 2, 3, 28, 42);
  TrainingRun whole(config, options, 1);
  const StepReport expected = whole.trainer.step(data.batch);
  Pair pair;
  std::array<StepReport, 2> reports;
  std::array<std::vector<float>, 2> gradients, buffers;
  std::array<std::size_t, 2> summed{};
  const auto rank = [&](int r) {
    const auto i = static_cast<std::size_t>(r);
    Context ctx(1);
    ParameterStore store(config);
    store.initialise(3, ctx);
    Pair::Member member(pair, r);
    DecoderTrainer trainer(store, options, member, ctx);
    reports[i] = trainer.step(frames_of(data.batch, 2 * r, 2 * r + 2));
    const std::span<float> g = store.block(StoreRole::kGradients);
    gradients[i].assign(g.begin(), g.end());
    const std::span<float> b = store.block(StoreRole::kBuffers);
    buffers[i].assign(b.begin(), b.end());
    summed[i] = member.summed;
  };
  std::thread other([&] { rank(1); });
  rank(0);
  other.join();
  CHECK(gradients[0] == gradients[1]);
  CHECK(buffers[0] == buffers[1]);
  CHECK(summed[0] == gradients[0].size());  // every parameter was in one bucket
  CHECK(reports[0].loss.total == doctest::Approx(expected.loss.total).epsilon(1e-6));
  CHECK(reports[0].labelled_pixels == expected.labelled_pixels);
  const std::vector<float> g = whole.copy_of(StoreRole::kGradients);
  double error = 0, size = 0;
  for (std::size_t i = 0; i < g.size(); ++i) {
    error += std::pow(static_cast<double>(gradients[0][i]) - g[i], 2);
    size += std::pow(static_cast<double>(g[i]), 2);
  }
  CHECK(std::sqrt(error / size) < 1e-4);
}

TEST_CASE("decoder trainer: the stated memory is what a step takes, within a tenth") {
  ModelConfig config;
  config.embed_dim = 64;
  config.sbd_features = 32;
  config.sbd_out_channels = {16, 32, 64, 64};
  config.sbd_hidden_dim = 8;
  std::int64_t H = 14 * 9, W = 14 * 11;
  TrainOptions options;
  SUBCASE("kept") {}
  SUBCASE("recomputed") { options.activations = CheckpointActivations::kRecompute; }
  SUBCASE("in parts") { options.accumulate = 2; }
  SUBCASE("another size") { H = 100, W = 90; }
  SUBCASE("MLP heads") { config.sbd_head = DecoderHead::kMlp; }
  SUBCASE("no DPT") { config.sbd_dpt = false; }
  const TrainingMemory plan = plan_training(config, options, 2, 9, 11, H, W);
  TrainingRun run(config, options);
  const OwnedBatch data(config, 2, 9, 11, H, W);
  run.trainer.step(data.batch);
  const auto measured = static_cast<double>(run.ctx.arena().peak_bytes());
  CHECK(static_cast<double>(plan.activations) == doctest::Approx(measured).epsilon(0.1));
  CHECK(static_cast<double>(plan.parameters) ==
        doctest::Approx(static_cast<double>(run.store.num_bytes())).epsilon(0.1));
  CHECK(plan.total == plan.parameters + plan.activations + plan.batch);
}

}  // namespace
}  // namespace lvggt
