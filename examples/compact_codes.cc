// SPDX-License-Identifier: Apache-2.0
#include "examples/compact_codes.h"

#include <filesystem>

#include "lvggt/io/atomic_file.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/input_file.h"
#include "lvggt/io/json.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/io/npy.h"
#include "lvggt/language/frame_features.h"

namespace lvggt {
namespace {

namespace fs = std::filesystem;

// Says beside the codes which autoencoder made them.
constexpr const char* kNote = "autoencoder.json";

bool is_there(const std::string& path) {
  std::error_code error;
  return fs::exists(path, error);
}

void copy_file(const std::string& from, const std::string& to) {
  const InputFile file(from);
  std::vector<char> bytes(static_cast<std::size_t>(file.size()));
  file.read_at(0, bytes.data(), bytes.size());
  AtomicFile out(to);
  out.write(bytes.data(), bytes.size());
  out.commit();
}

void check_features(const std::vector<FeatureFiles>& frames, const Autoencoder& autoencoder,
                    const std::string& path) {
  if (!autoencoder.has_encoder())
    fail(ErrorKind::kMismatch, path, ": holds a decoder only, which cannot encode");
  for (const FeatureFiles& files : frames) {
    const NpyFile features(files.features);
    LVGGT_CHECK(features.shape().size() == 2 && features.shape()[1] == autoencoder.feature_width(),
                files.features, ": has the shape ", shape_text(features.shape()), ", but ", path,
                " takes features of ", autoencoder.feature_width(), " numbers");
  }
}

// Makes the folder of the codes ready.
void open_folder(const std::string& folder, const std::string& sha, ExistingCodes existing) {
  std::error_code error;
  const std::string note = folder + "/" + kNote;
  if (is_there(folder) && !fs::is_empty(folder, error)) {
    if (existing == ExistingCodes::kRefuse)
      fail(ErrorKind::kUsage, folder,
           ": holds codes already; --force replaces them, --resume continues");
    if (existing == ExistingCodes::kKeep) {
      const Json* made_by = nullptr;
      Json json;
      if (is_there(note)) {
        json = Json::read(note);
        made_by = json.find("sha256");
      }
      LVGGT_CHECK(made_by != nullptr && made_by->is_string() && made_by->as_string(note) == sha,
                  folder, ": holds codes that another autoencoder made; --force replaces them");
    }
  }
  fs::create_directories(folder, error);
  if (error) fail(ErrorKind::kWrite, folder, ": cannot be created: ", error.message());
  JsonWriter json;
  json.begin_object();
  json.field("sha256", sha);
  json.end_object();
  write_file(note, json.take());
}

}  // namespace

std::string raw_feature_folder(Supervision kind) {
  return kind == Supervision::kClip ? "clip_features" : "video_features";
}

FeatureFiles feature_files(const Scene& scene, const SceneFrame& frame, Supervision kind,
                           std::int64_t code_width, const std::string& root) {
  const std::string raw = raw_feature_folder(kind);
  const std::string compact = SupervisionSpec{kind, code_width}.folder();
  const std::string base = root.empty() ? scene.path() : root;
  struct Spelling {
    std::string before, name;  // folders before the features' own, and the file name's stem
  };
  std::vector<Spelling> spellings{{"/", "/" + frame.name}};
  if (scene.layout() == SceneLayout::kNeu3d)
    spellings = {{"/cam00/", "/" + frame.name}, {"/", "/cam00-" + frame.name}};
  for (const Spelling& spelling : spellings) {
    const std::string stem = scene.path() + spelling.before + raw + spelling.name;
    if (!is_there(stem + "_s.npy") || !is_there(stem + "_f.npy")) continue;
    const std::string folder = base + spelling.before + compact;
    return {stem + "_s.npy", stem + "_f.npy", folder, folder + spelling.name + "_s.npy",
            folder + spelling.name + "_f.npy"};
  }
  fail(ErrorKind::kRead, scene.path(), spellings[0].before, raw, spellings[0].name,
       "_s.npy or _f.npy is missing");
}

std::int64_t write_compact_codes(const std::vector<FeatureFiles>& frames,
                                 const Autoencoder& autoencoder, const std::string& path,
                                 ExistingCodes existing, const std::function<bool()>& progress,
                                 Context& ctx) {
  if (frames.empty()) return 0;
  check_features(frames, autoencoder, path);
  open_folder(frames.front().compact_folder, sha256_file(path), existing);
  std::int64_t written = 0;
  for (const FeatureFiles& files : frames) {
    if (existing != ExistingCodes::kKeep || !is_there(files.compact_features)) {
      const Tensor<float, 2> features = NpyFile(files.features).read<2>();
      const Tensor<float, 2> codes = encode_features(features, autoencoder, ctx);
      // The features last: a frame is complete once they are there.
      copy_file(files.labels, files.compact_labels);
      write_npy(files.compact_features, codes);
      ++written;
    }
    if (!progress()) break;
  }
  return written;
}

}  // namespace lvggt
