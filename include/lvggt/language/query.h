// SPDX-License-Identifier: Apache-2.0
// Asking a language field in words, frame by frame. Where something is:
//
//   const DecodedCosines decoder(autoencoder, ctx);
//   const PhraseQuery where(decoder, text_encoder.encode(phrases, ctx),
//                           text_encoder.encode(canonical_phrases(), ctx), {}, ctx);
//   PhraseAnswers answers;
//   where.answer(answers, codes, ctx);        // for each frame; codes: [levels, H, W, 3]
//
// When a state holds: the state's sentence is one of the phrases above, and inside its raw mask
//
//   const DecodedCosines state_decoder(dynamic_autoencoder, ctx);
//   const StateQuery when(state_decoder, sentence_encoder.encode(sentences, ctx), ctx);
//   when.similarity(series[frame], dynamic_codes, answers.mask_raw, ctx);
//   answer_over_time(...)                     // once all frames are in
#pragma once

#include <cstdint>
#include <span>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/language/relevancy.h"
#include "lvggt/language/time_series.h"

namespace lvggt {

// The published protocol by default.
struct PhraseQueryOptions {
  std::int64_t box = 29;         // side of the box filter, pixels, odd
  std::int64_t majority = 7;     // side of the majority filter, pixels, odd
  float threshold = 0.4F;        // of the scaled relevancy, in [0, 1]
  bool rescale_positive = true;  // frames whose codes are all above 0 are decoded as 2 x - 1
};

// The answers about one frame; its tensors are reused from frame to frame.
struct PhraseAnswers {
  Tensor<float, 3> relevancy;              // [n, H, W], filtered, at the chosen level
  Tensor<std::uint8_t, 3> mask_raw, mask;  // [n, H, W], before and after the majority
  Tensor<float, 2> score;                  // [n, levels], maximum of the filtered relevancy
  std::vector<std::int64_t> level;  // [n], the level with the largest score, the first of equals
  bool rescaled = false;            // codes were decoded as 2 x - 1
};

// Where phrases are, in one frame after the other. Immutable.
class PhraseQuery {
 public:
  // Keeps a reference to the decoder. Errors: as Relevancy; kUsage for windows that are not odd.
  //   phrases: [n, D]   canonical: [c, D], unit rows
  PhraseQuery(const DecodedCosines& decoder, View<const float, 2> phrases,
              View<const float, 2> canonical, const PhraseQueryOptions& options, Context& ctx);

  std::int64_t num_phrases() const { return relevancy_.num_phrases(); }
  const PhraseQueryOptions& options() const { return options_; }

  // Errors: kMismatch for codes of another width; kNumeric for codes that are not finite, naming
  // the first.   codes: [levels, H, W, d]
  void answer(PhraseAnswers& answers, View<const float, 4> codes, Context& ctx) const;

  // The same for one level alone, without choosing: the relevancy before and after the box filter,
  // and the masks.   all: [n, H, W]; empty ones are not wanted   codes: [H, W, d]
  void answer_level(View<float, 3> relevancy, View<float, 3> filtered,
                    View<std::uint8_t, 3> mask_raw, View<std::uint8_t, 3> mask,
                    View<const float, 3> codes, Context& ctx) const;

 private:
  void answer_group(PhraseAnswers& answers, View<const float, 4> codes, std::int64_t g,
                    Context& ctx) const;

  Relevancy relevancy_;
  PhraseQueryOptions options_;
};

// How much the state that a sentence describes holds in a frame: the mean cosine of the decoded
// codes with the sentence's embedding inside a mask. Immutable.
class StateQuery {
 public:
  // Keeps a reference to the decoder.   sentences: [n, D], unit rows
  StateQuery(const DecodedCosines& decoder, View<const float, 2> sentences, Context& ctx);

  std::int64_t num_sentences() const { return sentences_.count(); }

  // One similarity a sentence, each inside its own mask; 0 where the mask is empty.
  //   out: n values   codes: [H, W, d]   masks: [n, H, W], 0 or 1
  void similarity(std::span<float> out, View<const float, 3> codes,
                  View<const std::uint8_t, 3> masks, Context& ctx) const;

 private:
  const DecodedCosines& decoder_;
  DecodedCosines::Vectors sentences_;
};

}  // namespace lvggt
