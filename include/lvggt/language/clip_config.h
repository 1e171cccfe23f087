// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "lvggt/io/json.h"

namespace lvggt {

// What the shapes of CLIP's weights do not tell. Everything else (layers, widths, patch and picture
// size, vocabulary, context) follows from them.
struct ClipConfig {
  std::int64_t image_heads = 0;    // 0: by the rule of clip_heads()
  std::int64_t text_heads = 0;     // 0: the same
  std::optional<bool> quick_gelu;  // x sigmoid(1.702 x) instead of GELU (erf); unset: GELU
  std::string source;              // the file it was read from; empty: none
  std::vector<std::string> notes;  // what had to be assumed, a sentence each
};

// Attention heads of a tower without a configuration: width / 64, but 16 for the widths 1280, 1408
// and 1664 of the published H/14, g/14 and G/14 image towers, whose heads are wider.
std::int64_t clip_heads(std::int64_t width);

// From OpenCLIP's open_clip_config.json (its "model_cfg", or that alone) or Hugging Face's
// config.json. Keys that do not matter here are left alone. Errors: kFormat for a wrong type or a
// number of heads below 1; kMismatch for the configuration of another kind of model.
ClipConfig parse_clip_config(const Json& json, const std::string& source);

// The configuration beside the weights `path` (a file or a folder), with a note where there is
// none.
ClipConfig find_clip_config(const std::string& path);

}  // namespace lvggt
