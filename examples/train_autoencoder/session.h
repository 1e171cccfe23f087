// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "examples/train_autoencoder/features.h"
#include "examples/train_autoencoder/options.h"
#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/progress.h"
#include "lvggt/language/autoencoder_trainer.h"
#include "lvggt/train/checkpoint.h"
#include "lvggt/train/training_log.h"

namespace train_autoencoder {

inline constexpr const char* kAutoencoderFile = "autoencoder.safetensors";

// One training from its start, or its newest checkpoint, to its end.
class Session {
 public:
  Session(const Options& options, const FeatureSet& set, const lvggt::AutoencoderShape& shape,
          const lvggt::cli::InterruptGuard& interrupt, lvggt::Context& ctx);

  // Trains; true when all epochs are done, false after an interrupt.
  bool run();

  std::int64_t epochs() const { return epoch_; }
  std::int64_t best_epoch() const { return best_epoch_; }
  double best_score() const { return best_score_; }
  // The last test on the held-out features, if there are any.
  const std::optional<lvggt::AutoencoderLoss>& held_out() const { return held_out_; }

 private:
  void start();
  lvggt::TrainingState state() const;
  lvggt::AutoencoderLoss train_epoch();
  void test(lvggt::LogLine& line);
  void write_best();
  void save_checkpoint();
  void draw_curves();
  std::string file(const std::string& name) const { return options_.output + "/" + name; }

  const Options& options_;
  const FeatureSet& set_;
  lvggt::AutoencoderShape shape_;
  const lvggt::cli::InterruptGuard& interrupt_;
  lvggt::Context& ctx_;
  lvggt::ParameterStore store_;
  lvggt::AutoencoderTrainer trainer_;
  lvggt::TrainingCheckpoints checkpoints_;
  std::optional<lvggt::TrainingLog> log_;
  lvggt::cli::Progress progress_;
  std::optional<lvggt::AutoencoderLoss> held_out_;

  std::int64_t epoch_ = 0;  // done
  std::int64_t best_epoch_ = -1, saved_ = -1;
  double best_score_ = 0;
};

}  // namespace train_autoencoder
