// SPDX-License-Identifier: Apache-2.0
#include <array>
#include <optional>

#include "examples/evaluate/codes_source.h"
#include "lvggt/data/token_cache.h"
#include "lvggt/io/image.h"
#include "lvggt/io/safetensors.h"
#include "lvggt/kernels/elementwise.h"
#include "lvggt/model/checkpoint.h"
#include "lvggt/model/parameters.h"
#include "lvggt/model/semantic_bridging_decoder.h"
#include "lvggt/model/token_stream.h"

namespace evaluate {

using namespace lvggt;

// A decoder's file as something the inference loaders read.
class DecoderFile {
 public:
  DecoderFile(const std::string& path, const std::string& config_path)
      : file_(Safetensors::open(path)) {
    const auto text = file_.metadata().find("config");
    if (!config_path.empty()) {
      config_ = load_config(config_path);
    } else if (text != file_.metadata().end()) {
      config_ = parse_config(text->second, path + ": configuration in the metadata");
    } else {
      fail(ErrorKind::kUsage, path, ": has no configuration in its metadata; give --config");
    }
    for (const TensorSpec& spec : decoder_tensors(config_)) {
      const TensorEntry* entry = file_.find(spec.name);
      LVGGT_CHECK(entry != nullptr && entry->shape == spec.shape, path, ": is no decoder of its ",
                  "configuration: ", spec.name,
                  entry == nullptr
                      ? std::string(" is missing")
                      : concat(" is ", shape_text(entry->shape), ", not ", shape_text(spec.shape)));
    }
  }
  const ModelConfig& config() const { return config_; }
  template <int R>
  Tensor<float, R> read(const std::string& name) const {
    Tensor<float, R> values = file_.read<R>(name);
    const View<const float, 1> flat(values.data(), Shape{values.size()});
    if (const std::int64_t bad = find_nonfinite(flat); bad >= 0)
      fail(ErrorKind::kFormat, file_.path(), ": ", name, " is ", flat[bad], " at element ", bad);
    return values;
  }

 private:
  Safetensors file_;
  ModelConfig config_;
};

Storage storage_of(const DecoderFile&, const std::string&) { return Storage::kF32; }

namespace {

using Taps = std::array<View<const float, 2>, 4>;

// The tokens of a scene's frames, one after the other.
class TokenSource {
 public:
  virtual ~TokenSource() = default;
  virtual Taps read(const SceneFrame& frame) = 0;  // four times [h*w, 2C]
  virtual const ImageTransform& transform() const = 0;
  virtual ModelConfig encoder() const = 0;  // sizes of what made them
};

class CachedTokens : public TokenSource {
 public:
  explicit CachedTokens(const std::string& folder) : cache_(TokenCache::open(folder)) {
    const TokenManifest& manifest = cache_.manifest();
    for (auto& tap : taps_)
      tap = Tensor<float, 2>(Shape{manifest.h() * manifest.w(), manifest.channels()});
  }
  Taps read(const SceneFrame& frame) override {
    LVGGT_CHECK(cache_.find(frame.name) != nullptr, cache_.folder(), ": has no tokens of frame ",
                frame.name);
    cache_.read({taps_[0].view(), taps_[1].view(), taps_[2].view(), taps_[3].view()}, frame.name);
    return {std::as_const(taps_[0]).view(), std::as_const(taps_[1]).view(),
            std::as_const(taps_[2]).view(), std::as_const(taps_[3]).view()};
  }
  const ImageTransform& transform() const override { return cache_.manifest().transform; }
  ModelConfig encoder() const override { return cache_.manifest().settings.config; }

 private:
  TokenCache cache_;
  std::array<Tensor<float, 2>, 4> taps_;
};

// Every frame of the scene up to the one asked for goes through the encoder.
class StreamedTokens : public TokenSource {
 public:
  StreamedTokens(const RunSpec& run, const Scene& scene, Context& ctx)
      : scene_(scene), checkpoint_(load_options(run)), config_(checkpoint_.config()) {
    preprocess_.mode = parse_frame_mode(run.mode);
    preprocess_.size = run.size > 0 ? run.size : static_cast<int>(config_.img_size);
    aggregator_.emplace(load_aggregator(checkpoint_, ctx));
    StreamOptions options;
    options.max_past_frames = run.max_past_frames;
    stream_.emplace(*aggregator_, ctx, options);
    const Image first = load_image(scene.frames().front().image);
    transform_ = plan_frame(first.width(), first.height(), preprocess_);
  }
  Taps read(const SceneFrame& frame) override {
    Taps taps;
    for (; next_ < scene_.frames().size(); ++next_) {
      const SceneFrame& current = scene_.frames()[next_];
      if (current.number > frame.number) break;
      taps = stream_->push(prepare_frame(load_image(current.image), preprocess_).pixels);
      if (current.number == frame.number) {
        ++next_;
        return taps;
      }
    }
    fail(ErrorKind::kMismatch, scene_.path(), ": frame ", frame.number,
         " was asked for out of order");
  }
  const ImageTransform& transform() const override { return transform_; }
  ModelConfig encoder() const override { return encoder_config(config_); }

