// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <optional>
#include <string>
#include <vector>

#include "examples/train_decoder/options.h"
#include "lvggt/cli/threads.h"
#include "lvggt/core/context.h"
#include "lvggt/data/sample_loader.h"
#include "lvggt/data/training_set.h"
#include "lvggt/model/config.h"
#include "lvggt/train/decoder_trainer.h"

namespace train_decoder {

// Width of a picture on the contact sheet, in pixels; smaller ones are shown as they are.
inline constexpr std::int64_t kSheetCellWidth = 176;

// Memory the run will need on one rank.
struct Plan {
  lvggt::TrainingMemory training;
  std::size_t batches = 0;  // read ahead by the loader
  std::size_t testing = 0;  // one held-out frame and the contact sheet
  std::size_t program = 0;  // the program itself and its libraries
  std::size_t total() const {
    return training.parameters + training.activations + batches + testing + program;
  }
  std::string breakdown() const;
};

// What is known before training starts: the data, checked; the decoder's configuration; how long
// the run is and what it needs.
struct Setup {
  lvggt::TrainingSet set;
  lvggt::ModelConfig config = {};
  lvggt::TrainOptions train = {};
  lvggt::LoaderOptions loader = {};
  std::int64_t steps_per_epoch = 0, total_steps = 0;
  std::int64_t evaluate_every = 0, checkpoint_every = 0;
  Plan plan = {};
  std::int64_t largest_h = 0, largest_w = 0, largest_H = 0, largest_W = 0;  // of all frames
};

// Opens and checks the data and settles everything that depends on it; warmup_steps of the options
// becomes the number of steps.
Setup prepare(Options& options, int rank, int num_ranks, lvggt::Context& ctx);

// Refuses, naming what would fit, when the run needs more memory than this rank may have.
void check_plan(const Setup& setup, const Options& options, int ranks_on_machine);

// The plan for people: frames, sizes, steps, memory.
std::vector<std::string> describe(const Setup& setup, const Options& options);

}  // namespace train_decoder
