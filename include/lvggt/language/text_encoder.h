// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// Longest phrase or sentence that an encoder takes, in bytes.
inline constexpr std::int64_t kMaxPhraseBytes = 4096;

// Turns phrases into vectors of the space that a language field was made in: CLIP for what
// something is, a sentence encoder for what state it is in. One encoder may serve several calls,
// one at a time for each Context.
class TextEncoder {
 public:
  virtual ~TextEncoder() = default;

  // Length of a vector: 512 for CLIP ViT-B/16, 4096 for e5-mistral-7b.
  virtual std::int64_t width() const = 0;

  // One row of length 1 a phrase.   result: [n, width]
  // Errors: kMismatch for a phrase that is empty, is nothing but white space, or that a precomputed
  // list does not have (naming both); kFormat for text that is not UTF-8; kLimit above
  // kMaxPhraseBytes.
  virtual Tensor<float, 2> encode(std::span<const std::string> phrases, Context& ctx) const = 0;

  // What encode() would change about these phrases, a sentence each: text beyond the encoder's
  // context is cut. Programs show them; empty when there is nothing to say.
  virtual std::vector<std::string> warnings(std::span<const std::string> phrases) const {
    static_cast<void>(phrases);
    return {};
  }

  // "OpenCLIP text tower, 12 layers of width 512, GELU, from FILE": for messages and run.json.
  virtual std::string describe() const = 0;
};

}  // namespace lvggt
