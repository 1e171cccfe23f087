// SPDX-License-Identifier: Apache-2.0
#include "examples/evaluate/protocol.h"

#include <algorithm>
#include <chrono>

#include "examples/load_autoencoder.h"
#include "lvggt/language/load_text_encoder.h"

namespace evaluate {
namespace {

using namespace lvggt;

std::vector<std::string> wordings(const std::string& phrase, const Paraphrases& paraphrases) {
  std::vector<std::string> all{phrase};
  const auto found = paraphrases.find(phrase);
  if (found != paraphrases.end()) all.insert(all.end(), found->second.begin(), found->second.end());
  return all;
}

// Feature maps as wide as the embeddings need no autoencoder.
std::optional<Autoencoder> open_autoencoder(const std::string& path, const std::string& scene) {
  if (path.empty()) return std::nullopt;
  return load_autoencoder(RunSpec::for_scene(path, scene));
}

DecodedCosines open_decoder(const std::optional<Autoencoder>& autoencoder, std::int64_t width,
                            const char* what, const std::string& encoder, Context& ctx) {
  if (!autoencoder) return DecodedCosines(width);
  LVGGT_CHECK(autoencoder->feature_width() == width, "the ", what, " decodes to ",
              autoencoder->feature_width(), " numbers, but the embeddings of ", encoder, " have ",
              width);
  return DecodedCosines(*autoencoder, ctx);
}

// One scene from its annotations to its scores.
class SceneRun {
 public:
  SceneRun(const RunSpec& run, const std::string& path, Encoders& encoders, Context& ctx)
      : run_(run), ctx_(ctx), scene_(Scene::open(path)) {
    result_.scene = scene_.name();
    result_.layout = scene_.layout();
    AnnotationOptions options;
    options.layout = scene_.layout();
    options.check_images = run.check_images;
    annotations_ = read_scene_annotations(scene_.path(), options);
    std::vector<std::int64_t> frames;
    for (const AnnotatedImage& image : annotations_.images) frames.push_back(image.frame);
    if (frames.empty()) fail(ErrorKind::kFormat, annotations_.coco_path, ": annotates no picture");
    result_.frames = std::ssize(frames);
    source_ = open_source(run, scene_, frames, ctx);
    prepare_questions();
    prepare_queries(encoders);
  }

  SceneResult evaluate(const std::function<void(std::int64_t, std::int64_t)>& progress,
                       const std::function<void(const FrameView&)>& show) {
    const auto start = std::chrono::steady_clock::now();
    std::int64_t done = 0;
    for (const AnnotatedImage& image : annotations_.images) {
      source_->read(codes_, image.frame, image.height, image.width);
      where_->answer(answers_, codes_.language, ctx_);
      score_frame(image, show);
      progress(++done, result_.frames);
    }
    for (StateResult& state : result_.states) {
      state.answer = answer_over_time(state.answer.similarity);
      state.score = score_state(state.truth, state.answer.positive, state.iou);
    }
    std::erase_if(result_.phrases, [](const auto& phrase) { return phrase.score.frames.empty(); });
    result_.seconds =
        std::chrono::duration<double>(std::chrono::steady_clock::now() - start).count();
    return std::move(result_);
  }

 private:
  // Labels first, then sentences, each in all wordings.
  void prepare_questions() {
    labels_ = annotations_.labels();
    for (const std::string& label : labels_)
      for (const std::string& wording : wordings(label, run_.paraphrases))
        result_.phrases.push_back({label, wording, {wording, {}}});
    if (annotations_.states.empty()) {
      result_.notes.push_back("no video_annotations.json, so no time-sensitive scores");
      return;
    }
    if (!source_->has_states()) {
      result_.notes.push_back("no dynamic features, so no time-sensitive scores");
      return;
    }
    if (run_.sentence_encoder.empty())
      fail(ErrorKind::kUsage, "--sentence-encoder is needed for the state sentences");
    for (const StateAnnotation& state : annotations_.states)
      for (const std::string& wording : wordings(state.sentence, run_.paraphrases)) {
        StateResult result;
        result.object = state.object;
        result.sentence = state.sentence;
        result.wording = wording;
        result.intervals = state.intervals;
        result_.states.push_back(std::move(result));
      }
  }

  void prepare_queries(Encoders& encoders) {
    std::vector<std::string> phrases, sentences;
    for (const PhraseResult& phrase : result_.phrases) phrases.push_back(phrase.wording);
    for (const StateResult& state : result_.states) sentences.push_back(state.wording);
    phrases.insert(phrases.end(), sentences.begin(), sentences.end());

    const TextEncoder& clip =
        encoders.phrases(RunSpec::for_scene(run_.text_encoder, scene_.name()));
    autoencoder_ = open_autoencoder(run_.autoencoder, scene_.name());
    decoder_.emplace(
        open_decoder(autoencoder_, clip.width(), "autoencoder", clip.describe(), ctx_));
    where_.emplace(*decoder_, clip.encode(phrases, ctx_), clip.encode(canonical_phrases(), ctx_),
                   PhraseQueryOptions{}, ctx_);
    if (sentences.empty()) return;
    const TextEncoder& encoder =
        encoders.sentences(RunSpec::for_scene(run_.sentence_encoder, scene_.name()));
    state_autoencoder_ = open_autoencoder(run_.state_autoencoder, scene_.name());
    state_decoder_.emplace(open_decoder(state_autoencoder_, encoder.width(), "state autoencoder",
                                        encoder.describe(), ctx_));
    when_.emplace(*state_decoder_, encoder.encode(sentences, ctx_), ctx_);
  }

