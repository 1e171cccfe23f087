// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <map>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"
#include "lvggt/io/dtype.h"
#include "lvggt/io/preprocess.h"
#include "lvggt/model/checkpoint.h"
#include "lvggt/model/config.h"
#include "lvggt/model/stream_options.h"

namespace lvggt {

// Tokens of a scene's frames on disk: what the frozen geometry encoder says about them and the
// decoder reads, the patch tokens of the four tapped layers.
//   manifest.json        what they were made with, see TokenManifest
//   NAME.safetensors     for each frame: tap.0 to tap.3, each [h*w, 2C], BF16 or F32
// A frame's tokens depend on the frames before it. So each file carries the stream_sha256 of the
// settings and of all pictures up to its own: a file of another run is never taken for one of this.
inline constexpr const char* kTokenManifest = "manifest.json";

// The sizes and constants of the encoder; everything else has its default.
ModelConfig encoder_config(const ModelConfig& config);

// Everything the values depend on but the pictures.
struct TokenSettings {
  std::string encoder_sha256;  // see the function of that name
  ModelConfig config;          // an encoder_config()
  PreprocessOptions preprocess;
  std::int64_t max_past_frames = 128;
  WindowPolicy window = {};
  std::string weights_storage = "f32";  // of the encoder in memory, see encoder_storage()
  Storage cache_storage = Storage::kF32;
  Dtype storage = Dtype::kBF16;  // of the files: kBF16 or kF32
};

// One frame's entry.
struct TokenFrame {
  std::string name;               // of the picture without its extension, or the number in a video
  std::string image;              // file name of the picture; empty for a video
  std::int64_t source_index = 0;  // in the folder or video, counted from 0
  std::string image_sha256;       // of the picture's file, or of a video frame's pixels
  std::string stream_sha256;      // see next_stream_sha256
};

// The hash of a stream that goes on with this picture: that of the settings when `before` is empty,
// else `before`, then the picture's name and hash.
std::string next_stream_sha256(const std::string& before, const TokenSettings& settings,
                               const std::string& name, const std::string& image_sha256);

// manifest.json, format 1.
struct TokenManifest {
  std::string tool_version;
  std::string weights;  // name of the file, for people
  TokenSettings settings;
  ImageTransform transform;            // of every frame
  std::string source;                  // folder or video, for people
  std::string source_sha256;           // of a video's file; empty for a folder
  std::int64_t start = 0, stride = 1;  // which of its frames, see FrameSourceOptions
  std::vector<TokenFrame> frames;      // in the order of the stream
  bool complete = false;               // false: more frames follow once make_tokens is resumed

  std::int64_t h() const { return transform.height / settings.config.patch_size; }
  std::int64_t w() const { return transform.width / settings.config.patch_size; }
  std::int64_t channels() const { return 2 * settings.config.embed_dim; }
};

std::string to_json(const TokenManifest& manifest);

// Errors: kRead, kFormat, kUnsupported (another format version), naming the file and key.
TokenManifest read_token_manifest(const std::string& path);

// How the tokens differ from what is wanted: "embed_dim is 192, not 1024; ..."; empty if not at
// all.
std::string token_difference(const TokenSettings& found, const TokenSettings& wanted);

// SHA-256 over the encoder's tensors ("aggregator.*"): for each, in the order of their names, the
// name, the shape and the SHA-256 of the values as float32. The same for the same encoder in any
// file, with or without heads and decoder.
std::string encoder_sha256(const Checkpoint& checkpoint, Context& ctx);

// The same over all tensors of the decoder.
std::string decoder_sha256(const Checkpoint& checkpoint, Context& ctx);

// How the encoder's weights are kept in memory: "f32", or "40 bf16, 96 int8" where they differ.
std::string encoder_storage(const Checkpoint& checkpoint);

// Writes the tokens of one frame.   taps: four times [h*w, 2C]
// Errors: kWrite.
void write_tokens(const std::string& folder, const TokenFrame& frame,
                  const std::array<View<const float, 2>, 4>& taps, Dtype storage);

// Whether NAME.safetensors in `folder` holds the tokens of this frame of this stream, complete.
bool has_tokens(const std::string& folder, const TokenFrame& frame, const TokenManifest& manifest);

// Whether the file is one that write_tokens() wrote, whatever it was made from.
bool is_token_file(const std::string& path);

// The tokens of a scene, opened for reading. Nothing is loaded and nothing mapped (see InputFile):
// a frame's values are read from its file when asked for, so that a cache larger than memory takes
// no more of it than the batches. Reads may come from several threads.
class TokenCache {
 public:
  // Reads the manifest. Errors: those of read_token_manifest; kRead that names make_tokens when
  // there is none.
  static TokenCache open(const std::string& folder);

  const std::string& folder() const { return folder_; }
  const TokenManifest& manifest() const { return manifest_; }

  // The entry of a frame, or null.
  const TokenFrame* find(const std::string& name) const;

  // Checks by its header that a frame's file is complete and of this stream: kRead, kFormat or
  // kMismatch, naming file and frame.
  void check(const std::string& name) const;

  // Errors: those of check(), and kNumeric for values that are not finite.
  //   taps: four times [h*w, 2C]
  void read(const std::array<View<float, 2>, 4>& taps, const std::string& name) const;

 private:
  TokenCache() = default;

  std::string folder_;
  TokenManifest manifest_;
  std::map<std::string, std::size_t> by_name_;
};

}  // namespace lvggt
