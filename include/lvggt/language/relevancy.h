// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <algorithm>
#include <array>
#include <cstdint>
#include <string>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/language/decoded_cosines.h"

namespace lvggt {

// What every phrase is measured against.
inline constexpr std::array<const char*, 4> kCanonicalPhrases{"object", "things", "stuff",
                                                              "texture"};
inline std::vector<std::string> canonical_phrases() {
  return {kCanonicalPhrases.begin(), kCanonicalPhrases.end()};
}

// Sharpness of the softmax between a phrase and a canonical phrase.
inline constexpr float kRelevancyScale = 10;

// The relevancy of phrases q at codes e against canonical phrases c:
//   min over c of softmax(10 <e, q>, 10 <e, c>)[0] = 1 / (1 + exp(10 (max over c of <e,c> -
//   <e,q>)))
// 0.5 where a code decodes to nothing (no length).
class Relevancy {
 public:
  // Keeps a reference to the decoder. Errors: kMismatch for embeddings of another width than the
  // decoder's features, and without any canonical phrase.
  //   phrases: [n, D]   canonical: [c, D], unit rows
  Relevancy(const DecodedCosines& decoder, View<const float, 2> phrases,
            View<const float, 2> canonical, Context& ctx);

  std::int64_t num_phrases() const { return num_phrases_; }
  std::int64_t code_width() const { return decoder_.code_width(); }

  // A map of relevancies for each phrase.   relevancy: [n, N]   codes: [N, d]
  void run(View<float, 2> relevancy, View<const float, 2> codes, Context& ctx) const;

  // The same for the phrases of one group, kGroup of them or what is left: many phrases are worked
  // on group by group, so that memory holds the maps of one.
  //   relevancy: [group_size(g), N]   codes: [N, d]
  static constexpr std::int64_t kGroup = 256;
  std::int64_t num_groups() const { return (num_phrases_ + kGroup - 1) / kGroup; }
  std::int64_t group_size(std::int64_t g) const {
    return std::min(kGroup, num_phrases_ - g * kGroup);
  }
  void run_group(View<float, 2> relevancy, View<const float, 2> codes, std::int64_t g,
                 Context& ctx) const;

 private:
  const DecodedCosines& decoder_;
  std::int64_t num_phrases_ = 0, num_canonical_ = 0;
  std::vector<DecodedCosines::Vectors> groups_;  // canonical phrases, then the group's
};

// The same from products with the canonical phrases and the phrases that were computed elsewhere.
//   relevancy: [n, N]   products: [N, c + n], <e, c> then <e, q>
void relevancy_of_products(View<float, 2> relevancy, View<const float, 2> products,
                           std::int64_t num_canonical, Context& ctx);

// Whether every code is above 0. The published evaluation then takes a frame for one stored in
// [0, 1] and decodes 2 x - 1.   codes: [levels, H, W, d]
bool all_positive(View<const float, 4> codes);

}  // namespace lvggt
