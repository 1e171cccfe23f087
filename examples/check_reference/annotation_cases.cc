// SPDX-License-Identifier: Apache-2.0
#include <filesystem>

#include "examples/check_reference/query_cases.h"
#include "lvggt/language/annotations.h"
#include "lvggt/language/autoencoder.h"
#include "lvggt/language/metrics.h"
#include "lvggt/language/polygon.h"
#include "lvggt/language/query.h"

namespace check_reference {
namespace {

using namespace lvggt;

std::vector<std::int64_t> integers(const Tensor<std::uint8_t, 2>& mask) {
  return {mask.data(), mask.data() + mask.size()};
}

std::vector<std::int64_t> integers(const std::vector<std::uint8_t>& values) {
  return {values.begin(), values.end()};
}

// The masks of the annotation files beside the case, by label and by state sentence.
void check_annotations(Comparison& comparison) {
  const std::filesystem::path folder =
      std::filesystem::path(comparison.file().path()).parent_path();
  const std::string coco = (folder / "annotations_seed1.coco.json").string();
  const auto images = read_coco_annotations(coco, {.check_images = false});
  const auto states = read_video_annotations((folder / "video_annotations_seed1.json").string());
  std::vector<std::int64_t> hyper_nerf, neu3d;
  for (std::size_t i = 0; i < images.size(); ++i) {
    const AnnotatedImage& image = images[i];
    hyper_nerf.push_back(annotated_frame(image.file_name, SceneLayout::kHyperNerf));
    neu3d.push_back(annotated_frame(image.file_name, SceneLayout::kNeu3d));
    const std::string prefix = concat("annotation.image", i, ".");
    for (const auto& [label, objects] : image.labels) {
      Tensor<std::uint8_t, 2> mask(Shape{image.height, image.width});
      paint_label(mask, objects, PolygonRule::kFirst);
      comparison.compare(prefix + label, integers(mask));
      for (const StateAnnotation& state : states)
        if (state.object == label) comparison.compare(prefix + state.sentence, integers(mask));
    }
  }
  comparison.compare("annotation.frame_index_hypernerf", hyper_nerf);
  comparison.compare("annotation.frame_index_neu3d", neu3d);
}

// One of the 40 series: what the file gives and what is computed from it.
struct Series {
  std::vector<float> similarity, iou;
  std::vector<std::int64_t> frames;
  std::vector<FrameInterval> intervals;
};

class SeriesCase {
 public:
  explicit SeriesCase(Comparison& comparison) : comparison_(comparison), file_(comparison.file()) {
    for (const char* name : {"similarity", "frame_iou", "frame", "length", "intervals"})
      comparison.accept(name);
  }

  void check() {
    const Tensor<float, 2> similarity = file_.read<2>("similarity"),
                           iou = file_.read<2>("frame_iou");
    const std::vector<std::int64_t> frames = file_.read_int64("frame"),
                                    lengths = file_.read_int64("length"),
                                    intervals = file_.read_int64("intervals");
    width_ = static_cast<std::size_t>(similarity.extent(1));
    const std::size_t ends = intervals.size() / lengths.size();
    for (std::size_t s = 0; s < lengths.size(); ++s) {
      Series series;
      for (std::size_t i = 0; i < static_cast<std::size_t>(lengths[s]); ++i) {
        series.similarity.push_back(similarity.data()[s * width_ + i]);
        series.iou.push_back(iou.data()[s * width_ + i]);
        series.frames.push_back(frames[s * width_ + i]);
      }
      for (std::size_t e = s * ends; e < (s + 1) * ends; e += 2)
        if (intervals[e] >= 0) series.intervals.emplace_back(intervals[e], intervals[e + 1]);
      add(series);
      if (s == 4) five_taps_ = padded(smooth_series(series.similarity, kFiveTaps));
    }
    compare();
  }

 private:
  std::vector<float> padded(std::vector<float> values) const {
    values.resize(width_, 0.0F);
    return values;
  }

  void add(const Series& series) {
    const TimeAnswer answer = answer_over_time(series.similarity);
    std::vector<std::uint8_t> truth;
    for (const std::int64_t frame : series.frames)
      truth.push_back(in_intervals(frame, series.intervals) ? 1 : 0);
    const StateScore score = score_state(truth, answer.positive, series.iou);
    const auto append = [&](auto& all, const auto& values) {
      all.insert(all.end(), values.begin(), values.end());
      all.resize(all.size() + width_ - values.size());
    };
    append(smoothed_, answer.smoothed);
    append(label_, truth);
    append(prediction_, answer.positive);
    threshold_.push_back(answer.threshold);
    accuracy_.push_back(static_cast<float>(score.accuracy));
    precision_.push_back(static_cast<float>(score.precision));
    recall_.push_back(static_cast<float>(score.recall));
    viou_.push_back(static_cast<float>(score.viou));
  }

