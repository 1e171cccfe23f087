// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/metrics.h"

namespace lvggt {
namespace {

struct Counts {
  std::int64_t both = 0, any = 0, equal = 0;
};

Counts count(const char* op, View<const std::uint8_t, 2> a, View<const std::uint8_t, 2> b) {
  LVGGT_CHECK(a.shape() == b.shape(), op, ": the masks are ", a.shape(), " and ", b.shape());
  Counts counts;
  for (std::int64_t y = 0; y < a.extent(0); ++y)
    for (std::int64_t x = 0; x < a.extent(1); ++x) {
      const bool in_a = a(y, x) != 0, in_b = b(y, x) != 0;
      counts.both += in_a && in_b;
      counts.any += in_a || in_b;
      counts.equal += in_a == in_b;
    }
  return counts;
}

double ratio(std::int64_t a, std::int64_t b, double otherwise) {
  return b > 0 ? static_cast<double>(a) / static_cast<double>(b) : otherwise;
}

template <class F>
double mean_over(const std::vector<MaskScore>& frames, const F& value) {
  double sum = 0;
  for (const MaskScore& frame : frames) sum += value(frame);
  return frames.empty() ? 0 : sum / static_cast<double>(frames.size());
}

}  // namespace

double mask_iou(View<const std::uint8_t, 2> a, View<const std::uint8_t, 2> b) {
  const Counts counts = count("mask_iou", a, b);
  return ratio(counts.both, counts.any, 1);
}

double pixel_accuracy(View<const std::uint8_t, 2> a, View<const std::uint8_t, 2> b) {
  LVGGT_CHECK(a.size() > 0, "pixel_accuracy: the masks are ", a.shape());
  return ratio(count("pixel_accuracy", a, b).equal, a.size(), 0);
}

double PhraseScore::iou() const {
  return mean_over(frames, [](const MaskScore& frame) { return frame.iou; });
}

double PhraseScore::accuracy() const {
  return mean_over(frames, [](const MaskScore& frame) { return frame.accuracy; });
}

MeanScore mean_score(std::span<const PhraseScore> phrases) {
  MeanScore mean;
  for (const PhraseScore& phrase : phrases) {
    mean.iou += phrase.iou() / static_cast<double>(phrases.size());
    mean.accuracy += phrase.accuracy() / static_cast<double>(phrases.size());
  }
  return mean;
}

StateScore score_state(std::span<const std::uint8_t> truth,
                       std::span<const std::uint8_t> prediction, std::span<const float> iou) {
  LVGGT_CHECK(truth.size() == prediction.size() && truth.size() == iou.size(),
              "score_state: ", truth.size(), " truths, ", prediction.size(), " calls and ",
              iou.size(), " intersections over union");
  std::int64_t right = 0, both = 0, positive = 0, called = 0;
  double sum = 0;
  for (std::size_t i = 0; i < truth.size(); ++i) {
    const bool is = truth[i] != 0, said = prediction[i] != 0;
    right += is == said;
    both += is && said;
    positive += is;
    called += said;
    if (is && said) sum += iou[i];
  }
  StateScore score;
  score.accuracy = ratio(right, std::ssize(truth), 0);
  score.precision = ratio(both, called, 0);
  score.recall = ratio(both, positive, 0);
  const std::int64_t any = positive + called - both;
  score.viou = any > 0 ? sum / static_cast<double>(any) : 0;
  return score;
}

}  // namespace lvggt
