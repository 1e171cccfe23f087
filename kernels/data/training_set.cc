// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/training_set.h"

#include <algorithm>
#include <filesystem>
#include <set>
#include <utility>

#include "lvggt/core/error.h"
#include "lvggt/core/parallel.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/image.h"
#include "lvggt/io/input_file.h"

namespace lvggt {

namespace {

constexpr std::size_t kMaxProblems = 5;  // listed in one message

std::string sha256_text(const std::string& text) {
  return sha256(std::as_bytes(std::span(text.data(), text.size())));
}

std::vector<std::byte> read_file(const std::string& path) {
  const InputFile file(path);
  if (file.size() > kMaxImageBytes)
    fail(ErrorKind::kLimit, path, ": has ", file.size(), " bytes, more than the limit of ",
         kMaxImageBytes);
  std::vector<std::byte> bytes(static_cast<std::size_t>(file.size()));
  file.read_at(0, bytes.data(), bytes.size());
  return bytes;
}

std::string size_text(std::int64_t width, std::int64_t height) {
  return concat(width, "x", height);
}

// Height and width of the targets.
std::pair<std::int64_t, std::int64_t> target_size(const ImageTransform& t, TargetSize target) {
  if (target == TargetSize::kModelFrame) return {t.height, t.width};
  if (t.quarter_turns_ccw == 1) return {t.original_width, t.original_height};
  return {t.original_height, t.original_width};
}

std::string token_folder(const TrainingSetOptions& options, const Scene& scene) {
  if (options.tokens.empty()) return scene.path() + "/lvggt_tokens";
  std::error_code ignored;
  if (!std::filesystem::exists(options.tokens + "/" + kTokenManifest, ignored))
    return options.tokens + "/" + scene.name();
  if (options.scenes.size() > 1)
    fail(ErrorKind::kUsage, options.tokens, ": holds the tokens of one scene, but there are ",
         options.scenes.size(), " scenes; give the folder above, with one folder for each");
  return options.tokens;
}

// What the tokens were made with against what training wants.
void check_settings(const TokenCache& tokens, const TrainingSetOptions& options) {
  const TokenManifest& manifest = tokens.manifest();
  TokenSettings wanted = manifest.settings;
  if (options.config) wanted.config = encoder_config(*options.config);
  if (options.encoder_sha256) wanted.encoder_sha256 = *options.encoder_sha256;
  if (options.preprocess) wanted.preprocess = *options.preprocess;
  const std::string difference = token_difference(manifest.settings, wanted);
  LVGGT_CHECK(difference.empty(), tokens.folder(),
              ": the tokens were made with other settings: ", difference,
              "; make_tokens --force makes them again");
}

}  // namespace

// What checking one sample brought to light.
struct TrainingSet::Finding {
  bool failed = false;
  ErrorKind kind = ErrorKind::kFormat;
  std::string problem;
  std::string manifest_line;
};

TrainingSet TrainingSet::open(const TrainingSetOptions& options, Context& ctx) {
  if (options.scenes.empty()) fail(ErrorKind::kUsage, "no scene to train on is given");
  if (options.supervision.dim < 1)
    fail(ErrorKind::kUsage, "features of ", options.supervision.dim, " numbers are not possible");
  TrainingSet set;
  set.options_ = options;
  std::set<std::string> seen;
  for (const std::string& path : options.scenes) {
    set.add_scene(path);
    std::error_code ignored;
    const std::string& same = set.scenes_.back().path();
    if (!seen.insert(std::filesystem::weakly_canonical(same, ignored).string()).second)
      fail(ErrorKind::kUsage, path, ": the scene is given twice");
  }
  set.check_samples(ctx);
  return set;
}

void TrainingSet::add_scene(const std::string& path) {
  Scene scene = Scene::open(path);
  TokenCache tokens = TokenCache::open(token_folder(options_, scene));
  check_settings(tokens, options_);
  if (!tokens_.empty()) {
    TokenSettings here = tokens.manifest().settings;
    here.storage = tokens_.front().manifest().settings.storage;  // the scenes may differ in this
    const std::string difference = token_difference(here, tokens_.front().manifest().settings);
    LVGGT_CHECK(difference.empty(), tokens.folder(), ": its tokens and those of ",
                tokens_.front().folder(), " were made with different settings: ", difference);
  }
  std::vector<std::int64_t> numbers;
  for (const SceneFrame& frame : scene.frames()) numbers.push_back(frame.number);
  const Split split = split_frames(numbers, options_.split, path);
  const auto add = [&](const std::vector<std::int64_t>& positions, std::vector<Sample>& to) {
    const TokenManifest& manifest = tokens.manifest();
    for (const std::int64_t position : positions) {
      Sample sample;
      sample.scene = scenes_.size();
      sample.frame = scene.frames()[static_cast<std::size_t>(position)];
      sample.h = manifest.h();
      sample.w = manifest.w();
      std::tie(sample.H, sample.W) = target_size(manifest.transform, options_.target);
      to.push_back(std::move(sample));
    }
  };
  add(split.train, train_);
  add(split.held_out, held_out_);
  for (const std::string& warning : scene.warnings()) warnings_.push_back(warning);
  scenes_.push_back(std::move(scene));
  tokens_.push_back(std::move(tokens));
}

// Errors are caught by the caller, who puts scene and frame before them.
TrainingSet::Finding TrainingSet::check_sample(Sample& sample) const {
  const Scene& scene = scenes_[sample.scene];
  const TokenCache& tokens = tokens_[sample.scene];
  const ImageTransform& transform = tokens.manifest().transform;
  const SupervisionSpec& spec = options_.supervision;

  const std::vector<std::byte> picture = read_file(sample.frame.image);
  const ImageSize size = check_image(picture, sample.frame.image);
  LVGGT_CHECK(size.width == transform.original_width && size.height == transform.original_height,
              sample.frame.image, ": has ", size_text(size.width, size.height),
              " pixels, but the tokens in ", tokens.folder(), " were made from pictures of ",
              size_text(transform.original_width, transform.original_height));
  std::tie(sample.rows_path, sample.codes_path) = scene.label_files(sample.frame, spec);
  const LabelHeader header = check_labels(sample.rows_path, sample.codes_path, spec);
  LVGGT_CHECK(header.W == size.width && header.H == size.height, sample.rows_path, ": labels ",
              size_text(header.W, header.H), " pixels, but ", sample.frame.image, " has ",
              size_text(size.width, size.height),
              header.W == size.height && header.H == size.width
                  ? "; one of them is turned by 90 degrees"
                  : "");
  const std::string image_sha256 = sha256(picture);
  const TokenFrame* token_frame = tokens.find(sample.frame.name);
  LVGGT_CHECK(token_frame == nullptr || token_frame->image_sha256 == image_sha256,
              sample.frame.image, ": is not the picture that the tokens in ", tokens.folder(),
              " were made from");
  tokens.check(sample.frame.name);

  Finding finding;
  finding.manifest_line = concat(scene.name(), " ", sample.frame.name, " ", image_sha256, " ",
                                 tokens.find(sample.frame.name)->stream_sha256, " ", header.H, " ",
                                 header.W, " ", sha256_file(sample.codes_path));
  if (options_.check_labels) {
    sample.labelled = num_labelled(read_labels(sample.rows_path, sample.codes_path, spec), spec);
    finding.manifest_line += " " + sha256_file(sample.rows_path);
  } else {
    check_codes(sample.codes_path);
  }
  return finding;
}

void TrainingSet::check_samples(Context& ctx) {
  std::vector<Sample*> samples;
  for (Sample& sample : train_) samples.push_back(&sample);
  for (Sample& sample : held_out_) samples.push_back(&sample);
  std::vector<Finding> findings(samples.size());
  parallel_chunks(
      static_cast<std::int64_t>(samples.size()),
      [&](std::int64_t chunk, int) {
        const auto i = static_cast<std::size_t>(chunk);
        try {
          findings[i] = check_sample(*samples[i]);
        } catch (const Error& error) {
          findings[i] = {true, error.kind(),
                         concat("scene ", scenes_[samples[i]->scene].name(), ", frame ",
                                samples[i]->frame.name, ": ", error.what()),
                         ""};
        }
      },
      ctx);

  std::size_t num_problems = 0;
  std::string problems;
  const Finding* first = nullptr;
  for (const Finding& finding : findings) {
    if (!finding.failed) continue;
    if (first == nullptr) first = &finding;
    if (num_problems++ < kMaxProblems) problems += (problems.empty() ? "" : "; ") + finding.problem;
  }
  if (num_problems > kMaxProblems)
    problems += concat("; and ", num_problems - kMaxProblems, " frames more have problems");
  if (first != nullptr) fail(first->kind, problems);

  std::string manifest =
      concat(supervision_name(options_.supervision.kind), " ", options_.supervision.dim, " ",
             options_.target == TargetSize::kModelFrame ? "model" : "original", " ",
             options_.check_labels ? "labels" : "headers", " ", train_.size(), "\n");
  for (const Finding& finding : findings) manifest += finding.manifest_line + "\n";
  manifest_sha256_ = sha256_text(manifest);
  if (!options_.check_labels) return;
  std::int64_t unlabelled = 0;
  std::string example;
  for (const Sample& sample : train_) {
    if (sample.labelled > 0) continue;
    if (unlabelled++ == 0)
      example = concat("scene ", scenes_[sample.scene].name(), ", frame ", sample.frame.name);
  }
  LVGGT_CHECK(unlabelled < static_cast<std::int64_t>(train_.size()),
              "no frame to train on has a single labelled pixel, ", example,
              " for instance; there is nothing to learn the language features from");
  if (unlabelled > 0)
    warnings_.push_back(concat(unlabelled, unlabelled == 1 ? " frame" : " frames",
                               " to train on without any labelled pixel, such as ", example,
                               "; only their colours are learned from"));
}

void TrainingSet::read(const SampleViews& out, const Sample& sample) const {
  const TokenCache& tokens = tokens_[sample.scene];
  const TokenManifest& manifest = tokens.manifest();
  if (!out.taps[0].empty()) tokens.read(out.taps, sample.frame.name);
  if (!out.image.empty()) {
    PreprocessOptions preprocess = manifest.settings.preprocess;
    if (options_.target == TargetSize::kOriginal) preprocess.mode = FrameMode::kGt;
    const Image image = load_image(sample.frame.image);
    LVGGT_CHECK(image.width() == manifest.transform.original_width &&
                    image.height() == manifest.transform.original_height,
                sample.frame.image, ": has changed its size to ",
                size_text(image.width(), image.height()));
    const PreparedFrame prepared = prepare_frame(image, preprocess);
    LVGGT_CHECK(out.image.dense() && out.image.shape() == prepared.pixels.shape(),
                "training set: the room for the picture is ", out.image.shape(), ", but it is ",
                prepared.pixels.shape());
    std::copy_n(prepared.pixels.data(), prepared.pixels.size(), out.image.data());
  }
  if (out.features.empty()) return;
  const FrameLabels labels = read_labels(sample.rows_path, sample.codes_path, options_.supervision);
  LVGGT_CHECK(labels.rows.extent(1) == manifest.transform.original_height &&
                  labels.rows.extent(2) == manifest.transform.original_width,
              sample.rows_path, ": has changed its size to ",
              size_text(labels.rows.extent(2), labels.rows.extent(1)));
  paint_targets(out.features, out.mask, labels, options_.supervision, manifest.transform,
                options_.target == TargetSize::kOriginal);
}

std::vector<std::pair<std::string, std::string>> TrainingSet::description() const {
  const TokenManifest& manifest = tokens_.front().manifest();
  std::vector<std::pair<std::string, std::string>> lines{
      {"supervision", std::string(supervision_name(options_.supervision.kind))},
      {"features", std::to_string(options_.supervision.dim)},
      {"levels", std::to_string(options_.supervision.levels())},
      {"target_size", options_.target == TargetSize::kModelFrame ? "model" : "original"},
      {"frames_train", std::to_string(train_.size())},
      {"frames_held_out", std::to_string(held_out_.size())},
      {"encoder_sha256", manifest.settings.encoder_sha256}};
  for (const Scene& scene : scenes_) lines.emplace_back("scene", scene.path());
  return lines;
}

}  // namespace lvggt
