// SPDX-License-Identifier: Apache-2.0
#include "examples/train_autoencoder/encode.h"

#include <algorithm>
#include <filesystem>

#include "examples/train_autoencoder/features.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/input_file.h"
#include "lvggt/io/json.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/io/npy.h"

namespace train_autoencoder {
namespace {

using namespace lvggt;
namespace fs = std::filesystem;

// Says beside the codes which autoencoder made them.
constexpr const char* kNote = "autoencoder.json";

void copy_file(const std::string& from, const std::string& to) {
  const InputFile file(from);
  std::vector<char> bytes(static_cast<std::size_t>(file.size()));
  file.read_at(0, bytes.data(), bytes.size());
  AtomicFile out(to);
  out.write(bytes.data(), bytes.size());
  out.commit();
}

void encode_frame(const FeatureFiles& files, const Autoencoder& autoencoder, Context& ctx) {
  const NpyFile file(files.features);
  LVGGT_CHECK(file.shape().size() == 2 && file.shape()[1] == autoencoder.feature_width(),
              files.features, ": the features have ",
              file.shape().empty() ? 0 : file.shape().back(), " numbers each, but the autoencoder ",
              "takes ", autoencoder.feature_width());
  const Tensor<float, 2> features = file.read<2>();
  Tensor<float, 2> codes(Shape{features.extent(0), autoencoder.code_width()});
  autoencoder.encode(codes, features, ctx);
  for (std::int64_t n = 0; n < features.extent(0); ++n) {
    const float* row = features[n].data();
    if (std::all_of(row, row + features.extent(1), [](float x) { return x == 0; }))
      std::fill_n(codes[n].data(), codes.extent(1), 0.0F);
  }
  // The features last: a frame is complete once they are there.
  copy_file(files.labels, files.compact_labels);
  write_npy(files.compact_features, codes);
}

// Makes the folder of the codes ready.
void open_folder(const std::string& folder, const EncodeOptions& options) {
  std::error_code error;
  const std::string note = folder + "/" + kNote;
  if (fs::exists(folder, error) && !fs::is_empty(folder, error)) {
    if (!options.replace && !options.resume)
      fail(ErrorKind::kUsage, folder,
           ": holds codes already; --force replaces them, --resume continues");
    if (options.resume) {
      const Json* made_by = nullptr;
      Json json;
      if (fs::exists(note, error)) {
        json = Json::read(note);
        made_by = json.find("sha256");
      }
      LVGGT_CHECK(
          made_by != nullptr && made_by->is_string() && made_by->as_string(note) == options.sha256,
          folder, ": holds codes that another autoencoder made; --force replaces them");
    }
  }
  fs::create_directories(folder, error);
  if (error) fail(ErrorKind::kWrite, folder, ": cannot be created: ", error.message());
  JsonWriter json;
  json.begin_object();
  json.field("sha256", options.sha256);
  json.end_object();
  write_file(note, json.take());
}

}  // namespace

std::int64_t encode_scene(const Scene& scene, const Autoencoder& autoencoder,
                          const EncodeOptions& options, const std::function<bool()>& progress,
                          Context& ctx) {
  std::int64_t written = 0;
  bool opened = false;
  for (const SceneFrame& frame : scene.frames()) {
    const FeatureFiles files =
        feature_files(scene, frame, options.kind, autoencoder.code_width(), options.root);
    if (!opened) open_folder(files.compact_folder, options);
    opened = true;
    std::error_code error;
    if (!options.resume || !fs::exists(files.compact_features, error)) {
      encode_frame(files, autoencoder, ctx);
      ++written;
    }
    if (!progress()) break;
  }
  return written;
}

}  // namespace train_autoencoder