  void score_frame(const AnnotatedImage& image, const std::function<void(const FrameView&)>& show) {
    const std::int64_t H = image.height, W = image.width;
    const auto num_labels = std::ssize(labels_), num_phrases = std::ssize(result_.phrases),
               num_states = std::ssize(result_.states);
    Tensor<std::uint8_t, 3> truth(Shape{num_labels, H, W});
    const PolygonRule rule = run_.all_polygons ? PolygonRule::kAll : PolygonRule::kFirst;
    for (std::int64_t i = 0; i < num_labels; ++i)
      if (const auto* objects = image.find(labels_[static_cast<std::size_t>(i)]))
        paint_label(truth[i], *objects, rule);
    const auto truth_of = [&](const std::string& label) -> View<const std::uint8_t, 2> {
      const auto at = std::find(labels_.begin(), labels_.end(), label) - labels_.begin();
      return truth[at];
    };
    for (std::int64_t i = 0; i < num_phrases; ++i) {
      PhraseResult& phrase = result_.phrases[static_cast<std::size_t>(i)];
      if (image.find(phrase.phrase) == nullptr) continue;
      const View<const std::uint8_t, 2> mask = answers_.mask[i], wanted = truth_of(phrase.phrase);
      phrase.score.frames.push_back(
          {image.frame, mask_iou(mask, wanted), pixel_accuracy(mask, wanted)});
    }
    if (when_) {
      std::vector<float> similarity(static_cast<std::size_t>(num_states));
      when_->similarity(similarity, codes_.states,
                        answers_.mask_raw.view().narrow(0, num_phrases, num_phrases + num_states),
                        ctx_);
      for (std::int64_t i = 0; i < num_states; ++i) {
        StateResult& state = result_.states[static_cast<std::size_t>(i)];
        if (image.find(state.object) == nullptr) continue;
        state.frames.push_back(image.frame);
        state.truth.push_back(in_intervals(image.frame, state.intervals) ? 1 : 0);
        state.answer.similarity.push_back(similarity[static_cast<std::size_t>(i)]);
        state.iou.push_back(
            static_cast<float>(mask_iou(answers_.mask[num_phrases + i], truth_of(state.object))));
      }
    }
    if (show) show_frame(image, truth, show);
  }

  void show_frame(const AnnotatedImage& image, const Tensor<std::uint8_t, 3>& truth,
                  const std::function<void(const FrameView&)>& show) const {
    Tensor<std::uint8_t, 3> masks(truth.shape());
    for (std::size_t i = 0; i < labels_.size(); ++i)
      for (std::size_t p = 0; p < result_.phrases.size(); ++p) {
        if (result_.phrases[p].wording != labels_[i]) continue;
        const auto from = answers_.mask[static_cast<std::int64_t>(p)];
        std::copy_n(from.data(), from.size(), masks[static_cast<std::int64_t>(i)].data());
      }
    show({image, labels_, std::as_const(masks).view(), truth.view()});
  }

  const RunSpec& run_;
  Context& ctx_;
  Scene scene_;
  SceneAnnotations annotations_;
  SceneResult result_;
  std::unique_ptr<CodesSource> source_;
  std::vector<std::string> labels_;
  std::optional<Autoencoder> autoencoder_, state_autoencoder_;
  std::optional<DecodedCosines> decoder_, state_decoder_;
  std::optional<PhraseQuery> where_;
  std::optional<StateQuery> when_;
  FrameCodes codes_;
  PhraseAnswers answers_;
};

}  // namespace

SceneResult::Means SceneResult::means(bool paraphrased) const {
  Means means;
  std::vector<PhraseScore> chosen;
  for (const PhraseResult& result : phrases)
    if ((result.wording != result.phrase) == paraphrased) chosen.push_back(result.score);
  if (!chosen.empty()) means.masks = mean_score(chosen);
  double accuracy = 0, viou = 0, count = 0;
  for (const StateResult& state : states) {
    if ((state.wording != state.sentence) != paraphrased || state.frames.empty()) continue;
    accuracy += state.score.accuracy;
    viou += state.score.viou;
    ++count;
  }
  if (count > 0) {
    means.accuracy = accuracy / count;
    means.viou = viou / count;
  }
  return means;
}

const TextEncoder& Encoders::open(const std::string& path, Slot& slot) {
  if (!slot.second || slot.first != path) slot = {path, load_text_encoder(path)};
  return *slot.second;
}

SceneResult evaluate_scene(const RunSpec& run, const std::string& scene, Encoders& encoders,
                           const std::function<void(std::int64_t, std::int64_t)>& progress,
                           const std::function<void(const FrameView&)>& show, Context& ctx) {
  return SceneRun(run, scene, encoders, ctx).evaluate(progress, show);
}

}  // namespace evaluate