  void compare() {
    const auto mean = [](const std::vector<float>& values) {
      double sum = 0;
      for (const float value : values) sum += value;
      return std::vector<float>{static_cast<float>(sum / static_cast<double>(values.size()))};
    };
    comparison_.compare_within("smoothed", smoothed_, 1e-6);
    comparison_.compare_within("threshold", threshold_, 1e-6);
    comparison_.compare("label", label_);
    comparison_.compare("prediction", prediction_);
    comparison_.compare_within("accuracy", accuracy_, 1e-6);
    comparison_.compare_within("precision", precision_, 1e-6);
    comparison_.compare_within("recall", recall_, 1e-6);
    comparison_.compare_within("viou", viou_, 1e-6);
    comparison_.compare_within("mean_accuracy", mean(accuracy_), 1e-6);
    comparison_.compare_within("mean_viou", mean(viou_), 1e-6);
    comparison_.compare_within("five_taps.smoothed", five_taps_, 1e-6);
  }

  Comparison& comparison_;
  const Safetensors& file_;
  std::size_t width_ = 0;
  std::vector<float> smoothed_, threshold_, accuracy_, precision_, recall_, viou_, five_taps_;
  std::vector<std::int64_t> label_, prediction_;
};

// Codes and masks of a short video to similarities, calls and scores of two sentences.
void check_video(Comparison& comparison, Context& ctx) {
  const Safetensors& file = comparison.file();
  for (const TensorEntry& entry : file.entries())
    if (entry.name.starts_with("video.weight.") || entry.name.ends_with(".intervals") ||
        entry.name == "video.codes" || entry.name == "video.masks" ||
        entry.name == "video.sentences" || entry.name == "video.frame_iou")
      comparison.accept(entry.name);
  const Autoencoder autoencoder = Autoencoder::from(file, "video.weight.");
  const DecodedCosines decoder(autoencoder, ctx);
  const StateQuery query(decoder, file.read<2>("video.sentences"), ctx);
  const Tensor<float, 4> codes = file.read<4>("video.codes");
  const std::vector<std::int64_t> mask_values = file.read_int64("video.masks");
  const Tensor<float, 1> iou = file.read<1>("video.frame_iou");
  const std::int64_t F = codes.extent(0), H = codes.extent(1), W = codes.extent(2),
                     n = query.num_sentences();
  Tensor<std::uint8_t, 3> masks(Shape{n, H, W});
  Tensor<float, 2> similarity(Shape{n, F});
  std::vector<float> of_frame(static_cast<std::size_t>(n));
  for (std::int64_t f = 0; f < F; ++f) {
    for (std::int64_t i = 0; i < n * H * W; ++i)
      masks.data()[i] =
          static_cast<std::uint8_t>(mask_values[static_cast<std::size_t>(f * H * W + i % (H * W))]);
    query.similarity(of_frame, codes[f], masks, ctx);
    for (std::int64_t i = 0; i < n; ++i) similarity(i, f) = of_frame[static_cast<std::size_t>(i)];
  }
  comparison.compare("video.similarity", similarity);
  std::vector<float> scores;
  for (std::int64_t i = 0; i < n; ++i) {
    const std::string prefix = concat("video.sentence", i, ".");
    const TimeAnswer answer = answer_over_time({similarity[i].data(), static_cast<std::size_t>(F)});
    comparison.compare(prefix + "smoothed", answer.smoothed);
    comparison.compare(prefix + "prediction", integers(answer.positive));
    const std::vector<std::int64_t> ends = file.read_int64(prefix + "intervals");
    std::vector<FrameInterval> intervals;
    for (std::size_t e = 0; e + 1 < ends.size(); e += 2)
      intervals.emplace_back(ends[e], ends[e + 1]);
    std::vector<std::uint8_t> truth;
    for (std::int64_t f = 0; f < F; ++f) truth.push_back(in_intervals(f, intervals) ? 1 : 0);
    const StateScore score =
        score_state(truth, answer.positive, {iou.data(), static_cast<std::size_t>(F)});
    scores.push_back(static_cast<float>(score.accuracy));
    scores.push_back(static_cast<float>(score.viou));
  }
  comparison.compare("video.accuracy_viou", scores);
}

}  // namespace

void check_polygons(Comparison& comparison) {
  const Safetensors& file = comparison.file();
  for (const char* name : {"points", "offsets", "size"}) comparison.accept(name);
  const Tensor<float, 2> points = file.read<2>("points");
  const std::vector<std::int64_t> offsets = file.read_int64("offsets"),
                                  size = file.read_int64("size");
  const std::vector<std::int64_t>& shape = file.at("masks").shape;
  std::vector<std::int64_t> all;
  for (std::size_t k = 0; k + 1 < offsets.size(); ++k) {
    Polygon polygon;
    for (std::int64_t i = offsets[k]; i < offsets[k + 1]; ++i)
      polygon.push_back({points(i, 0), points(i, 1)});
    Tensor<std::uint8_t, 2> mask(Shape{shape[1], shape[2]});
    fill_polygon(mask, polygon);
    const std::vector<std::int64_t> pixels = integers(mask);
    all.insert(all.end(), pixels.begin(), pixels.end());
  }
  comparison.compare("masks", all);
  check_annotations(comparison);
}

void check_timeseries(Comparison& comparison, Context& ctx) {
  SeriesCase(comparison).check();
  check_video(comparison, ctx);
}

}  // namespace check_reference
