// SPDX-License-Identifier: Apache-2.0
#include "examples/train_decoder/session.h"

#include <algorithm>
#include <cmath>
#include <cstdio>

#include "lvggt/cli/output_folder.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/io/png.h"
#include "lvggt/train/training_tensors.h"

namespace train_decoder {

using namespace lvggt;

namespace {

std::string number(auto value) {
  std::string text;
  append_number(text, value);
  return text;
}

template <class T>
void read_number(const TrainingState& state, const char* key, T& value) {
  const auto text = state.values.find(key);
  if (text == state.values.end() || !cli::parse_number(std::string_view(text->second), value))
    fail(ErrorKind::kFormat, "the checkpoint's state has no number '", key, "'");
}

std::string read_text(const TrainingState& state, const char* key) {
  const auto text = state.values.find(key);
  return text == state.values.end() ? std::string() : text->second;
}

}  // namespace

Session::Session(const Options& options, const Setup& setup, Ranks& ranks,
                 const cli::InterruptGuard& interrupt, RunRecord& record, Context& ctx)
    : options_(options),
      setup_(setup),
      ranks_(ranks),
      interrupt_(interrupt),
      record_(record),
      ctx_(ctx),
      store_(setup.config, setup.train.ema_decay > 0),
      trainer_(store_, judged(setup.train), ranks.communicator(), ctx),
      held_out_(setup.set, setup.config, options.sheet_columns),
      progress_(!ranks.first()) {}

void Session::warn(const std::string& sentence) {
  record_.warnings.push_back(sentence);
  if (!ranks_.first()) return;
  progress_.clear();
  std::fprintf(stderr, "train_decoder: warning: %s\n", sentence.c_str());
}

TrainingState Session::state() const {
  TrainingState state;
  state.step = trainer_.steps();
  state.config = to_json(setup_.config);
  state.data_manifest = setup_.set.manifest_sha256();
  state.settings = options_.settings();
  state.surroundings = {{"threads", number(ctx_.num_threads())}, {"ranks", number(ranks_.size())}};
  state.values = {{"epoch", number(position_.epoch)},
                  {"batch", number(position_.batch)},
                  {"tested", number(tested_)},
                  {"best_step", number(best_step_)},
                  {"best_score", number(best_score_)},
                  {"refused", number(refused_)},
                  {"refused_in_a_row", number(refused_in_a_row_)},
                  {"refused_in_epoch", number(refused_in_epoch_)},
                  {"refused_epoch", number(refused_epoch_)},
                  {"frames_without_label", number(frames_without_label_)},
                  {"losses", losses_.text()},
                  {"norms", norms_.text()}};
  return state;
}

void Session::restore(const TrainingState& state) {
  read_number(state, "epoch", position_.epoch);
  read_number(state, "batch", position_.batch);
  read_number(state, "tested", tested_);
  read_number(state, "best_step", best_step_);
  read_number(state, "best_score", best_score_);
  read_number(state, "refused", refused_);
  read_number(state, "refused_in_a_row", refused_in_a_row_);
  read_number(state, "refused_in_epoch", refused_in_epoch_);
  read_number(state, "refused_epoch", refused_epoch_);
  read_number(state, "frames_without_label", frames_without_label_);
  losses_ = OutlierDetector::parse(read_text(state, "losses"));
  norms_ = OutlierDetector::parse(read_text(state, "norms"));
  trainer_.resume_at(state.step);
  saved_ = state.step;
}

std::string Session::start() {
  checkpoints_.emplace(
      TrainingCheckpoints::Options{file("checkpoints"), options_.keep, LVGGT_VERSION});
  std::optional<TrainingCheckpoints::Loaded> loaded;
  if (options_.resume)
    loaded = checkpoints_->load_newest(training_tensors(store_), state(), options_.force);
  if (loaded) {
    restore(loaded->state);
    for (const std::string& warning : loaded->warnings) warn(warning);
  } else {
    if (options_.decoder.empty())
      store_.initialise(options_.seed, ctx_);
    else
      store_.load(Safetensors::open(options_.decoder));
    if (store_.has_average()) store_.start_average();
  }
  if (ranks_.first()) {
    checkpoints_->check_space(training_tensors(store_), 2);
    log_.emplace(loaded ? TrainingLog::resume(file(kLogFile), trainer_.steps())
                        : TrainingLog::start(file(kLogFile)));
    if (loaded)
      std::fprintf(stderr, "train_decoder: goes on after step %lld from %s\n",
                   static_cast<long long>(trainer_.steps()), loaded->path.c_str());
    else if (options_.resume)
      std::fprintf(stderr, "train_decoder: there is no checkpoint yet, so training starts anew\n");
  }
  return training_sha256(store_);
}

// The same options; with --outlier-z, steps far off the last ones are refused.
TrainOptions Session::judged(const TrainOptions& options) {
  TrainOptions with_judge = options;
  if (options_.outlier_z > 0)
    with_judge.judge = [this](const LossTerms& loss, double norm) { return judge(loss, norm); };
  return with_judge;
}

std::optional<std::string> Session::judge(const LossTerms& loss, double grad_norm) {
  const auto loss_z = losses_.add(loss.total), norm_z = norms_.add(grad_norm);
  for (const auto& [what, z] : {std::pair{"loss", loss_z}, {"gradient norm", norm_z}})
    if (z && *z > options_.outlier_z)
      return concat("the ", what, " is ", cli::fixed(*z, 1),
                    " standard deviations above the last ones (--outlier-z)");
  return std::nullopt;
}

void Session::test() {
  tested_ = trainer_.steps();
  if (held_out_.empty()) return;
  HeldOut::Result result =
      held_out_.test(trainer_, store_.has_average(), tested_, ranks_.communicator());
  const bool best = best_step_ < 0 || result.scores.ranking() > best_score_;
  if (best) {
    best_step_ = tested_;
    best_score_ = result.scores.ranking();
  }
  if (!ranks_.first()) return;
  LogLine line(tested_);
  result.scores.add_to(line);
  log_->append(line);
  const std::string digits = std::to_string(tested_);
  write_png(file("held_out_" + std::string(digits.size() < 6 ? 6 - digits.size() : 0, '0') +
                 digits + ".png"),
            result.sheet);
  write_file(file("held_out.json"), result.scores.json(tested_));
  if (best) write_decoder("best.safetensors");
  progress_.clear();
  std::fprintf(stderr, "step %s: %s%s\n", digits.c_str(), result.scores.text().c_str(),
               best ? " (best so far)" : "");
}

void Session::write_decoder(const std::string& name) {
  SafetensorsWriter out(file(name));
  out.set_metadata("format", "pt");
  out.set_metadata("config", to_json(setup_.config));
  out.set_metadata("origin", concat("trained by train_decoder ", LVGGT_VERSION, ", step ",
                                    trainer_.steps(), ", ", options_.supervision, " supervision"));
  store_.write(out, store_.has_average());
  out.finish();
}

void Session::save_checkpoint() {
  if (saved_ == trainer_.steps()) return;
  if (ranks_.first()) {
    const auto best = best_step_ >= 0 ? std::optional(best_step_) : std::nullopt;
    const auto tensors = training_tensors(store_);
    try {
      checkpoints_->save(state(), tensors, best);
    } catch (const Error& error) {
      fail(error.kind(), error.what(),
           saved_ >= 0 ? concat("; the checkpoint of step ", saved_, " stays valid") : "");
    }
    if (checkpoints_->free_bytes() < TrainingCheckpoints::file_bytes(tensors))
      warn("the disk has no room for the next checkpoint; free some, or training will stop there");
  }
  saved_ = trainer_.steps();
}

void Session::look_back(bool interrupted) {
  const std::int64_t done = trainer_.steps();
  const bool last = done >= setup_.total_steps;
  // An interrupted run tests when it is resumed: stopping is more urgent.
  if (!interrupted && done > 0 && tested_ != done && (done % setup_.evaluate_every == 0 || last))
    test();
  if ((done > 0 && done % setup_.checkpoint_every == 0) || best_step_ == done || last ||
      interrupted)
    save_checkpoint();
}

void Session::count_refused(const StepReport& report) {
  if (position_.epoch != refused_epoch_) {
    refused_epoch_ = position_.epoch;
    refused_in_epoch_ = 0;
  }
  if (!report.refused) {
    refused_in_a_row_ = 0;
    return;
  }
  ++refused_;
  ++refused_in_a_row_;
  ++refused_in_epoch_;
  warn(concat("step ", trainer_.steps() + 1, " is refused: ", *report.refused, " (", refused_,
              " refused so far)"));
  const std::int64_t share = std::max(options_.max_refused, setup_.steps_per_epoch / 100);
  const auto stays = saved_ >= 0 ? concat("; the checkpoint of step ", saved_, " stays as it was")
                                 : std::string("; there is no checkpoint yet");
  if (refused_in_a_row_ >= options_.max_refused)
    fail(ErrorKind::kNumeric, refused_in_a_row_, " steps in a row were refused, the last because ",
         *report.refused, stays);
  if (refused_in_epoch_ > share)
    fail(ErrorKind::kNumeric, refused_in_epoch_,
         " steps of one epoch were refused, the last because ", *report.refused, stays);
}

void Session::report_step(const StepReport& report, const Batch& batch, double seconds) {
  if (!ranks_.first()) return;
  LogLine line(report.refused ? trainer_.steps() + 1 : trainer_.steps());
  line.add("epoch", batch.position().epoch);
  if (report.refused) line.add("refused", *report.refused);
  line.add("loss", report.loss.total);
  line.add("l1", report.loss.l1);
  line.add("cos", report.loss.cos);
  line.add("rgb_l1", report.loss.img_l1);
  line.add("rgb_l2", report.loss.img_l2);
  line.add("grad_norm", report.grad_norm);
  line.add("learning_rate", report.learning_rate);
  line.add("labelled_pixels", report.labelled_pixels);
  line.add("frames_without_label", report.frames_without_label);
  line.add("seconds", seconds);
  log_->append(line);
  seconds_per_step_ = seconds_per_step_ == 0 ? seconds : 0.9 * seconds_per_step_ + 0.1 * seconds;
  progress_.show(trainer_.steps(), setup_.total_steps, report, seconds_per_step_);
}

void Session::step() {
  const auto start = std::chrono::steady_clock::now();
  const Batch batch = loader_->next();
  for (const std::string& skipped : batch.skipped()) warn("skipped: " + skipped);
  const StepReport report = trainer_.step(batch.view());
  position_ = loader_->position();
  frames_without_label_ += report.frames_without_label;
  const std::chrono::duration<double> seconds = std::chrono::steady_clock::now() - start;
  report_step(report, batch, seconds.count());
  count_refused(report);
}

int Session::run() {
  loader_.emplace(setup_.set, setup_.loader, position_);
  bool interrupted = false;
  for (;;) {
    // All ranks stop after the same step, whichever was asked to.
    interrupted = ranks_.communicator().any(interrupt_.requested());
    look_back(interrupted);
    if (interrupted || trainer_.steps() >= setup_.total_steps) break;
    step();
    record_.steps = trainer_.steps();
    record_.refused_steps = refused_;
    record_.frames_without_label = frames_without_label_;
  }
  return finish(interrupted && trainer_.steps() < setup_.total_steps);
}

int Session::finish(bool interrupted) {
  progress_.clear();
  record_.steps = trainer_.steps();
  if (best_step_ >= 0) {
    record_.best_step = best_step_;
    record_.best_score = best_score_;
  }
  record_.status = interrupted ? "interrupted" : "complete";
  if (ranks_.first()) {
    const std::vector<Json> lines = read_log(file(kLogFile));
    write_png(file("loss.png"), draw_loss_curve(lines, "training"));
    if (options_.csv) write_file(file("log.csv"), log_csv(lines));
    if (!interrupted) write_decoder("decoder.safetensors");
    if (frames_without_label_ > 0)
      std::fprintf(stderr, "train_decoder: %lld frames had no label and gave RGB loss only\n",
                   static_cast<long long>(frames_without_label_));
    if (interrupted)
      std::fprintf(stderr,
                   "train_decoder: interrupted after step %lld of %lld, a checkpoint is in %s; "
                   "--resume continues\n",
                   static_cast<long long>(trainer_.steps()),
                   static_cast<long long>(setup_.total_steps), options_.output.c_str());
    else
      std::fprintf(stderr, "train_decoder: %lld steps are done, the decoder is %s\n",
                   static_cast<long long>(trainer_.steps()), file("decoder.safetensors").c_str());
  }
  return interrupted ? exit_code(ErrorKind::kInterrupted) : 0;
}

}  // namespace train_decoder
