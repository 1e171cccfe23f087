// SPDX-License-Identifier: Apache-2.0
// What training a decoder learns from: language features of a scene's objects, frame by frame.
#include <cstdio>
#include <deque>
#include <filesystem>
#include <map>
#include <memory>
#include <set>

#include "examples/load_autoencoder.h"
#include "examples/make_features/options.h"
#include "examples/make_features/pass.h"
#include "lvggt/cli/progress.h"
#include "lvggt/io/image.h"
#include "lvggt/io/npy.h"
#include "lvggt/language/captions.h"
#include "lvggt/language/frame_features.h"
#include "lvggt/language/load_text_encoder.h"
#include "lvggt/language/object_masks.h"

namespace {

using namespace lvggt;

// Sentences encoded together: a large encoder reads its weights once for all of them.
constexpr std::size_t kSentenceBatch = 32;

std::string base_folder(const MakeFeaturesOptions& options, const Scene& scene) {
  if (!options.out.empty()) return cli::without_trailing_slashes(options.out);
  return scene.layout() == SceneLayout::kNeu3d ? scene.path() + "/cam00" : scene.path();
}

// A size stands for the content of files too large to hash before every run.
std::pair<std::string, std::string> setting_of(const std::string& role, const std::string& path) {
  const cli::RunInput input = cli::describe_input(role, path, false);
  return {role,
          concat(std::filesystem::path(path).filename().string(), ", ", input.bytes, " bytes")};
}

void check_size(const SceneFrame& frame, const Image& image, View<const std::int32_t, 3> labels,
                const ObjectMasks& masks) {
  LVGGT_CHECK(image.height() == labels.extent(1) && image.width() == labels.extent(2), frame.image,
              ": is ", image.height(), " x ", image.width(), ", but its masks (", masks.describe(),
              ") are ", labels.extent(1), " x ", labels.extent(2));
}

// clip_features: objects cut out and encoded.
class ClipPass {
 public:
  ClipPass(const MakeFeaturesOptions& options, const ObjectMasks& masks, Context& ctx)
      : masks_(masks), ctx_(ctx) {
    const std::string weights = weights_in(options.image_encoder);
    const ClipConfig config =
        options.clip_config.empty()
            ? find_clip_config(weights)
            : parse_clip_config(Json::read(options.clip_config), options.clip_config);
    for (const std::string& note : config.notes) say("warning: " + note);
    clip_ = load_clip_image(Safetensors::open(weights), config);
    const auto& blocks = clip_.transformer.resblocks;
    say(concat("CLIP's image tower, ", blocks.size(), " layers of width ",
               clip_.class_embedding.extent(0), ", pictures of ", clip_.image_size, ", to width ",
               clip_.width(), clip_.transformer.quick_gelu.empty() ? ", GELU" : ", QuickGELU"));
    pass_.inputs = {cli::describe_input("image encoder", weights, false)};
    pass_.settings = {setting_of("image encoder", weights),
                      {"activation", clip_.transformer.quick_gelu.empty() ? "GELU" : "QuickGELU"},
                      {"masks", masks.describe()}};
  }

  Pass pass(const std::string& folder) {
    Pass result = pass_;
    result.folder = folder;
    result.make = [this](const SceneFrame& frame, const std::string& stem) {
      return make(frame, stem);
    };
    return result;
  }

 private:
  std::string make(const SceneFrame& frame, const std::string& stem) {
    const Image image = load_image(frame.image);
    const Tensor<std::int32_t, 3> labels = masks_.read(frame);
    check_size(frame, image, labels, masks_);
    const FrameFeatures made = make_clip_features(image.pixels, labels, clip_, ctx_);
    write_features(stem, made.rows, made.features, false);
    return made.features.extent(0) == 0 ? frame.image + ": its masks hold no object" : "";
  }

