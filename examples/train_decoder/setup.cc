// SPDX-License-Identifier: Apache-2.0
#include "examples/train_decoder/setup.h"

#include <algorithm>
#include <cmath>

#include "lvggt/cli/memory.h"
#include "lvggt/cli/memory_check.h"
#include "lvggt/cli/program.h"
#include "lvggt/data/token_cache.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/model/checkpoint.h"
#include "lvggt/model/tensor_list.h"

namespace train_decoder {

using namespace lvggt;

namespace {

void find_largest_frame(Setup& setup) {
  for (const Part part : {Part::kTrain, Part::kHeldOut})
    for (const Sample& sample : setup.set.samples(part)) {
      if (sample.h * sample.w > setup.largest_h * setup.largest_w) {
        setup.largest_h = sample.h;
        setup.largest_w = sample.w;
      }
      if (sample.H * sample.W > setup.largest_H * setup.largest_W) {
        setup.largest_H = sample.H;
        setup.largest_W = sample.W;
      }
    }
}

TrainingMemory plan_steps(const Setup& setup, std::int64_t batch, std::int64_t accumulate,
                          CheckpointActivations activations) {
  TrainOptions train = setup.train;
  train.accumulate = accumulate;
  train.activations = activations;
  return plan_training(setup.config, train, batch, setup.largest_h, setup.largest_w,
                       setup.largest_H, setup.largest_W);
}

Plan make_plan(const Setup& setup, const Options& options, int num_ranks) {
  Plan plan;
  plan.training = plan_steps(setup, options.batch / num_ranks, options.train.accumulate,
                             setup.train.activations);
  plan.batches = SampleLoader::planned_bytes(setup.set, setup.loader);
  const auto pixels = static_cast<std::size_t>(setup.largest_H * setup.largest_W);
  const auto values = static_cast<std::size_t>(setup.config.sbd_levels * setup.config.lang_dim);
  const auto taps =
      static_cast<std::size_t>(4 * setup.largest_h * setup.largest_w * 2 * setup.config.embed_dim);
  // The sheet keeps up to twice its columns, then draws and compresses them.
  const std::int64_t cell_width = std::min<std::int64_t>(setup.largest_W, kSheetCellWidth);
  const std::int64_t cell_height = cell_width * setup.largest_H / setup.largest_W + 1;
  const auto cells = static_cast<std::size_t>(4 * options.sheet_columns * cell_width * cell_height *
                                              3 * (3 + 2 * setup.config.sbd_levels));
  plan.testing = setup.set.samples(Part::kHeldOut).empty()
                     ? 0
                     : 4 * (taps + pixels * (2 * values + 12)) + cells;
  plan.program = std::size_t{32} << 20;
  return plan;
}

void settle_length(Setup& setup, Options& options) {
  const SampleLoader counter(setup.set, setup.loader);
  setup.steps_per_epoch = counter.batches_per_epoch();
  setup.total_steps = options.steps > 0 ? options.steps : options.epochs * setup.steps_per_epoch;
  if (options.warmup_steps < 0) {
    options.warmup_steps =
        std::llround(options.warmup_epochs * static_cast<double>(setup.steps_per_epoch));
    // A run that is shorter than the release's warm-up would never reach its rate.
    options.warmup_steps = std::min(options.warmup_steps, setup.total_steps / 5);
  }
  options.train.schedule.warmup_steps = options.warmup_steps;
  options.train.schedule.total_steps = setup.total_steps;
  validate_schedule(options.train.schedule);
  setup.train = options.train;
  setup.evaluate_every = options.evaluate_every > 0
                             ? options.evaluate_every
                             : std::max<std::int64_t>(1, (setup.total_steps + 9) / 10);
  setup.checkpoint_every =
      options.checkpoint_every > 0 ? options.checkpoint_every : setup.evaluate_every;
}

}  // namespace

std::string Plan::breakdown() const {
  using cli::bytes_text;
  return "parameters and optimiser " + bytes_text(training.parameters) + ", activations " +
         bytes_text(training.activations) + ", batches read ahead " + bytes_text(batches) +
         ", testing " + bytes_text(testing) + ", the program " + bytes_text(program);
}

Setup prepare(Options& options, int rank, int num_ranks, Context& ctx) {
  if (options.batch % num_ranks != 0)
    fail(ErrorKind::kUsage, "--batch: ", options.batch, " frames cannot be divided among ",
         num_ranks, " ranks");
  TrainingSetOptions set = options.training_set();
  if (!options.weights.empty()) {
    LoadOptions load;
    load.weights = options.weights;
    set.encoder_sha256 = encoder_sha256(Checkpoint(load), ctx);
  }
  Setup setup{.set = TrainingSet::open(set, ctx)};
  const TokenManifest& tokens =
      setup.set.tokens(setup.set.samples(Part::kTrain).front()).manifest();
  setup.config = options.decoder_config(tokens.settings.config);
  find_largest_frame(setup);

  setup.loader.order.batch_size = options.batch;
  setup.loader.order.seed = options.seed;
  setup.loader.order.last = options.keep_last_batch ? LastBatch::kKeep : LastBatch::kDrop;
  setup.loader.rank = rank;
  setup.loader.num_ranks = num_ranks;
  setup.loader.threads = static_cast<int>(options.loader_threads);
  settle_length(setup, options);
  setup.plan = make_plan(setup, options, num_ranks);
  return setup;
}

void check_plan(const Setup& setup, const Options& options, int ranks_on_machine) {
  cli::MemoryLimit limit;
  if (options.memory_limit > 0) {
    limit = {options.memory_limit, "--memory-limit"};
  } else {
    limit = cli::available_memory();
    limit.bytes /= static_cast<std::size_t>(ranks_on_machine);
    if (ranks_on_machine > 1)
      limit.reason += concat(", a part for each of ", ranks_on_machine, " ranks");
  }
  const std::size_t needed = setup.plan.total();
  if (needed <= limit.bytes) return;
  const std::size_t rest = needed - setup.plan.training.activations;
  const std::int64_t batch = options.batch / std::max(1, setup.loader.num_ranks);
  const auto fits = [&](std::int64_t accumulate, CheckpointActivations activations) {
    return rest + plan_steps(setup, batch, accumulate, activations).activations <= limit.bytes;
  };
  std::string advice;
  if (fits(options.train.accumulate, CheckpointActivations::kRecompute))
    advice = "--checkpoint-activations";
  for (std::int64_t parts = options.train.accumulate + 1; parts <= batch; ++parts) {
    if (batch % parts != 0 || !fits(parts, setup.train.activations)) continue;
    advice += concat(advice.empty() ? "" : " or ", "--accumulate ", parts,
                     " (batch norms then see the statistics of ", batch / parts, " frames)");
    break;
  }
  fail(ErrorKind::kMemory, "training needs about ", cli::bytes_text(needed), " (", needed,
       " bytes) of memory (", setup.plan.breakdown(), "), but it may have ",
       cli::bytes_text(limit.bytes), " (", limit.reason, ")",
       advice.empty() ? "; take a smaller --batch" : "; " + advice + " would fit");
}

std::vector<std::string> describe(const Setup& setup, const Options& options) {
  std::int64_t values = 0;
  for (const TensorSpec& spec : decoder_tensors(setup.config)) values += spec.volume();
  const std::size_t train = setup.set.samples(Part::kTrain).size();
  const std::size_t held_out = setup.set.samples(Part::kHeldOut).size();
  const double epochs =
      static_cast<double>(setup.total_steps) / static_cast<double>(setup.steps_per_epoch);
  std::string rounded;
  append_number(rounded, std::round(10 * epochs) / 10);
  std::vector<std::string> lines{
      concat(train, " frames to train on, ", held_out, " held out, ", setup.largest_W, " x ",
             setup.largest_H, " pixels, ", options.supervision, " supervision with ",
             setup.config.sbd_levels, setup.config.sbd_levels == 1 ? " level of " : " levels of ",
             setup.config.lang_dim, " numbers"),
      concat("decoder of ", values, " values; ", setup.total_steps, " steps of ", options.batch,
             " frames (", rounded, " epochs), the first ", setup.train.schedule.warmup_steps,
             " of them warm-up"),
      concat("memory: about ", cli::bytes_text(setup.plan.total()), " (", setup.plan.total(),
             " bytes): ", setup.plan.breakdown())};
  if (options.train.accumulate > 1)
    lines.push_back(
        concat("--accumulate ", options.train.accumulate, ": batch norms see the statistics of ",
               options.batch / std::max(1, setup.loader.num_ranks) / options.train.accumulate,
               " frames, not of the whole batch"));
  return lines;
}

}  // namespace train_decoder
