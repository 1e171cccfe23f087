// SPDX-License-Identifier: Apache-2.0
#include "examples/query_video/session.h"

#include <algorithm>

#include "lvggt/language/load_text_encoder.h"

namespace query_video {

using namespace lvggt;

Session::Session(const Options& options, Context& ctx)
    : field_(LiftedField::open(options.field)), every_(options.every), protocol_(options.protocol) {
  // What is cheap to check comes before what is slow to load.
  clip_.levels = field_.codes(CodesKind::kLanguage).levels;
  if (options.asks_states()) field_.codes(CodesKind::kState);
  clip_.height = field_.height();
  clip_.width = field_.width();
  clip_.min_score = options.min_score;
  for (std::int64_t i = 0; i < field_.num_frames(); i += every_)
    clip_.frames.push_back(field_.frames()[static_cast<std::size_t>(i)]);

  autoencoder_.emplace(Autoencoder::load(options.autoencoder));
  decoder_.emplace(*autoencoder_, ctx);
  if (options.asks_states()) {
    state_autoencoder_.emplace(Autoencoder::load(options.state_autoencoder));
    state_decoder_.emplace(*state_autoencoder_, ctx);
  }
  TextEncoderOptions text;
  text.vocabulary = options.vocabulary;
  text_ = load_text_encoder(options.text_encoder, text);
  if (options.asks_states()) sentences_ = load_text_encoder(options.sentence_encoder);
  check_fit(options);
}

void Session::check_fit(const Options& options) const {
  const auto check = [&](CodesKind kind, const Autoencoder& autoencoder, const std::string& file,
                         const TextEncoder& encoder, const std::string& encoder_path) {
    const CodesFormat& codes = field_.codes(kind);
    LVGGT_CHECK(codes.dim == autoencoder.code_width(), file, ": turns codes of ",
                autoencoder.code_width(), " values into words' space, but the ", codes_folder(kind),
                " of ", field_.path(), " have ", codes.dim);
    LVGGT_CHECK(encoder.width() == autoencoder.feature_width(), encoder_path,
                ": gives embeddings of ", encoder.width(), " values, but the autoencoder ", file,
                " decodes to ", autoencoder.feature_width());
  };
  check(CodesKind::kLanguage, *autoencoder_, options.autoencoder, *text_, options.text_encoder);
  if (!sentences_) return;
  check(CodesKind::kState, *state_autoencoder_, options.state_autoencoder, *sentences_,
        options.sentence_encoder);
  const CodesFormat& states = field_.codes(CodesKind::kState);
  LVGGT_CHECK(states.num_levels() == 1, field_.path(), ": its states have ", states.num_levels(),
              " levels; a state query knows one");
}

std::size_t Session::planned_bytes(std::int64_t n) const {
  const auto values = [&](CodesKind kind) {
    return field_.has_codes(kind) ? static_cast<std::size_t>(field_.codes(kind).shape().volume())
                                  : 0;
  };
  const auto pixels = static_cast<std::size_t>(field_.height() * field_.width());
  // The picture, its painted copies, depth, confidence and the point cloud; of the overview eight
  // frames, each with a picture and a mask for up to eight questions; code and scratch to come.
  const std::size_t per_pixel =
      96 + 8 * (3 + 4 * static_cast<std::size_t>(std::min<std::int64_t>(n, 8)));
  constexpr std::size_t kProgram = std::size_t{12} << 20;
  return sizeof(float) * (values(CodesKind::kLanguage) + values(CodesKind::kState)) +
         FieldQuery::map_bytes(n, field_.height(), field_.width()) + per_pixel * pixels + kProgram;
}

void Session::keep_codes(std::size_t limit) {
  keep_limit_ = limit;
  kept_.resize(clip_.frames.size());
}

const Session::Codes& Session::read_codes(std::size_t i, bool states) {
  const auto read = [&](Tensor<float, 4>& codes, CodesKind kind) {
    const Shape<4> shape = field_.codes(kind).shape();
    if (codes.shape() != shape) codes = Tensor<float, 4>(shape);
    field_.read_codes(codes, kind, position(i));
  };
  if (kept_.empty()) {
    read(buffer_.language, CodesKind::kLanguage);
    if (states) read(buffer_.states, CodesKind::kState);
    return buffer_;
  }
  Codes& kept = kept_[i];
  const auto keep = [&](Tensor<float, 4>& codes, CodesKind kind, Tensor<float, 4>& otherwise) {
    if (!codes.empty()) return true;
    const std::size_t bytes =
        sizeof(float) * static_cast<std::size_t>(field_.codes(kind).shape().volume());
    if (bytes > keep_limit_) {
      read(otherwise, kind);
      return false;
    }
    keep_limit_ -= bytes;
    read(codes, kind);
    return true;
  };
  bool all = keep(kept.language, CodesKind::kLanguage, buffer_.language);
  if (states && !keep(kept.states, CodesKind::kState, buffer_.states)) {
    if (all) buffer_.language = kept.language.clone();
    all = false;
  } else if (states && !all) {
    buffer_.states = kept.states.clone();
  }
  return all ? kept : buffer_;
}

FrameInputs Session::read_inputs(std::size_t i, bool points) const {
  FrameInputs frame;
  frame.record = clip_.frames[i];
  frame.picture = field_.has_pictures()
                      ? field_.read_picture(position(i))
                      : Tensor<std::uint8_t, 3>(Shape{clip_.height, clip_.width, std::int64_t{3}});
  if (points) {
    frame.depth = Tensor<float, 2>(Shape{clip_.height, clip_.width});
    frame.confidence = Tensor<float, 2>(Shape{clip_.height, clip_.width});
    field_.read_depth(frame.depth, position(i));
    field_.read_confidence(frame.confidence, position(i));
  }
  return frame;
}

std::vector<Result> Session::ask(const Questions& questions, const AnswerTarget& target,
                                 const Hooks& hooks, Context& ctx) {
  const QuestionVectors vectors = encode_questions(questions, *text_, sentences_.get(), ctx);
  for (const std::string& warning : text_->warnings(questions.all())) hooks.warn(warning);
  const bool states = !questions.states.empty();
  if (states)
    for (const std::string& warning : sentences_->warnings(questions.states)) hooks.warn(warning);
  FieldQuery query(*decoder_, states ? &*state_decoder_ : nullptr, vectors, protocol_, ctx);

  const bool points = target.per_frame() && target.outputs.points;
  Answers answers(clip_, field_, questions, target,
                  [&](std::size_t i) { return read_inputs(i, points); });
  const std::size_t num_frames = clip_.frames.size();
  for (std::size_t i = 0; i < num_frames; ++i) {
    const Codes& codes = read_codes(i, states);
    answers.start_frame();
    query.ask(
        codes.language, states ? codes.states.view() : View<const float, 4>(),
        [&](const FrameAnswer& answer) { answers.take(answer, ctx); }, ctx);
    if (hooks.stop())
      fail(ErrorKind::kInterrupted, "interrupted after ", i + 1, " of ", num_frames, " frames");
    hooks.progress(static_cast<std::int64_t>(i) + 1);
  }
  return answers.finish(ctx);
}

}  // namespace query_video
