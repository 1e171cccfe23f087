// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/cli/program.h"
#include "lvggt/data/split.h"
#include "lvggt/data/supervision.h"
#include "lvggt/language/autoencoder.h"
#include "lvggt/language/autoencoder_trainer.h"

namespace train_autoencoder {

struct Options {
  std::vector<std::string> scenes;
  std::string list;
  std::string supervision = "clip";
  std::string held_out_frames;
  std::int64_t hold_out_every = 0;

  std::vector<std::int64_t> encoder, decoder;    // widths; empty: as published
  double learning_rate = 0, cosine_weight = -1;  // as published
  std::int64_t batch = 64, epochs = 100, candidates = 9;
  std::uint64_t seed = 0;

  std::string output;  // folder of the training
  bool encode = false;
  std::string encode_root;
  bool resume = false, force = false, dry_run = false;
  std::int64_t checkpoint_every = 10;  // epochs
  int threads = 0;
  std::size_t memory_limit = 0;

  // Throws kUsage for what makes no sense together.
  void settle();

  lvggt::Supervision kind() const { return lvggt::parse_supervision(supervision); }
  lvggt::SplitOptions split() const;
  // The widths for features of that width. Errors: kUsage when they do not come back to it.
  lvggt::AutoencoderShape shape(std::int64_t features) const;
  lvggt::AutoencoderTrainOptions train() const;
  // What the result depends on beside the data and the shape.
  std::vector<std::pair<std::string, std::string>> settings() const;
};

void add_options(lvggt::cli::Program& program, Options& options);

}  // namespace train_autoencoder
