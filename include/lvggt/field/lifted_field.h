// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <optional>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/field/semantic_codes.h"
#include "lvggt/io/cameras_json.h"
#include "lvggt/io/preprocess.h"

namespace lvggt {

// The file that makes a folder a lifted field; RunWriter writes it last.
inline constexpr const char* kFieldFile = "field.json";

// The two kinds of codes a field may hold: of the decoder, whose meaning does not change with time
// (CLIP), and of the state decoder (dynamic semantics). Each has a folder of its own.
enum class CodesKind { kLanguage, kState };
inline constexpr const char* codes_folder(CodesKind kind) {
  return kind == CodesKind::kLanguage ? "codes" : "state_codes";
}

// What the files of a run hold.
struct FieldFormat {
  std::int64_t num_frames = 0;  // of the run; files are there for every `every`-th of them
  std::int64_t every = 1;
  std::int64_t height = 0, width = 0;                                  // of the model frames
  bool has_frames = false, has_depth = false, has_confidence = false;  // pictures of each frame
  std::optional<CodesFormat> language, states;
};

// field.json, format 1.
std::string field_json(const FieldFormat& format);

// What lift_video left in its folder, read frame by frame: model frames, depth, confidence, cameras
// and the codes of its decoders. No model is needed. Everything that is read is checked against
// field.json; what other programs put into the folder does not matter. May be read by several
// threads at once.
class LiftedField {
 public:
  // Errors: kRead (no such folder, files of a frame missing), kFormat (not a lifted field, or one
  // of a run that did not finish), kUnsupported (written by a newer version).
  static LiftedField open(const std::string& folder);

  const std::string& path() const { return path_; }
  // Frames that have files, in order. Cameras are in model pixels.
  const std::vector<CameraRecord>& frames() const { return frames_; }
  std::int64_t num_frames() const { return static_cast<std::int64_t>(frames_.size()); }
  std::int64_t height() const { return format_.height; }
  std::int64_t width() const { return format_.width; }
  bool has_pictures() const { return format_.has_frames; }
  bool has_points() const { return format_.has_depth && format_.has_confidence; }
  bool has_codes(CodesKind kind) const { return codes_of(kind).has_value(); }

  // kMismatch when the field has none, saying how to get them.
  const CodesFormat& codes(CodesKind kind) const;

  // The i-th of frames(). Errors: those of load_image, read_depth_png and read_codes; kMismatch for
  // what the field does not have.
  Tensor<std::uint8_t, 3> read_picture(std::int64_t i) const;                   // [H, W, 3]
  void read_depth(View<float, 2> depth, std::int64_t i) const;                  // [H, W]
  void read_confidence(View<float, 2> confidence, std::int64_t i) const;        // [H, W]
  void read_codes(View<float, 4> codes, CodesKind kind, std::int64_t i) const;  // [level, H, W, d]

 private:
  LiftedField() = default;
  const std::optional<CodesFormat>& codes_of(CodesKind kind) const {
    return kind == CodesKind::kLanguage ? format_.language : format_.states;
  }
  std::string file(const std::string& folder, std::int64_t i, const std::string& ending) const;
  void read_format();
  void read_cameras();
  void check_files() const;

  std::string path_;
  FieldFormat format_;
  std::vector<CameraRecord> frames_;
};

}  // namespace lvggt
