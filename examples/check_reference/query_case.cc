// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "examples/check_reference/query_cases.h"
#include "lvggt/language/autoencoder.h"
#include "lvggt/language/mask_filters.h"
#include "lvggt/language/metrics.h"
#include "lvggt/language/query.h"
#include "lvggt/model/deterministic_weights.h"

namespace check_reference {
namespace {

using namespace lvggt;

// Masks may differ where float32 rounds across the threshold.
constexpr std::int64_t kWrongPixels = 2;

std::vector<std::int64_t> integers(View<const std::uint8_t, 2> mask) {
  std::vector<std::int64_t> values;
  for (std::int64_t y = 0; y < mask.extent(0); ++y)
    for (std::int64_t x = 0; x < mask.extent(1); ++x) values.push_back(mask(y, x));
  return values;
}

// An 8-bit array of the file, as [n, H, W] masks.
Tensor<std::uint8_t, 3> read_masks(const Safetensors& file, const std::string& name) {
  const TensorEntry& entry = file.at(name);
  const std::size_t rank = entry.shape.size();
  LVGGT_CHECK(rank >= 2, file.path(), ": ", name, " is ", shape_text(entry.shape), ", no masks");
  const std::int64_t H = entry.shape[rank - 2], W = entry.shape[rank - 1];
  Tensor<std::uint8_t, 3> masks(Shape{entry.size() / std::max<std::int64_t>(H * W, 1), H, W});
  const std::vector<std::int64_t> values = file.read_int64(name);
  for (std::size_t i = 0; i < values.size(); ++i)
    masks.data()[i] = static_cast<std::uint8_t>(values[i]);
  return masks;
}

// Everything that is computed from the codes of all frames, in the file's order.
struct Computed {
  Tensor<float, 5> relevancy, filtered;  // [frames, levels, phrases, H, W]
  Tensor<std::uint8_t, 5> mask_raw, mask;
  std::vector<float> score, iou, accuracy;  // at the chosen level
  std::vector<float> iou_per_level, accuracy_per_level;
  std::vector<std::int64_t> level;
};

class QueryCase {
 public:
  QueryCase(Comparison& comparison, Context& ctx)
      : comparison_(comparison),
        ctx_(ctx),
        file_(comparison.file()),
        autoencoder_({512, {}, {16, 32, 64, 128, 256, 512}, 3},
                     [](const TensorSpec& spec, std::span<float> values) {
                       deterministic_values(spec.name, spec.shape, 1, values);
                     }),
        decoder_(autoencoder_, ctx),
        query_(decoder_, file_.read<2>("phrases"), file_.read<2>("canonical"), {}, ctx),
        codes_(file_.read<5>("codes")),
        truth_(read_masks(file_, "truth")) {
    for (const char* name : {"codes", "phrases", "canonical", "truth"}) comparison.accept(name);
  }

  void check_decoded() {
    constexpr std::int64_t kEvery = 4001;
    const auto [F, L, H, W, d] = codes_.shape();
    const std::int64_t rows = L * H * W;
    Tensor<float, 2> features(Shape{rows, std::int64_t{512}});
    std::vector<float> samples;
    for (std::int64_t f = 0; f < F; ++f) {
      autoencoder_.decode(features, codes_[f].reshaped(Shape{rows, d}), ctx_);
      for (std::int64_t i = 0; i < features.size(); i += kEvery)
        samples.push_back(features.data()[i]);
    }
    comparison_.compare("decoded_every4001", samples);
  }

  void check_answers() {
    compute();
    const auto flat = [](const Tensor<float, 5>& t) {
      return std::span<const float>(t.data(), static_cast<std::size_t>(t.size()));
    };
    comparison_.compare("relevancy", flat(computed_.relevancy));
    comparison_.compare("filtered", flat(computed_.filtered));
    comparison_.compare_masks("mask_raw", computed_.mask_raw.data(), computed_.mask_raw.size(),
                              pixels(), kWrongPixels);
    comparison_.compare_masks("mask", computed_.mask.data(), computed_.mask.size(), pixels(),
                              kWrongPixels);
    comparison_.compare("score", computed_.score);
    comparison_.compare("level", computed_.level);
  }

  // A pixel or two of difference in a mask moves its scores by as much.
  void check_scores() {
    const double limit = 2e-3;
    comparison_.compare_within("iou", computed_.iou, limit);
    comparison_.compare_within("accuracy", computed_.accuracy, limit);
    comparison_.compare_within("iou_per_level", computed_.iou_per_level, limit);
    comparison_.compare_within("accuracy_per_level", computed_.accuracy_per_level, limit);
    const std::int64_t n = query_.num_phrases(), F = codes_.extent(0);
    std::vector<PhraseScore> phrases(static_cast<std::size_t>(n));
    std::vector<float> iou, accuracy;
    for (std::int64_t q = 0; q < n; ++q) {
      PhraseScore& phrase = phrases[static_cast<std::size_t>(q)];
      for (std::int64_t f = 0; f < F; ++f) {
        const auto i = static_cast<std::size_t>(f * n + q);
        phrase.frames.push_back({f, computed_.iou[i], computed_.accuracy[i]});
      }
      iou.push_back(static_cast<float>(phrase.iou()));
      accuracy.push_back(static_cast<float>(phrase.accuracy()));
    }
    comparison_.compare_within("phrase_miou", iou, limit);
    comparison_.compare_within("phrase_macc", accuracy, limit);
    const MeanScore mean = mean_score(phrases);
    comparison_.compare_within("miou", std::vector<float>{static_cast<float>(mean.iou)}, limit);
    comparison_.compare_within("macc", std::vector<float>{static_cast<float>(mean.accuracy)},
                               limit);
  }

