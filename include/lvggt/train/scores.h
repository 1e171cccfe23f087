// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <cmath>
#include <cstdint>
#include <limits>
#include <optional>
#include <span>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"

namespace lvggt {

// The distinct compact codes of a scene, collected from the rows of its frames' feature tables
// (*_f.npy). Each is a class of its own. In dynamic supervision row r belongs to object r in every
// frame, so that its distinct codes are the states of that object.
class SceneCodes {
 public:
  // Codes closer than this, coordinate by coordinate, are one.
  static constexpr float kSame = 1e-4F;
  // Scenes with more codes have no classes: their segments are described one by one.
  static constexpr std::size_t kMost = 64;

  // Adds the rows of one frame; rows of zeros, which describe nothing, are passed over.
  //   rows: [n, d]
  void add(View<const float, 2> rows) {
    for (std::int64_t r = 0; r < rows.extent(0) && codes_.size() <= kMost; ++r) {
      const std::span<const float> row(rows[r].data(), static_cast<std::size_t>(rows.extent(1)));
      if (std::all_of(row.begin(), row.end(), [](float x) { return x == 0; })) continue;
      if (find(row)) continue;
      codes_.emplace_back(row.begin(), row.end());
      objects_.push_back(r);
    }
  }

  bool usable() const { return !codes_.empty() && codes_.size() <= kMost; }
  std::size_t size() const { return codes_.size(); }
  std::span<const float> code(std::size_t i) const { return codes_[i]; }
  std::int64_t object(std::size_t i) const { return objects_[i]; }  // the row it was first seen in

  // The codes of one object; more than one when it changes state.
  std::vector<std::size_t> states(std::int64_t object) const {
    std::vector<std::size_t> found;
    for (std::size_t i = 0; i < objects_.size(); ++i)
      if (objects_[i] == object) found.push_back(i);
    return found;
  }

  // The objects that change state, ascending.
  std::vector<std::int64_t> changing_objects() const {
    std::vector<std::int64_t> changing;
    for (const std::int64_t object : objects_)
      if (states(object).size() > 1 &&
          std::find(changing.begin(), changing.end(), object) == changing.end())
        changing.push_back(object);
    std::sort(changing.begin(), changing.end());
    return changing;
  }

  // The code that a vector is, if any.
  std::optional<std::size_t> find(std::span<const float> vector) const {
    for (std::size_t i = 0; i < codes_.size(); ++i) {
      bool same = vector.size() == codes_[i].size();
      for (std::size_t c = 0; same && c < vector.size(); ++c)
        same = std::abs(vector[c] - codes_[i][c]) <= kSame;
      if (same) return i;
    }
    return std::nullopt;
  }

  // The code nearest to a vector by Euclidean distance, the first of equals; there is at least one.
  std::size_t nearest(std::span<const float> vector) const {
    std::size_t best = 0;
    float best_distance = std::numeric_limits<float>::infinity();
    for (std::size_t i = 0; i < codes_.size(); ++i) {
      float distance = 0;
      for (std::size_t c = 0; c < vector.size(); ++c) {
        const float difference = vector[c] - codes_[i][c];
        distance += difference * difference;
      }
      if (distance < best_distance) {
        best = i;
        best_distance = distance;
      }
    }
    return best;
  }

 private:
  std::vector<std::vector<float>> codes_;
  std::vector<std::int64_t> objects_;
};

// What no class stands for in a map of classes.
inline constexpr std::int32_t kNoClass = -1;

// The class of every pixel: the nearest code.
//   classes: [H, W]   features: [H, W, d]
inline void nearest_classes(View<std::int32_t, 2> classes, View<const float, 3> features,
                            const SceneCodes& codes) {
  const auto d = static_cast<std::size_t>(features.extent(2));
  for (std::int64_t y = 0; y < features.extent(0); ++y)
    for (std::int64_t x = 0; x < features.extent(1); ++x)
      classes(y, x) = static_cast<std::int32_t>(codes.nearest(std::span(features[y][x].data(), d)));
}

// The class of every labelled pixel of a target; kNoClass where the mask is 0 or the target is no
// code.
//   classes, mask: [H, W]   targets: [H, W, d]
inline void target_classes(View<std::int32_t, 2> classes, View<const float, 3> targets,
                           View<const float, 2> mask, const SceneCodes& codes) {
  const auto d = static_cast<std::size_t>(targets.extent(2));
  for (std::int64_t y = 0; y < targets.extent(0); ++y)
    for (std::int64_t x = 0; x < targets.extent(1); ++x) {
      const auto found = mask(y, x) > 0 ? codes.find(std::span(targets[y][x].data(), d))
                                        : std::optional<std::size_t>();
      classes(y, x) = found ? static_cast<std::int32_t>(*found) : kNoClass;
    }
}

// Intersection over union of each class, pooled over all maps that were added. Pixels without a
// true class do not count.
class IouCounter {
 public:
  explicit IouCounter(std::size_t num_classes)
      : both_(num_classes), truth_(num_classes), predicted_(num_classes) {}

