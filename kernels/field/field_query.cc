// SPDX-License-Identifier: Apache-2.0
#include "lvggt/field/field_query.h"

#include <algorithm>

namespace lvggt {
namespace {

void check_texts(const std::vector<std::string>& texts, const char* what) {
  for (std::size_t i = 0; i < texts.size(); ++i)
    if (texts[i].find_first_not_of(" \t\r\n") == std::string::npos)
      fail(ErrorKind::kUsage, what, " ", i + 1, " of ", texts.size(), " is empty");
}

}  // namespace

std::vector<std::string> Questions::all() const {
  std::vector<std::string> texts = phrases;
  texts.insert(texts.end(), states.begin(), states.end());
  return texts;
}

void check_questions(const Questions& questions) {
  if (questions.size() == 0) fail(ErrorKind::kUsage, "nothing is asked: give a phrase or a state");
  if (questions.size() > kMaxQuestions)
    fail(ErrorKind::kUsage, questions.size(), " questions are more than the limit of ",
         kMaxQuestions);
  check_texts(questions.phrases, "phrase");
  check_texts(questions.states, "state");
}

QuestionVectors encode_questions(const Questions& questions, const TextEncoder& phrases,
                                 const TextEncoder* sentences, Context& ctx) {
  check_questions(questions);
  LVGGT_CHECK(questions.states.empty() || sentences != nullptr,
              "states are asked for, but there is no sentence encoder");
  QuestionVectors vectors{
      phrases.encode(questions.all(), ctx), phrases.encode(canonical_phrases(), ctx), {}};
  if (!questions.states.empty()) vectors.states = sentences->encode(questions.states, ctx);
  return vectors;
}

FieldQuery::FieldQuery(const DecodedCosines& decoder, const DecodedCosines* state_decoder,
                       const QuestionVectors& vectors, const PhraseQueryOptions& options,
                       Context& ctx)
    : num_states_(vectors.states.empty() ? 0 : vectors.states.extent(0)) {
  const std::int64_t n = vectors.phrases.extent(0);
  LVGGT_CHECK(n > 0 && num_states_ <= n, "field query: there are ", n, " questions and ",
              num_states_, " states");
  LVGGT_CHECK(num_states_ == 0 || state_decoder != nullptr,
              "field query: states are asked for, but there is no decoder of states");
  num_phrases_ = n - num_states_;
  for (std::int64_t first = 0; first < n; first += kAtOnce) {
    const std::int64_t end = std::min(first + kAtOnce, n);
    const std::int64_t from = std::clamp(num_phrases_, first, end);
    Group group{first, end - first, from - first,
                PhraseQuery(decoder, vectors.phrases.view().narrow(0, first, end),
                            vectors.canonical, options, ctx),
                std::nullopt};
    if (from < end)
      group.when.emplace(*state_decoder,
                         vectors.states.view().narrow(0, from - num_phrases_, end - num_phrases_),
                         ctx);
    groups_.push_back(std::move(group));
  }
}

std::size_t FieldQuery::map_bytes(std::int64_t n, std::int64_t H, std::int64_t W) {
  // Relevancy as float, filtered at the level at hand and the best so far, and two masks.
  constexpr std::size_t kBytes = 2 * sizeof(float) + 2;
  return static_cast<std::size_t>(std::min(n, kAtOnce)) * static_cast<std::size_t>(H) *
         static_cast<std::size_t>(W) * kBytes;
}

void FieldQuery::ask(View<const float, 4> codes, View<const float, 4> state_codes,
                     const std::function<void(const FrameAnswer&)>& answer, Context& ctx) {
  LVGGT_CHECK(num_states_ == 0 || (state_codes && state_codes.extent(0) == 1 &&
                                   state_codes.extent(1) == codes.extent(1) &&
                                   state_codes.extent(2) == codes.extent(2)),
              "field query: states need codes of one level beside codes of ", codes.shape(),
              ", not ", state_codes.shape());
  for (const Group& group : groups_) {
    group.where.answer(answers_, codes, ctx);
    if (group.when) {
      similarity_.resize(static_cast<std::size_t>(group.count - group.first_state));
      group.when->similarity(similarity_, state_codes[0],
                             answers_.mask_raw.view().narrow(0, group.first_state, group.count),
                             ctx);
    }
    for (std::int64_t i = 0; i < group.count; ++i) {
      FrameAnswer one;
      one.question = group.first + i;
      one.relevancy = answers_.relevancy[i];
      one.mask = answers_.mask[i];
      one.mask_raw = answers_.mask_raw[i];
      one.level = answers_.level[static_cast<std::size_t>(i)];
      one.score = answers_.score(i, one.level);
      if (i >= group.first_state)
        one.similarity = similarity_[static_cast<std::size_t>(i - group.first_state)];
      answer(one);
    }
  }
}

}  // namespace lvggt
