// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <utility>
#include <vector>

#include "examples/evaluate/codes_source.h"
#include "examples/evaluate/run_spec.h"
#include "lvggt/core/context.h"
#include "lvggt/language/annotations.h"
#include "lvggt/language/metrics.h"
#include "lvggt/language/query.h"
#include "lvggt/language/text_encoder.h"

namespace evaluate {

// One phrase in one wording over the frames that annotate it.
struct PhraseResult {
  std::string phrase;   // as annotated
  std::string wording;  // as asked
  lvggt::PhraseScore score;
};

// One state sentence in one wording over the frames that annotate its object.
struct StateResult {
  std::string object, sentence, wording;
  std::vector<std::int64_t> frames;
  std::vector<std::uint8_t> truth;
  std::vector<float> iou;  // of the frame's mask with the object's
  lvggt::TimeAnswer answer;
  lvggt::StateScore score;
  std::vector<lvggt::FrameInterval> intervals;  // annotated
};

struct SceneResult {
  std::string scene;
  lvggt::SceneLayout layout = lvggt::SceneLayout::kHyperNerf;
  std::int64_t frames = 0;  // annotated
  std::vector<PhraseResult> phrases;
  std::vector<StateResult> states;
  std::vector<std::string> notes;  // what was left out, and why
  double seconds = 0;

  // mIoU and mAcc, Acc and vIoU; of the wordings as annotated, or of the others. Nothing when there
  // are none.
  struct Means {
    std::optional<lvggt::MeanScore> masks;
    std::optional<double> accuracy, viou;
  };
  Means means(bool paraphrased = false) const;
};

// What a frame's answers looked like, for pictures.
struct FrameView {
  const lvggt::AnnotatedImage& image;
  const std::vector<std::string>& labels;           // phrases as annotated
  lvggt::View<const std::uint8_t, 3> masks, truth;  // [labels, H, W]
};

// Text encoders stay loaded from scene to scene.
class Encoders {
 public:
  const lvggt::TextEncoder& phrases(const std::string& path) { return open(path, phrases_); }
  const lvggt::TextEncoder& sentences(const std::string& path) { return open(path, sentences_); }

 private:
  using Slot = std::pair<std::string, std::unique_ptr<lvggt::TextEncoder>>;
  const lvggt::TextEncoder& open(const std::string& path, Slot& slot);
  Slot phrases_, sentences_;
};

// The published protocol on one scene: asks every annotated frame for its labels and for the state
// sentences, in all their wordings. progress(done, total) is called after each frame and may throw;
// show, if given, sees the answers in the wordings as annotated. Errors: those of the files it
// reads.
SceneResult evaluate_scene(const RunSpec& run, const std::string& scene, Encoders& encoders,
                           const std::function<void(std::int64_t, std::int64_t)>& progress,
                           const std::function<void(const FrameView&)>& show, lvggt::Context& ctx);

}  // namespace evaluate