 private:
  static LoadOptions load_options(const RunSpec& run) {
    LoadOptions load;
    load.weights = run.weights;
    load.config = run.config;
    load.points = false;
    return load;
  }
  const Scene& scene_;
  Checkpoint checkpoint_;
  ModelConfig config_;
  PreprocessOptions preprocess_;
  std::optional<Aggregator> aggregator_;
  std::optional<TokenStream> stream_;
  ImageTransform transform_;
  std::size_t next_ = 0;
};

// One decoder, for the language or for the states.
class Decoder {
 public:
  Decoder(const std::string& path, const RunSpec& run, const TokenSource& tokens)
      : stretched_(run.stretched) {
    const DecoderFile file(path, run.config);
    config_ = file.config();
    const ModelConfig encoder = tokens.encoder();
    LVGGT_CHECK(encoder.embed_dim == config_.embed_dim && encoder.patch_size == config_.patch_size,
                path, ": the decoder reads tokens of width ", 2 * config_.embed_dim,
                " and patches of ", config_.patch_size, ", but these are of width ",
                2 * encoder.embed_dim, " and patches of ", encoder.patch_size);
    decoder_ = load_semantic_bridging_decoder(file);
  }

  std::int64_t levels() const { return config_.sbd_levels; }
  std::int64_t dim() const { return config_.lang_dim; }

  // out: [levels, H, W, d], in the picture's pixels
  void run(View<float, 4> out, const Taps& taps, const ImageTransform& transform, Context& ctx) {
    const std::int64_t p = config_.patch_size, h = transform.height / p, w = transform.width / p;
    if (stretched_) {
      semantic_bridging_decoder_forward(out, {}, taps, h, w, h * p, w * p, decoder_, nullptr, ctx);
      return;
    }
    Arena::Scope scope(ctx.arena());
    const View<float, 4> model = ctx.arena().alloc(Shape{levels(), h * p, w * p, dim()});
    semantic_bridging_decoder_forward(model, {}, taps, h, w, h * p, w * p, decoder_, nullptr, ctx);
    for (std::int64_t level = 0; level < levels(); ++level)
      resample_to_picture(out[level], model[level], transform);
  }

 private:
  bool stretched_;
  ModelConfig config_;
  SemanticBridgingDecoder decoder_;
};

class DecoderSource : public CodesSource {
 public:
  DecoderSource(const RunSpec& run, const Scene& scene, Context& ctx) : scene_(scene), ctx_(ctx) {
    const auto path = [&](const std::string& text) {
      return RunSpec::for_scene(text, scene.name());
    };
    if (run.weights.empty())
      tokens_ = std::make_unique<CachedTokens>(run.tokens.empty() ? scene.path() + "/lvggt_tokens"
                                                                  : path(run.tokens));
    else
      tokens_ = std::make_unique<StreamedTokens>(run, scene, ctx);
    language_.emplace(path(run.decoder), run, *tokens_);
    if (run.state_decoder.empty()) return;
    if (!run.state_tokens.empty())
      state_tokens_ = std::make_unique<CachedTokens>(path(run.state_tokens));
    states_.emplace(path(run.state_decoder), run, state_tokens_ ? *state_tokens_ : *tokens_);
    LVGGT_CHECK(states_->levels() == 1, path(run.state_decoder), ": has ", states_->levels(),
                " levels, but dynamic semantics have one");
  }

  bool has_states() const override { return states_.has_value(); }

  void read(FrameCodes& codes, std::int64_t frame, std::int64_t H, std::int64_t W) override {
    const Taps taps = tokens_->read(frame_of(scene_, frame));
    const Shape maps{language_->levels(), H, W, language_->dim()};
    if (codes.language.shape() != maps) codes.language = Tensor<float, 4>(maps);
    language_->run(codes.language, taps, tokens_->transform(), ctx_);
    if (!states_) return;
    const Shape map{H, W, states_->dim()};
    if (codes.states.shape() != map) codes.states = Tensor<float, 3>(map);
    TokenSource& tokens = state_tokens_ ? *state_tokens_ : *tokens_;
    states_->run(batch_of_one(codes.states.view()),
                 state_tokens_ ? tokens.read(frame_of(scene_, frame)) : taps, tokens.transform(),
                 ctx_);
  }

 private:
  const Scene& scene_;
  Context& ctx_;
  std::unique_ptr<TokenSource> tokens_, state_tokens_;
  std::optional<Decoder> language_, states_;
};

}  // namespace

std::unique_ptr<CodesSource> open_decoders(const RunSpec& run, const Scene& scene, Context& ctx) {
  return std::make_unique<DecoderSource>(run, scene, ctx);
}

}  // namespace evaluate
