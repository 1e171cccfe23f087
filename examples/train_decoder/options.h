// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/data/split.h"
#include "lvggt/data/training_set.h"
#include "lvggt/model/config.h"
#include "lvggt/train/checkpoint.h"
#include "lvggt/train/train_options.h"

namespace train_decoder {

// The options of the program, as they are parsed; the defaults are the recipe of the release.
struct Options {
  // Data.
  std::vector<std::string> scenes;  // folders
  std::string list;                 // file that names more of them
  std::string tokens, weights;
  std::string supervision = "clip", target = "frame";
  std::int64_t dim = 0;  // 0: 3 for clip, 6 for dynamic
  std::string train_frames, held_out_frames;
  std::int64_t hold_out_every = 0;
  bool skip_label_check = false;

  // Model.
  std::string config, decoder, head;
  std::string decoder_sha256;             // of the file to start from; settle() fills it
  std::int64_t features = 0, hidden = 0;  // 0: as the configuration says
  std::vector<std::int64_t> out_channels;
  bool no_dpt = false, no_rgb = false;

  // Losses, optimiser and schedule.
  lvggt::TrainOptions train;
  double alpha = 1, beta = 1;  // weights of the language and of the RGB loss
  std::string cosine_axis = "feature", schedule = "constant", batch_norm = "synchronised";
  std::int64_t batch = 8, epochs = 0, steps = 0;
  double warmup_epochs = 20;
  std::int64_t warmup_steps = -1;  // below 0: warmup_epochs
  std::uint64_t seed = 0;
  bool keep_last_batch = false;
  bool checkpoint_activations = false;
  double outlier_z = 0;  // 0: no step is refused for being an outlier

  // Running.
  std::string output;
  bool resume = false, force = false, dry_run = false, csv = false;
  std::int64_t evaluate_every = 0, checkpoint_every = 0, keep = 3;  // 0: once an epoch, or so
  std::int64_t sheet_columns = 8, max_refused = 10;
  std::int64_t loader_threads = 1;
  int threads = 0;
  double rank_timeout = 60;
  std::size_t memory_limit = 0;

  // After parsing: words become what the library takes. Throws kUsage.
  void settle();

  lvggt::TrainingSetOptions training_set() const;

  // The decoder's configuration: that of --config, or of the checkpoint to start from, or the
  // published one; with the encoder's sizes of the tokens and what the options say.
  lvggt::ModelConfig decoder_config(const lvggt::ModelConfig& encoder) const;

  // Everything the trajectory depends on beside the data, the configuration and the machine.
  lvggt::TrainingState::Named settings() const;
};

}  // namespace train_decoder
