// SPDX-License-Identifier: Apache-2.0
#include "examples/train_autoencoder/features.h"

#include <algorithm>
#include <cmath>

#include "examples/compact_codes.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/npy.h"

namespace train_autoencoder {
namespace {

using namespace lvggt;

// One frame's features; rows of zeros are left out.
void append_rows(std::vector<float>& rows, std::int64_t& empty, const std::string& path,
                 std::int64_t width) {
  const NpyFile file(path);
  LVGGT_CHECK(file.shape().size() == 2 && file.shape()[1] == width, path, ": the features have ",
              file.shape().empty() ? 0 : file.shape().back(), " numbers each, but ", width,
              " are expected");
  const Tensor<float, 2> features = file.read<2>();
  for (std::int64_t n = 0; n < features.extent(0); ++n) {
    const float* row = features[n].data();
    for (std::int64_t c = 0; c < width; ++c)
      if (!std::isfinite(row[c])) fail(ErrorKind::kNumeric, path, ": row ", n, " holds ", row[c]);
    if (std::all_of(row, row + width, [](float x) { return x == 0; }))
      ++empty;
    else
      rows.insert(rows.end(), row, row + width);
  }
}

Tensor<float, 2> as_tensor(const std::vector<float>& rows, std::int64_t width) {
  Tensor<float, 2> tensor(Shape{std::ssize(rows) / width, width});
  std::copy(rows.begin(), rows.end(), tensor.data());
  return tensor;
}

}  // namespace

FeatureSet read_features(const std::vector<Scene>& scenes, Supervision kind, std::int64_t width,
                         const SplitOptions& split) {
  FeatureSet set;
  std::vector<float> train, held_out;
  for (const Scene& scene : scenes) {
    std::vector<std::int64_t> numbers;
    for (const SceneFrame& frame : scene.frames()) numbers.push_back(frame.number);
    const Split parts = split_frames(numbers, split, scene.path());
    const auto read = [&](std::vector<float>& rows, const std::vector<std::int64_t>& frames) {
      for (const std::int64_t i : frames)
        append_rows(
            rows, set.empty_rows,
            feature_files(scene, scene.frames()[static_cast<std::size_t>(i)], kind, 1, "").features,
            width);
    };
    read(train, parts.train);
    read(held_out, parts.held_out);
    set.frames += std::ssize(parts.train);
    set.held_out_frames += std::ssize(parts.held_out);
  }
  if (std::ssize(train) < 2 * width)
    fail(ErrorKind::kFormat, scenes.front().path(), ": ", raw_feature_folder(kind),
         " holds fewer than two features to learn from");
  set.train = as_tensor(train, width);
  set.held_out = as_tensor(held_out, width);
  const std::string sums = sha256(std::as_bytes(std::span<const float>(train))) +
                           sha256(std::as_bytes(std::span<const float>(held_out)));
  set.sha256 = sha256(std::as_bytes(std::span(sums.data(), sums.size())));
  return set;
}

std::int64_t feature_width(const Scene& scene, Supervision kind) {
  const NpyFile file(feature_files(scene, scene.frames().front(), kind, 1, "").features);
  LVGGT_CHECK(file.shape().size() == 2 && file.shape()[1] >= 1, file.path(),
              ": is no table of features [n, D]");
  return file.shape()[1];
}

}  // namespace train_autoencoder
