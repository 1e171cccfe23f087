// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <functional>
#include <optional>
#include <string>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/language/query.h"
#include "lvggt/language/text_encoder.h"

namespace lvggt {

// What is asked of a field: where phrases are, and when states hold. A state is a whole sentence
// ("the cup is tilted"); where its object is, is asked with the sentence itself.
struct Questions {
  std::vector<std::string> phrases, states;
  std::int64_t size() const { return static_cast<std::int64_t>(phrases.size() + states.size()); }
  // The phrases, then the states.
  std::vector<std::string> all() const;
};

// Most questions asked at once.
inline constexpr std::int64_t kMaxQuestions = 10'000;

// kUsage for no questions, too many, and empty ones, which are named by their number.
void check_questions(const Questions& questions);

// The questions as vectors of unit length.
struct QuestionVectors {
  Tensor<float, 2> phrases;    // [phrases + states, D], in CLIP's space
  Tensor<float, 2> canonical;  // [c, D]
  Tensor<float, 2> states;     // [states, D'], in the sentence encoder's; empty without states
};
// `sentences` may be null when there are no states.
QuestionVectors encode_questions(const Questions& questions, const TextEncoder& phrases,
                                 const TextEncoder* sentences, Context& ctx);

// The answer to one question about one frame. Views live until the callback returns.
struct FrameAnswer {
  std::int64_t question = 0;             // index in Questions::all()
  View<const float, 2> relevancy;        // [H, W], filtered, at the chosen level
  View<const std::uint8_t, 2> mask;      // [H, W], 0 or 1, after the majority
  View<const std::uint8_t, 2> mask_raw;  // [H, W], before it
  std::int64_t level = 0;                // the chosen one
  float score = 0;                       // largest relevancy at that level
  float similarity = 0;                  // of a state: mean cosine inside mask_raw
};

// Any number of questions to one frame after the other. The frame's codes are decoded once for
// every kAtOnce questions, whose maps are all that is in memory.
class FieldQuery {
 public:
  static constexpr std::int64_t kAtOnce = 64;

  // Keeps references to the decoders; `state_decoder` may be null when there are no states.
  FieldQuery(const DecodedCosines& decoder, const DecodedCosines* state_decoder,
             const QuestionVectors& vectors, const PhraseQueryOptions& options, Context& ctx);

  std::int64_t size() const { return num_phrases_ + num_states_; }

  // Calls answer(...) once for each question, in order.
  //   codes: [level, H, W, d]   state_codes: [1, H, W, d'], empty without states
  void ask(View<const float, 4> codes, View<const float, 4> state_codes,
           const std::function<void(const FrameAnswer&)>& answer, Context& ctx);

  // Bytes of the maps of n questions about frames of H x W.
  static std::size_t map_bytes(std::int64_t n, std::int64_t H, std::int64_t W);

 private:
  struct Group {
    std::int64_t first = 0, count = 0;  // questions
    std::int64_t first_state = 0;       // of them, counted in the group; count without any
    PhraseQuery where;
    std::optional<StateQuery> when;
  };

  std::int64_t num_phrases_ = 0, num_states_ = 0;
  std::vector<Group> groups_;
  PhraseAnswers answers_;
  std::vector<float> similarity_;
};

}  // namespace lvggt