  //   truth, predicted: [H, W]
  void add(View<const std::int32_t, 2> truth, View<const std::int32_t, 2> predicted) {
    LVGGT_CHECK(truth.shape() == predicted.shape(), "intersection over union: truth is ",
                truth.shape(), " but the prediction is ", predicted.shape());
    for (std::int64_t y = 0; y < truth.extent(0); ++y)
      for (std::int64_t x = 0; x < truth.extent(1); ++x) {
        if (truth(y, x) == kNoClass) continue;
        const auto t = static_cast<std::size_t>(truth(y, x));
        const auto p = static_cast<std::size_t>(predicted(y, x));
        ++truth_[t];
        ++predicted_[p];
        if (t == p) ++both_[t];
      }
  }

  // The counts as numbers that can be summed over ranks, and back.
  std::vector<double> counts() const {
    std::vector<double> values;
    for (const auto* pixels : {&both_, &truth_, &predicted_})
      values.insert(values.end(), pixels->begin(), pixels->end());
    return values;
  }
  void set_counts(std::span<const double> values) {
    LVGGT_CHECK(values.size() == 3 * both_.size(), "intersection over union: ", values.size(),
                " counts are not those of ", both_.size(), " classes");
    for (auto* pixels : {&both_, &truth_, &predicted_})
      for (std::int64_t& count : *pixels) {
        count = static_cast<std::int64_t>(values.front());
        values = values.subspan(1);
      }
  }

  // Nothing for a class that is neither there nor predicted.
  std::optional<double> iou(std::size_t c) const {
    const std::int64_t together = truth_[c] + predicted_[c] - both_[c];
    if (together == 0) return std::nullopt;
    return static_cast<double>(both_[c]) / static_cast<double>(together);
  }

  // Over the classes that are there or predicted; nothing without any.
  std::optional<double> mean_iou() const {
    double sum = 0;
    int count = 0;
    for (std::size_t c = 0; c < both_.size(); ++c)
      if (const auto value = iou(c)) {
        sum += *value;
        ++count;
      }
    if (count == 0) return std::nullopt;
    return sum / count;
  }

 private:
  std::vector<std::int64_t> both_, truth_, predicted_;  // pixels by class
};

// The state of an object in one frame: the one of its states that most pixels are nearest to,
// wherever they are; nothing when no pixel shows the object.
//   predicted: [H, W]
inline std::optional<std::size_t> voted_state(View<const std::int32_t, 2> predicted,
                                              const SceneCodes& codes, std::int64_t object) {
  std::vector<std::int64_t> votes(codes.size());
  for (std::int64_t y = 0; y < predicted.extent(0); ++y)
    for (std::int64_t x = 0; x < predicted.extent(1); ++x)
      if (predicted(y, x) != kNoClass) ++votes[static_cast<std::size_t>(predicted(y, x))];
  std::optional<std::size_t> best;
  for (const std::size_t state : codes.states(object))
    if (votes[state] > 0 && (!best || votes[state] > votes[*best])) best = state;
  return best;
}

// Peak signal-to-noise ratio of colours in [0, 1], in decibels; 100 at most.
//   predicted, truth: [H, W, C]
inline double psnr(View<const float, 3> predicted, View<const float, 3> truth) {
  LVGGT_CHECK(predicted.shape() == truth.shape() && truth.size() > 0, "psnr: truth is ",
              truth.shape(), " but the prediction is ", predicted.shape());
  double sum = 0;
  for (std::int64_t y = 0; y < truth.extent(0); ++y)
    for (std::int64_t x = 0; x < truth.extent(1); ++x)
      for (std::int64_t c = 0; c < truth.extent(2); ++c) {
        const double difference = double{predicted(y, x, c)} - truth(y, x, c);
        sum += difference * difference;
      }
  return std::min(100.0, -10 * std::log10(sum / static_cast<double>(truth.size())));
}

}  // namespace lvggt