  // Codes above 0 are decoded as 2 x - 1; answer() does that by itself and keeps the best level.
  void check_positive() {
    comparison_.accept("positive.codes");
    Tensor<float, 4> codes = file_.read<4>("positive.codes");
    const auto [L, H, W, d] = codes.shape();
    PhraseAnswers answers;
    query_.answer(answers, codes, ctx_);
    LVGGT_CHECK(answers.rescaled, file_.path(), ": positive.codes are not all above 0");
    for (std::int64_t i = 0; i < codes.size(); ++i) codes.data()[i] = 2 * codes.data()[i] - 1;
    Tensor<float, 4> relevancy(Shape{L, query_.num_phrases(), H, W});
    for (std::int64_t l = 0; l < L; ++l)
      query_.answer_level(relevancy[l], {}, {}, {}, codes[l], ctx_);
    comparison_.compare("positive.relevancy", relevancy);
  }

  // Vectors of other lengths than 1: the published function multiplies them as they are.
  void check_rows() {
    for (const char* name : {"rows", "rows.phrases", "rows.canonical"}) comparison_.accept(name);
    const Tensor<float, 2> rows = file_.read<2>("rows"), phrases = file_.read<2>("rows.phrases"),
                           canonical = file_.read<2>("rows.canonical");
    const std::int64_t N = rows.extent(0), n = phrases.extent(0), c = canonical.extent(0);
    Tensor<float, 2> products(Shape{N, c + n}), maps(Shape{n, N}), relevancy(Shape{N, n});
    linear_forward(products.view().narrow(1, 0, c), rows, canonical, {}, ctx_);
    linear_forward(products.view().narrow(1, c, c + n), rows, phrases, {}, ctx_);
    relevancy_of_products(maps, products, c, ctx_);
    for (std::int64_t i = 0; i < N; ++i)
      for (std::int64_t j = 0; j < n; ++j) relevancy(i, j) = maps(j, i);
    comparison_.compare("rows.relevancy", relevancy);
  }

  // Both filters on maps smaller than their windows.
  void check_small() {
    const std::string suffix = ".majority";
    for (const TensorEntry& entry : file_.entries()) {
      if (!entry.name.starts_with("small") || !entry.name.ends_with(suffix)) continue;
      const std::string name = entry.name.substr(0, entry.name.size() - suffix.size());
      comparison_.accept(name + ".mask");
      comparison_.accept(name + ".map");
      const Tensor<std::uint8_t, 3> mask = read_masks(file_, name + ".mask");
      Tensor<std::uint8_t, 2> smooth(Shape{mask.extent(1), mask.extent(2)});
      majority_filter(smooth, mask[0], 7, ctx_);
      comparison_.compare(name + suffix, integers(smooth));
      const Tensor<float, 2> map = file_.read<2>(name + ".map");
      Tensor<float, 2> mean(map.shape());
      box_filter(mean, map, 29, ctx_);
      comparison_.compare(name + ".box29", mean);
    }
  }

 private:
  std::int64_t pixels() const { return codes_.extent(2) * codes_.extent(3); }

  void compute() {
    const std::int64_t F = codes_.extent(0), L = codes_.extent(1), H = codes_.extent(2),
                       W = codes_.extent(3), n = query_.num_phrases();
    computed_.relevancy = Tensor<float, 5>(Shape{F, L, n, H, W});
    computed_.filtered = Tensor<float, 5>(computed_.relevancy.shape());
    computed_.mask_raw = Tensor<std::uint8_t, 5>(computed_.relevancy.shape());
    computed_.mask = Tensor<std::uint8_t, 5>(computed_.relevancy.shape());
    PhraseAnswers answers;
    for (std::int64_t f = 0; f < F; ++f) {
      for (std::int64_t l = 0; l < L; ++l) {
        query_.answer_level(computed_.relevancy[f][l], computed_.filtered[f][l],
                            computed_.mask_raw[f][l], computed_.mask[f][l], codes_[f][l], ctx_);
        for (std::int64_t q = 0; q < n; ++q) score(computed_.mask[f][l][q], f, q, false);
      }
      query_.answer(answers, codes_[f], ctx_);
      for (std::int64_t q = 0; q < n; ++q) {
        for (std::int64_t l = 0; l < L; ++l) computed_.score.push_back(answers.score(q, l));
        computed_.level.push_back(answers.level[static_cast<std::size_t>(q)]);
        score(answers.mask[q], f, q, true);
      }
    }
  }

  void score(View<const std::uint8_t, 2> mask, std::int64_t f, std::int64_t q, bool chosen) {
    const View<const std::uint8_t, 2> truth = truth_[f * query_.num_phrases() + q];
    (chosen ? computed_.iou : computed_.iou_per_level)
        .push_back(static_cast<float>(mask_iou(mask, truth)));
    (chosen ? computed_.accuracy : computed_.accuracy_per_level)
        .push_back(static_cast<float>(pixel_accuracy(mask, truth)));
  }

  Comparison& comparison_;
  Context& ctx_;
  const Safetensors& file_;
  Autoencoder autoencoder_;
  DecodedCosines decoder_;
  PhraseQuery query_;
  Tensor<float, 5> codes_;         // [frames, levels, H, W, 3]
  Tensor<std::uint8_t, 3> truth_;  // [frames * phrases, H, W]
  Computed computed_;
};

}  // namespace

void check_query(Comparison& comparison, Context& ctx) {
  QueryCase run(comparison, ctx);
  run.check_decoded();
  run.check_answers();
  run.check_scores();
  run.check_positive();
  run.check_rows();
  run.check_small();
}

}  // namespace check_reference
