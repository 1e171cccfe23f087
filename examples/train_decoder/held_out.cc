// SPDX-License-Identifier: Apache-2.0
#include "examples/train_decoder/held_out.h"

#include <algorithm>
#include <cmath>

#include "examples/train_decoder/setup.h"
#include "lvggt/cli/progress.h"
#include "lvggt/data/supervision.h"
#include "lvggt/field/frame_pictures.h"
#include "lvggt/io/json_writer.h"

namespace train_decoder {

using namespace lvggt;

// One held-out frame with what is predicted for it.
struct HeldOut::Frame {
  DecoderBatch batch;
  std::array<Tensor<float, 3>, 4> taps;    // [1, h*w, 2C]
  Tensor<float, 4> image;                  // [1, H, W, 3]
  Tensor<float, 5> features, language;     // [1, levels, H, W, d]
  Tensor<float, 4> mask;                   // [1, levels, H, W]
  Tensor<float, 4> rgb;                    // [1, H, W, 3], empty without RGB head
  Tensor<std::int32_t, 3> truth, classes;  // [levels, H, W], empty without classes
};

// Everything that is summed over frames, and so over ranks.
struct HeldOut::Sums {
  double l1 = 0, values = 0, psnr = 0, frames = 0;
  std::vector<std::vector<IouCounter>> counters;  // [scene][level]
  std::vector<double> states;  // for each sample and object predicted + 1, true + 1; 0 for none

