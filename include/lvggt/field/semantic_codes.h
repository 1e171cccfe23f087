// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"

namespace lvggt {

// What the semantic codes of all frames of a run have in common. A code is what a decoder says of a
// pixel: a short vector (3 values for CLIP, 6 for dynamic semantics) that an autoencoder turns into
// one that can be compared with words.
struct CodesFormat {
  std::vector<std::string> levels;  // names, in order
  std::int64_t height = 0, width = 0;
  std::int64_t dim = 0;        // values of a code
  std::string decoder_sha256;  // of the decoder's tensors, see decoder_sha256()

  std::int64_t num_levels() const { return static_cast<std::int64_t>(levels.size()); }
  Shape<4> shape() const { return {num_levels(), height, width, dim}; }
  friend bool operator==(const CodesFormat&, const CodesFormat&) = default;
};

// Writes the codes of one frame, half precision, as a safetensors file with the one tensor "codes",
// [level, H, W, d], channels last; its metadata hold "format_version" 1, "levels" (names, separated
// by blanks), "frame" (its number in the run) and "decoder_sha256". Errors: kNumeric for a value
// beyond half precision, kMismatch for another shape, kWrite.
//   codes: [level, H, W, d]
void write_codes(const std::string& path, View<const float, 4> codes, const CodesFormat& format,
                 std::int64_t frame);

// Reads them back. Errors: what Safetensors::open throws; kMismatch for codes of another shape,
// decoder or frame, kNumeric for values that are not finite.
//   codes: [level, H, W, d], dense
void read_codes(View<float, 4> codes, const std::string& path, const CodesFormat& format,
                std::int64_t frame);

}  // namespace lvggt
