// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <optional>
#include <string>
#include <vector>

#include "examples/query_video/answers.h"
#include "examples/query_video/options.h"
#include "lvggt/field/field_query.h"
#include "lvggt/field/lifted_field.h"
#include "lvggt/language/autoencoder.h"
#include "lvggt/language/decoded_cosines.h"
#include "lvggt/language/text_encoder.h"

namespace query_video {

// What the program says while it works.
struct Hooks {
  std::function<bool()> stop;                    // asked after each frame
  std::function<void(std::int64_t)> progress;    // frames done
  std::function<void(const std::string&)> warn;  // one sentence
};

// A field and everything that is needed to ask it, loaded once.
class Session {
 public:
  // Errors: those of LiftedField::open, load_text_encoder and Autoencoder::load; kMismatch when
  // codes, autoencoders and encoders do not fit each other, naming the files.
  Session(const Options& options, lvggt::Context& ctx);

  const Clip& clip() const { return clip_; }
  const lvggt::LiftedField& field() const { return field_; }
  const lvggt::TextEncoder& text_encoder() const { return *text_; }
  const lvggt::TextEncoder* sentence_encoder() const { return sentences_.get(); }

  // Bytes that n questions need beside the encoders and autoencoders.
  std::size_t planned_bytes(std::int64_t n) const;

  // Keeps the codes in memory if they fit into `limit` bytes: for questions that come one by one.
  void keep_codes(std::size_t limit);

  // Asks every frame. Errors: those of the readers and encoders; kInterrupted when hooks.stop()
  // says so.
  std::vector<Result> ask(const lvggt::Questions& questions, const AnswerTarget& target,
                          const Hooks& hooks, lvggt::Context& ctx);

 private:
  struct Codes {
    lvggt::Tensor<float, 4> language, states;
  };
  void check_fit(const Options& options) const;
  const Codes& read_codes(std::size_t i, bool states);
  FrameInputs read_inputs(std::size_t i, bool points) const;
  std::int64_t position(std::size_t i) const { return static_cast<std::int64_t>(i) * every_; }

  lvggt::LiftedField field_;
  std::int64_t every_ = 1;
  Clip clip_;
  lvggt::PhraseQueryOptions protocol_;
  std::unique_ptr<lvggt::TextEncoder> text_, sentences_;
  std::optional<lvggt::Autoencoder> autoencoder_, state_autoencoder_;
  std::optional<lvggt::DecodedCosines> decoder_, state_decoder_;
  std::vector<Codes> kept_;  // of each frame, empty until read
  std::size_t keep_limit_ = 0;
  Codes buffer_;
};

}  // namespace query_video
