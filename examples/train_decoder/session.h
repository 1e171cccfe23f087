// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <chrono>
#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "examples/train_decoder/held_out.h"
#include "examples/train_decoder/progress.h"
#include "examples/train_decoder/ranks.h"
#include "examples/train_decoder/record.h"
#include "examples/train_decoder/setup.h"
#include "lvggt/cli/interrupt.h"
#include "lvggt/data/sample_loader.h"
#include "lvggt/train/checkpoint.h"
#include "lvggt/train/decoder_trainer.h"
#include "lvggt/train/outlier.h"
#include "lvggt/train/parameter_store.h"
#include "lvggt/train/training_log.h"

namespace train_decoder {

// The name of a file in the output folder.
inline constexpr const char* kLogFile = "log.jsonl";

// One training from its start, or from its newest checkpoint, to its end: the loop over the steps
// with tests, checkpoints, log and pictures. Only rank 0 writes; all ranks go through the same
// steps.
class Session {
 public:
  Session(const Options& options, const Setup& setup, Ranks& ranks,
          const lvggt::cli::InterruptGuard& interrupt, RunRecord& record, lvggt::Context& ctx);

  // Sets weights and position: from the newest checkpoint with --resume, else from the decoder to
  // start from or the seed. Returns a hash of all of it, which must be the same on every rank.
  std::string start();

  // Trains to the end or to the interrupt; the exit status.
  int run();

 private:
  lvggt::TrainingState state() const;
  void restore(const lvggt::TrainingState& state);
  void warn(const std::string& sentence);

  // What is due after the steps so far: test, checkpoint.
  void look_back(bool interrupted);
  void test();
  void save_checkpoint();
  void write_decoder(const std::string& name);

  void step();
  void report_step(const lvggt::StepReport& report, const lvggt::Batch& batch, double seconds);
  lvggt::TrainOptions judged(const lvggt::TrainOptions& options);
  void count_refused(const lvggt::StepReport& report);
  std::optional<std::string> judge(const lvggt::LossTerms& loss, double grad_norm);
  int finish(bool interrupted);
  std::string file(const std::string& name) const { return options_.output + "/" + name; }

  const Options& options_;
  const Setup& setup_;
  Ranks& ranks_;
  const lvggt::cli::InterruptGuard& interrupt_;
  RunRecord& record_;
  lvggt::Context& ctx_;

  lvggt::ParameterStore store_;
  lvggt::DecoderTrainer trainer_;
  std::optional<lvggt::TrainingCheckpoints> checkpoints_;
  std::optional<lvggt::TrainingLog> log_;  // on rank 0
  std::optional<lvggt::SampleLoader> loader_;
  HeldOut held_out_;
  Progress progress_;

  // Part of the state that checkpoints carry.
  lvggt::LoaderPosition position_;
  std::int64_t tested_ = -1, best_step_ = -1;
  double best_score_ = 0;
  std::int64_t refused_ = 0, refused_in_a_row_ = 0, refused_in_epoch_ = 0, refused_epoch_ = 0;
  std::int64_t frames_without_label_ = 0;
  lvggt::OutlierDetector losses_, norms_;

  std::int64_t saved_ = -1;  // the step of the newest checkpoint
  double seconds_per_step_ = 0;
};

}  // namespace train_decoder
