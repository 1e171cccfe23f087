// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>

#include "examples/check_reference/comparison.h"
#include "lvggt/io/json.h"

namespace check_reference {

// clip: both towers with both activations. `weights` under either naming; `config` is the
// reference's JSON, which holds OpenCLIP's and Hugging Face's configuration.
void check_clip_towers(Comparison& comparison, const std::string& weights,
                       const std::string& config, lvggt::Context& ctx);

// mistral: each sequence alone, and all together.
void check_mistral(Comparison& comparison, const std::string& weights, const std::string& config,
                   lvggt::Context& ctx);

// crops: from label maps to the pixels CLIP sees, exact.
void check_crops(Comparison& comparison);

// tokenizer, a JSON case: every string's clean text and every id, with the vocabulary in
// `vocabulary`. Prints one line a kind of string (and one for each that differs), or one JSON
// object; returns whether all agree.
bool is_tokenizer_case(const lvggt::Json& json);
bool check_tokenizer(const lvggt::Json& json, const std::string& path,
                     const std::string& vocabulary, bool as_json);

}  // namespace check_reference