  const ObjectMasks& masks_;
  Context& ctx_;
  ClipImage clip_;
  Pass pass_;
};

// video_features: sentences encoded.
class SentencePass {
 public:
  SentencePass(const MakeFeaturesOptions& options, const ObjectMasks& masks, const Scene& scene,
               Context& ctx)
      : masks_(masks),
        ctx_(ctx),
        captions_(read_captions(options.captions)),
        // Captions are what is found: no prompt in front of them.
        encoder_(load_text_encoder(options.sentence_encoder,
                                   {.vocabulary = options.vocabulary, .prompt = ""})) {
    check_frames(options.captions, scene);
    say(encoder_->describe());
    for (const SceneFrame& frame : scene.frames())
      if (const auto found = captions_.find(frame.number); found != captions_.end())
        for (const auto& [object, sentence] : found->second)
          if (known_.insert(sentence).second) waiting_.push_back(sentence);
    const std::vector<std::string> sentences(waiting_.begin(), waiting_.end());
    for (const std::string& warning : encoder_->warnings(sentences)) say("warning: " + warning);
    pass_.inputs = {cli::describe_input("captions", options.captions, true),
                    cli::describe_input("sentence encoder", options.sentence_encoder, false)};
    pass_.settings = {{"captions", pass_.inputs[0].sha256},
                      setting_of("sentence encoder", options.sentence_encoder),
                      {"masks", masks.describe()}};
  }

  Pass pass(const std::string& folder) {
    Pass result = pass_;
    result.folder = folder;
    result.make = [this](const SceneFrame& frame, const std::string& stem) {
      return make(frame, stem);
    };
    return result;
  }

 private:
  void check_frames(const std::string& path, const Scene& scene) const {
    std::set<std::int64_t> numbers;
    for (const SceneFrame& frame : scene.frames()) numbers.insert(frame.number);
    for (const auto& [number, sentences] : captions_)
      LVGGT_CHECK(numbers.contains(number), path, ": describes frame ", number,
                  ", which is not in ", scene.image_folder());
  }

  // The sentence's vector; with it the next ones in the order of the frames.
  View<const float, 1> vector_of(const std::string& sentence) {
    if (const auto found = vectors_.find(sentence); found != vectors_.end())
      return std::as_const(found->second);
    std::vector<std::string> batch = {sentence};
    while (!waiting_.empty() && batch.size() < kSentenceBatch) {
      if (!vectors_.contains(waiting_.front()) && waiting_.front() != sentence)
        batch.push_back(waiting_.front());
      waiting_.pop_front();
    }
    const Tensor<float, 2> rows = encoder_->encode(batch, ctx_);
    for (std::size_t i = 0; i < batch.size(); ++i) {
      Tensor<float, 1> row(Shape{encoder_->width()});
      std::copy_n(rows[static_cast<std::int64_t>(i)].data(), row.size(), row.data());
      vectors_.emplace(batch[i], std::move(row));
    }
    return std::as_const(vectors_.at(sentence));
  }

  std::string make(const SceneFrame& frame, const std::string& stem) {
    const Tensor<std::int32_t, 3> labels = masks_.read(frame);
    std::map<std::int32_t, View<const float, 1>> sentence_of;
    const auto found = captions_.find(frame.number);
    if (found != captions_.end())
      for (const auto& [object, sentence] : found->second)
        sentence_of.emplace(object, vector_of(sentence));
    const FrameFeatures made = make_sentence_features(labels, sentence_of, encoder_->width());
    write_features(stem, made.rows, made.features, true);
    return found == captions_.end() ? concat("frame ", frame.number, " has no captions") : "";
  }