  std::vector<double> flat() const {
    std::vector<double> all{l1, values, psnr, frames};
    for (const auto& scene : counters)
      for (const IouCounter& counter : scene) {
        const std::vector<double> counts = counter.counts();
        all.insert(all.end(), counts.begin(), counts.end());
      }
    all.insert(all.end(), states.begin(), states.end());
    return all;
  }
  void take(std::span<const double> all) {
    for (double* sum : {&l1, &values, &psnr, &frames}) {
      *sum = all.front();
      all = all.subspan(1);
    }
    for (auto& scene : counters)
      for (IouCounter& counter : scene) {
        const std::size_t n = counter.counts().size();
        counter.set_counts(all.first(n));
        all = all.subspan(n);
      }
    std::copy(all.begin(), all.end(), states.begin());
  }
};

namespace {

// Most objects of a scene whose states are followed.
constexpr std::size_t kMaxObjects = 16;

// [H, W, d] of level `level` of the only frame.
View<const float, 3> level_of(const Tensor<float, 5>& maps, std::int64_t level) {
  return maps.view()[0][level];
}

// What unlabelled pixels are in a picture of semantics.
constexpr std::uint8_t kHole = 24;

}  // namespace

HeldOut::HeldOut(const TrainingSet& set, const ModelConfig& config, std::int64_t columns)
    : set_(set),
      config_(config),
      samples_(set.samples(Part::kHeldOut)),
      columns_(static_cast<std::size_t>(columns)),
      codes_(set.scenes().size()),
      levels_(level_names(config.sbd_levels)) {
  if (samples_.empty()) return;
  for (const Part part : {Part::kTrain, Part::kHeldOut})
    for (const Sample& sample : set.samples(part)) {
      SceneCodes& codes = codes_[sample.scene];
      if (codes.size() > SceneCodes::kMost) continue;  // no classes, whatever follows
      codes.add(read_labels(sample.rows_path, sample.codes_path, set.supervision()).codes);
    }
  // Colours of the codes themselves where there are few, so that they are the same in every run.
  std::vector<float> palette;
  for (const SceneCodes& codes : codes_)
    for (std::size_t i = 0; codes.usable() && i < codes.size(); ++i)
      palette.insert(palette.end(), codes.code(i).begin(), codes.code(i).end());
  if (palette.empty()) return;
  const std::int64_t d = config.lang_dim;
  colors_.fit(View<const float, 3>(
      palette.data(), Shape{std::int64_t{1}, static_cast<std::int64_t>(palette.size()) / d, d}));
}

std::vector<std::string> HeldOut::row_names() const {
  std::vector<std::string> names{"picture"};
  if (config_.sbd_rgb) names.push_back("RGB head");
  for (const std::string& level : levels_) {
    names.push_back(level + ", truth");
    names.push_back(level + ", predicted");
  }
  names.push_back("wrong pixels");
  return names;
}

void HeldOut::predict(Frame& frame, const Sample& sample, DecoderTrainer& trainer,
                      bool averaged) const {
  const std::int64_t one = 1, P = sample.h * sample.w, C = set_.channels();
  const std::int64_t L = config_.sbd_levels, d = config_.lang_dim;
  SampleViews views;
  for (std::size_t tap = 0; tap < 4; ++tap) {
    frame.taps[tap] = Tensor<float, 3>(Shape{one, P, C});
    views.taps[tap] = frame.taps[tap].view()[0];
    frame.batch.taps[tap] = frame.taps[tap];
  }
  const Shape maps{one, L, sample.H, sample.W, d};
  frame.image = Tensor<float, 4>(Shape{one, sample.H, sample.W, std::int64_t{3}});
  frame.features = Tensor<float, 5>(maps);
  frame.language = Tensor<float, 5>(maps);
  frame.mask = Tensor<float, 4>(Shape{one, L, sample.H, sample.W});
  views.image = frame.image.view()[0];
  views.features = frame.features.view()[0];
  views.mask = frame.mask.view()[0];
  set_.read(views, sample);

  frame.batch.h = sample.h;
  frame.batch.w = sample.w;
  frame.batch.images = frame.image;
  frame.batch.features = frame.features;
  frame.batch.mask = frame.mask;
  DecoderOutputs outputs{frame.language, {}};
  if (config_.sbd_rgb) {
    frame.rgb = Tensor<float, 4>(frame.image.shape());
    outputs.rgb = frame.rgb;
  }
  trainer.predict(outputs, frame.batch, averaged);

  const SceneCodes& codes = codes_[sample.scene];
  if (!codes.usable()) return;
  frame.truth = Tensor<std::int32_t, 3>(Shape{L, sample.H, sample.W});
  frame.classes = Tensor<std::int32_t, 3>(Shape{L, sample.H, sample.W});
  for (std::int64_t level = 0; level < L; ++level) {
    target_classes(frame.truth.view()[level], level_of(frame.features, level),
                   frame.mask.view()[0][level], codes);
    nearest_classes(frame.classes.view()[level], level_of(frame.language, level), codes);
  }
}

void HeldOut::count(Sums& sums, std::size_t i, const Frame& frame) const {
  const Sample& sample = samples_[i];
  const std::int64_t d = config_.lang_dim;
  const std::int64_t pixels = frame.mask.size();
  for (std::int64_t p = 0; p < pixels; ++p) {
    if (frame.mask.data()[p] == 0) continue;
    for (std::int64_t c = p * d; c < (p + 1) * d; ++c)
      sums.l1 += std::abs(double{frame.language.data()[c]} - frame.features.data()[c]);
  }
  sums.values += static_cast<double>(pixels * d);
  sums.frames += 1;
  if (config_.sbd_rgb) sums.psnr += psnr(frame.rgb.view()[0], frame.image.view()[0]);
  const SceneCodes& codes = codes_[sample.scene];
  if (!codes.usable()) return;
  for (std::int64_t level = 0; level < config_.sbd_levels; ++level)
    sums.counters[sample.scene][static_cast<std::size_t>(level)].add(frame.truth.view()[level],
                                                                     frame.classes.view()[level]);
  if (set_.supervision().kind != Supervision::kDynamic) return;
  const auto objects = codes.changing_objects();
  for (std::size_t o = 0; o < std::min(objects.size(), kMaxObjects); ++o) {
    const auto predicted = voted_state(frame.classes.view()[0], codes, objects[o]);
    const auto truth = voted_state(frame.truth.view()[0], codes, objects[o]);
    double* state = &sums.states[2 * (i * kMaxObjects + o)];
    state[0] = predicted ? static_cast<double>(*predicted + 1) : 0;
    state[1] = truth ? static_cast<double>(*truth + 1) : 0;
  }
}

void HeldOut::draw(ContactSheet& sheet, const Frame& frame, const Sample& sample) {
  std::vector<Tensor<std::uint8_t, 3>> pictures;
  const Shape size{sample.H, sample.W, std::int64_t{3}};
  const auto add_colors = [&](View<const float, 3> rgb) {
    color_bytes(pictures.emplace_back(size), rgb);
  };
  add_colors(frame.image.view()[0]);
  if (config_.sbd_rgb) add_colors(frame.rgb.view()[0]);
  if (!colors_.fitted()) colors_.fit(level_of(frame.features, 0));
  for (std::int64_t level = 0; level < config_.sbd_levels; ++level) {
    Tensor<std::uint8_t, 3>& truth = pictures.emplace_back(size);
    colors_.apply(truth, level_of(frame.features, level));
    for (std::int64_t p = 0; p < sample.H * sample.W; ++p)
      if (frame.mask.view()[0][level].data()[p] == 0) std::fill_n(truth.data() + 3 * p, 3, kHole);
    colors_.apply(pictures.emplace_back(size), level_of(frame.language, level));
  }
  Tensor<std::uint8_t, 3> wrong;
  if (!frame.truth.empty()) {
    // Grey where the nearest code is the true one, red where it is not, on the last level.
    wrong = pictures.front().clone();
    const std::int64_t first = (config_.sbd_levels - 1) * sample.H * sample.W;
    for (std::int64_t p = 0; p < sample.H * sample.W; ++p) {
      std::uint8_t* pixel = wrong.data() + 3 * p;
      const auto grey = static_cast<std::uint8_t>((pixel[0] + pixel[1] + pixel[2]) / 6);
      const std::int32_t truth = frame.truth.data()[first + p];
      const bool red = truth != kNoClass && truth != frame.classes.data()[first + p];
      const Rgb8 color = red ? Rgb8{235, 40, 40} : Rgb8{grey, grey, grey};
      std::copy(color.begin(), color.end(), pixel);
    }
  }
  pictures.push_back(std::move(wrong));
  std::vector<View<const std::uint8_t, 3>> views(pictures.begin(), pictures.end());
  sheet.add(sample.frame.name, views);
}

HeldOut::Result HeldOut::test(DecoderTrainer& trainer, bool averaged, std::int64_t step,
                              Communicator& communicator) {
  Sums sums;
  for (const SceneCodes& codes : codes_)
    sums.counters.emplace_back(codes.usable() ? levels_.size() : 0, IouCounter(codes.size()));
  sums.states.resize(2 * kMaxObjects * samples_.size());
  ContactSheet::Options options;
  options.max_columns = columns_;
  options.cell_width = kSheetCellWidth;
  options.title = concat("held-out frames after step ", step);
  const auto ranks = static_cast<std::size_t>(communicator.size());
  const auto rank = static_cast<std::size_t>(communicator.rank());
  ContactSheet sheet(row_names(), options);
  for (std::size_t i = rank; i < samples_.size(); i += ranks) {
    Frame frame;
    predict(frame, samples_[i], trainer, averaged);
    count(sums, i, frame);
    if (rank != 0) continue;
    if (sheet.wants_next())
      draw(sheet, frame, samples_[i]);
    else
      sheet.skip();
  }
  std::vector<double> all = sums.flat();
  communicator.sum(std::span(all));
  sums.take(all);
  Result result{scores(sums), {}};
  if (rank == 0) result.sheet = sheet.render();
  return result;
}

void HeldOut::score_classes(HeldOutScores& result, const Sums& sums) const {
  double sum = 0;
  int count = 0;
  for (std::size_t scene = 0; scene < codes_.size(); ++scene)
    for (std::size_t level = 0; level < sums.counters[scene].size(); ++level) {
      const IouCounter& counter = sums.counters[scene][level];
      if (const auto mean = counter.mean_iou()) {
        sum += *mean;
        ++count;
      }
      for (std::size_t code = 0; code < codes_[scene].size(); ++code) {
        const auto values = codes_[scene].code(code);
        result.classes.push_back({set_.scenes()[scene].name(),
                                  levels_[level],
                                  code,
                                  {values.begin(), values.end()},
                                  counter.iou(code)});
      }
    }
  if (count > 0) result.mean_iou = sum / count;
}

void HeldOut::score_states(HeldOutScores& result, const Sums& sums) const {
  std::int64_t right = 0, all = 0;
  const auto code = [](double number) {
    return number > 0 ? std::optional(static_cast<std::size_t>(number) - 1) : std::nullopt;
  };
  for (std::size_t i = 0; i < samples_.size(); ++i) {
    const auto objects = codes_[samples_[i].scene].changing_objects();
    for (std::size_t o = 0; o < std::min(objects.size(), kMaxObjects); ++o) {
      const double* state = &sums.states[2 * (i * kMaxObjects + o)];
      if (state[1] == 0) continue;  // the object is not there
      HeldOutScores::State found{set_.scenes()[samples_[i].scene].name(), samples_[i].frame.name,
                                 objects[o], code(state[0]), code(state[1])};
      right += found.predicted == found.truth;
      ++all;
      result.states.push_back(std::move(found));
    }
  }
  if (all > 0) result.state_accuracy = static_cast<double>(right) / static_cast<double>(all);
}

HeldOutScores HeldOut::scores(const Sums& sums) const {
  HeldOutScores result;
  result.l1 = sums.l1 / sums.values;
  if (config_.sbd_rgb) result.psnr = sums.psnr / sums.frames;
  score_classes(result, sums);
  if (set_.supervision().kind == Supervision::kDynamic) score_states(result, sums);
  return result;
}

std::string HeldOutScores::text() const {
  std::string text = "held out: ";
  if (mean_iou) text += "mean IoU " + cli::fixed(*mean_iou, 4) + ", ";
  if (state_accuracy) text += "state accuracy " + cli::fixed(*state_accuracy, 3) + ", ";
  if (psnr) text += "PSNR " + cli::fixed(*psnr, 2) + " dB, ";
  return text + "language L1 " + cli::fixed(l1, 4);
}

void HeldOutScores::add_to(LogLine& line) const {
  if (mean_iou) line.add("held_out_miou", *mean_iou);
  if (state_accuracy) line.add("held_out_state_accuracy", *state_accuracy);
  if (psnr) line.add("held_out_psnr", *psnr);
  line.add("held_out_l1", l1);
}

std::string HeldOutScores::json(std::int64_t step) const {
  JsonWriter json;
  const auto maybe = [&](const char* key, const auto& value) {
    json.key(key);
    if (value)
      json.value(*value);
    else
      json.null();
  };
  json.begin_object();
  json.field("step", step);
  maybe("mean_iou", mean_iou);
  maybe("psnr", psnr);
  maybe("state_accuracy", state_accuracy);
  json.field("language_l1", l1);
  json.key("classes");
  json.begin_array();
  for (const ClassIou& one : classes) {
    json.begin_object();
    json.field("scene", one.scene);
    json.field("level", one.level);
    json.field("class", static_cast<std::int64_t>(one.code));
    json.key("code");
    json.numbers(one.values);
    maybe("iou", one.iou);
    json.end_object();
  }
  json.end_array();
  json.key("states");
  json.begin_array();
  for (const State& state : states) {
    json.begin_object();
    json.field("scene", state.scene);
    json.field("frame", state.frame);
    json.field("object", state.object);
    maybe("predicted_class", state.predicted);
    maybe("true_class", state.truth);
    json.end_object();
  }
  json.end_array();
  json.end_object();
  return json.take();
}

}  // namespace train_decoder
