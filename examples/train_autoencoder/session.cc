// SPDX-License-Identifier: Apache-2.0
#include "examples/train_autoencoder/session.h"

#include <algorithm>
#include <charconv>
#include <cstdio>
#include <filesystem>

#include "lvggt/data/sample_order.h"
#include "lvggt/field/line_plot.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/io/png.h"
#include "lvggt/train/training_tensors.h"

namespace train_autoencoder {

using namespace lvggt;

namespace {

template <class T>
void read_number(const TrainingState& state, const char* name, T& value) {
  const auto found = state.values.find(name);
  if (found == state.values.end()) return;
  const std::string& text = found->second;
  std::from_chars(text.data(), text.data() + text.size(), value);
}

template <class T>
std::string number(T value) {
  std::string text;
  append_number(text, value);
  return text;
}

}  // namespace

Session::Session(const Options& options, const FeatureSet& set, const AutoencoderShape& shape,
                 const cli::InterruptGuard& interrupt, Context& ctx)
    : options_(options),
      set_(set),
      shape_(shape),
      interrupt_(interrupt),
      ctx_(ctx),
      store_(autoencoder_tensors(shape)),
      trainer_(store_, shape, options.train(), ctx),
      checkpoints_({options.output + "/checkpoints", 1, LVGGT_VERSION}),
      progress_(options.epochs, "epochs") {}

TrainingState Session::state() const {
  TrainingState state;
  state.step = trainer_.steps();
  state.config = json_quote(to_text(shape_));
  state.data_manifest = set_.sha256;
  state.settings = options_.settings();
  state.surroundings = {{"threads", number(ctx_.num_threads())}};
  state.values = {{"epoch", number(epoch_)},
                  {"best_epoch", number(best_epoch_)},
                  {"best_score", number(best_score_)}};
  return state;
}

void Session::start() {
  std::optional<TrainingCheckpoints::Loaded> loaded;
  if (options_.resume) loaded = checkpoints_.load_newest(training_tensors(store_), state(), false);
  if (!loaded) {
    store_.initialise(options_.seed, ctx_);
    log_.emplace(TrainingLog::start(file("log.jsonl")));
    return;
  }
  for (const std::string& warning : loaded->warnings)
    std::fprintf(stderr, "train_autoencoder: warning: %s\n", warning.c_str());
  read_number(loaded->state, "epoch", epoch_);
  read_number(loaded->state, "best_epoch", best_epoch_);
  read_number(loaded->state, "best_score", best_score_);
  trainer_.resume_at(loaded->state.step);
  saved_ = loaded->state.step;
  log_.emplace(TrainingLog::resume(file("log.jsonl"), epoch_));
  std::fprintf(stderr, "train_autoencoder: goes on after epoch %lld from %s\n",
               static_cast<long long>(epoch_), loaded->path.c_str());
}

// All features once, in an order of the epoch's own; a last batch of one has no statistics.
AutoencoderLoss Session::train_epoch() {
  const std::int64_t N = set_.train.extent(0), D = set_.train.extent(1);
  const std::vector<std::int64_t> order = shuffled(N, options_.seed, epoch_);
  AutoencoderLoss sum;
  double rows = 0;
  for (std::int64_t begin = 0; begin < N; begin += options_.batch) {
    const std::int64_t count = std::min(options_.batch, N - begin);
    if (count < 2) break;
    Arena::Scope scope(ctx_.arena());
    const View<float, 2> batch = ctx_.arena().alloc(Shape{count, D});
    for (std::int64_t i = 0; i < count; ++i)
      std::copy_n(set_.train[order[static_cast<std::size_t>(begin + i)]].data(), D,
                  batch[i].data());
    const AutoencoderLoss loss = trainer_.step(batch);
    sum.l2 += loss.l2 * static_cast<double>(count);
    sum.cos += loss.cos * static_cast<double>(count);
    rows += static_cast<double>(count);
  }
  return {sum.l2 / rows, sum.cos / rows};
}

// Evaluation mode: the candidates of the last epochs, and what is held out.
void Session::test(LogLine& line) {
  const bool candidate = epoch_ > options_.epochs - options_.candidates;
  const bool has_held_out = set_.held_out.extent(0) > 0;
  if (!candidate && !has_held_out) return;
  const Autoencoder autoencoder = trainer_.autoencoder();
  if (has_held_out) {
    held_out_ = evaluate_autoencoder(autoencoder, set_.held_out, ctx_);
    line.add("held_out_l2", held_out_->l2);
    line.add("held_out_cos", held_out_->cos);
  }
  if (!candidate) return;
  const double score = evaluate_autoencoder(autoencoder, set_.train, ctx_).total(1);
  line.add("evaluated", score);
  if (best_epoch_ >= 0 && score >= best_score_) return;
  best_epoch_ = epoch_;
  best_score_ = score;
  write_best();
}

void Session::write_best() {
  SafetensorsWriter out(file(kAutoencoderFile));
  out.set_metadata("format", "pt");
  out.set_metadata("widths", to_text(shape_));
  out.set_metadata("origin", concat("trained by train_autoencoder ", LVGGT_VERSION, ", epoch ",
                                    epoch_, ", ", options_.supervision, " features"));
  store_.write(out);
  out.finish();
}

void Session::save_checkpoint() {
  if (saved_ == trainer_.steps()) return;
  checkpoints_.save(state(), training_tensors(store_));
  saved_ = trainer_.steps();
}

void Session::draw_curves() {
  const std::vector<Json> lines = read_log(file("log.jsonl"));
  const auto panel = [&](const char* title, const char* train, const char* held_out) {
    PlotPanel result{title, "epoch", {}, true};
    result.curves.push_back({"training", Rgb8{31, 119, 180}, log_curve(lines, train), false});
    const auto points = log_curve(lines, held_out);
    if (!points.empty()) result.curves.push_back({"held out", Rgb8{225, 110, 10}, points, false});
    return result;
  };
  constexpr std::int64_t kWidth = 840, kPanelHeight = 230;
  write_png(file("loss.png"), LinePlot(kWidth, kPanelHeight)
                                  .draw({panel("mean squared error", "l2", "held_out_l2"),
                                         panel("1 - mean cosine", "cos", "held_out_cos")}));
}

bool Session::run() {
  start();
  while (epoch_ < options_.epochs && !interrupt_.requested()) {
    const AutoencoderLoss loss = train_epoch();
    ++epoch_;
    LogLine line(epoch_);
    line.add("total", loss.total(options_.cosine_weight));
    line.add("l2", loss.l2);
    line.add("cos", loss.cos);
    test(line);
    log_->append(line);
    progress_.show(epoch_);
    if (epoch_ % options_.checkpoint_every == 0 && epoch_ < options_.epochs) save_checkpoint();
  }
  progress_.clear();
  const bool done = epoch_ >= options_.epochs;
  if (!done) save_checkpoint();
  draw_curves();
  // A finished training needs no state to go on from; the log and the best weights stay.
  if (done) checkpoints_.remove_all();
  return done;
}

}  // namespace train_autoencoder