  const ObjectMasks& masks_;
  Context& ctx_;
  Captions captions_;
  std::unique_ptr<TextEncoder> encoder_;
  std::set<std::string> known_;
  std::deque<std::string> waiting_;  // sentences not yet encoded
  std::map<std::string, Tensor<float, 1>> vectors_;
  Pass pass_;
};

// A frame's files in the folder of --out.
FeatureFiles files_in(const std::string& base, const std::string& raw, const std::string& compact,
                      const std::string& name) {
  const std::string from = base + "/" + raw + "/" + name, to = base + "/" + compact;
  return {from + "_s.npy", from + "_f.npy", to, to + "/" + name + "_s.npy",
          to + "/" + name + "_f.npy"};
}

class Run {
 public:
  Run(const MakeFeaturesOptions& options, std::vector<std::string> arguments)
      : options_(options),
        arguments_(std::move(arguments)),
        threads_(cli::choose_threads(options.threads)),
        ctx_(threads_.threads),
        scene_(Scene::open(options.scene)),
        base_(base_folder(options, scene_)) {
    for (const std::string& warning : scene_.warnings()) say("warning: " + warning);
    if (!options.masks.empty()) masks_ = ObjectMasks::open(options.masks, scene_);
    for (const SceneFrame& frame : scene_.frames())
      if (masks_ == nullptr || masks_->has(frame)) frames_.push_back(frame);
    const std::size_t without = scene_.frames().size() - frames_.size();
    if (without > 0) say(concat("warning: ", without, " frames have no masks and are left out"));
  }

  int run() {
    std::error_code ignored;
    if (!options_.dry_run && !std::filesystem::is_directory(base_, ignored))
      cli::create_output_folder(base_);
    int status = 0;
    if (!options_.image_encoder.empty()) {
      ClipPass clip(options_, *masks_, ctx_);
      status = work(clip.pass(base_ + "/clip_features"));
    }
    if (status == 0 && !options_.captions.empty()) {
      SentencePass sentences(options_, *masks_, scene_, ctx_);
      status = work(sentences.pass(base_ + "/video_features"));
    }
    if (status == 0) status = compact(Supervision::kClip, options_.autoencoder);
    if (status == 0) status = compact(Supervision::kDynamic, options_.sentence_autoencoder);
    return status;
  }

 private:
  int work(const Pass& pass) {
    if (options_.dry_run) {
      std::printf("%zu frames to %s\n", frames_.size(), pass.folder.c_str());
      for (const auto& [name, value] : pass.settings)
        std::printf("  %s: %s\n", name.c_str(), value.c_str());
      return 0;
    }
    return run_pass(pass, frames_, options_, threads_.threads, arguments_, interrupt_);
  }

  // The compact form of features that are there already, or were made before.
  int compact(Supervision kind, const std::string& path) {
    if (path.empty()) return 0;
    const Autoencoder autoencoder = load_autoencoder(path);
    const std::string folder = SupervisionSpec{kind, autoencoder.code_width()}.folder();
    if (options_.dry_run) {
      std::printf("%zu frames to %s\n", frames_.size(), folder.c_str());
      return 0;
    }
    std::vector<FeatureFiles> files;
    for (const SceneFrame& frame : frames_)
      files.push_back(options_.out.empty()
                          ? feature_files(scene_, frame, kind, autoencoder.code_width(), "")
                          : files_in(base_, raw_feature_folder(kind), folder, frame.name));
    cli::Progress progress(std::ssize(files));
    std::int64_t done = 0;
    const std::int64_t written = write_compact_codes(
        files, autoencoder, path, options_.existing_codes(),
        [&] {
          progress.show(++done);
          return !interrupt_.requested();
        },
        ctx_);
    progress.clear();
    const bool interrupted = done < std::ssize(files);
    say(concat(interrupted ? "interrupted: " : "", "codes of ", done, " frames in ", folder, ", ",
               written, " of them written now", interrupted ? "; --resume continues" : ""));
    return interrupted ? exit_code(ErrorKind::kInterrupted) : 0;
  }

  const MakeFeaturesOptions& options_;
  std::vector<std::string> arguments_;
  cli::ThreadChoice threads_;
  Context ctx_;
  Scene scene_;
  std::string base_;
  std::unique_ptr<ObjectMasks> masks_;
  std::vector<SceneFrame> frames_;
  cli::InterruptGuard interrupt_;
};

}  // namespace

int main(int argc, char** argv) {
  cli::Program program("make_features",
                       "Makes the language features of a scene's objects that a decoder is trained "
                       "with.",
                       LVGGT_VERSION);
  MakeFeaturesOptions options;
  add_make_features_options(program, options);
  return program.run(argc, argv, [&] {
    options.settle();
    return Run(options, {argv + 1, argv + argc}).run();
  });
}
