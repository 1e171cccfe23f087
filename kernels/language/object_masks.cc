// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/object_masks.h"

#include <algorithm>
#include <array>
#include <filesystem>
#include <limits>

#include "lvggt/io/image.h"
#include "lvggt/io/input_file.h"
#include "lvggt/io/npy.h"
#include "lvggt/io/safetensors.h"
#include "lvggt/language/annotations.h"

namespace lvggt {
namespace {

namespace fs = std::filesystem;

constexpr const char* kLevels[] = {"default", "small", "middle", "large"};
constexpr std::int64_t kBitDepthAt = 24;  // in a PNG, behind signature, length, type and size

bool is_there(const std::string& path) {
  std::error_code ignored;
  return fs::exists(path, ignored);
}

class NpyMasks : public ObjectMasks {
 public:
  explicit NpyMasks(std::string folder) : folder_(std::move(folder)) {}

  bool has(const SceneFrame& frame) const override { return is_there(file_of(frame)); }

  Tensor<std::int32_t, 3> read(const SceneFrame& frame) const override {
    const NpyFile file(file_of(frame));
    std::vector<std::int64_t> shape = file.shape();
    if (shape.size() == 2) shape.insert(shape.begin(), 1);
    LVGGT_CHECK(
        shape.size() == 3 && (shape[0] == 4 || shape[0] == 1) && shape[1] > 0 && shape[2] > 0,
        file.path(), ": label maps are [4,H,W], [1,H,W] or [H,W], but this is ",
        shape_text(file.shape()));
    std::vector<std::int64_t> values(static_cast<std::size_t>(file.size()));
    file.read_part(0, std::span<std::int64_t>(values));
    Tensor<std::int32_t, 3> labels(Shape{shape[0], shape[1], shape[2]});
    for (std::size_t i = 0; i < values.size(); ++i) {
      if (values[i] > std::numeric_limits<std::int32_t>::max())
        fail(ErrorKind::kFormat, file.path(), ": the label ", values[i], " is above 2^31 - 1");
      labels.data()[i] = static_cast<std::int32_t>(std::max<std::int64_t>(values[i], 0));
    }
    return labels;
  }

  std::string describe() const override { return "label maps as .npy in " + folder_; }

 private:
  std::string file_of(const SceneFrame& frame) const { return folder_ + "/" + frame.name + ".npy"; }

  std::string folder_;
};

// One map from a picture.
void read_label_picture(const std::string& path, Tensor<std::int32_t, 2>& labels) {
  const InputFile file(path);
  std::uint8_t depth = 0;
  if (file.size() > kBitDepthAt) file.read_at(kBitDepthAt, &depth, 1);
  const Image image = load_image(path);
  if (depth == 16)
    fail(ErrorKind::kUnsupported, path, ": has 16 bits a sample; label pictures have 8, and more ",
         "objects than 255 fit a .npy file");
  const auto [H, W, C] = image.pixels.shape();
  labels = Tensor<std::int32_t, 2>(Shape{H, W});
  for (std::int64_t i = 0; i < H * W; ++i) {
    const std::uint8_t* rgb = image.pixels.data() + i * C;
    const bool grey = rgb[0] == rgb[1] && rgb[1] == rgb[2];
    labels.data()[i] = grey ? rgb[0] : rgb[0] << 16 | rgb[1] << 8 | rgb[2];
  }
}

class PngMasks : public ObjectMasks {
 public:
  PngMasks(std::string folder, bool four_levels)
      : folder_(std::move(folder)), four_levels_(four_levels) {}

  bool has(const SceneFrame& frame) const override { return is_there(file_of(frame, 0)); }

  Tensor<std::int32_t, 3> read(const SceneFrame& frame) const override {
    const std::int64_t levels = four_levels_ ? 4 : 1;
    Tensor<std::int32_t, 3> all;
    for (std::int64_t level = 0; level < levels; ++level) {
      Tensor<std::int32_t, 2> map;
      read_label_picture(file_of(frame, level), map);
      if (level == 0) all = Tensor<std::int32_t, 3>(Shape{levels, map.extent(0), map.extent(1)});
      LVGGT_CHECK(all[level].shape() == map.shape(), file_of(frame, level), ": is ", map.shape(),
                  ", but ", file_of(frame, 0), " is ", all[level].shape());
      std::copy_n(map.data(), map.size(), all[level].data());
    }
    return all;
  }

  std::string describe() const override {
    return std::string("label pictures in ") + (four_levels_ ? "the four levels of " : "") +
           folder_;
  }

 private:
  std::string file_of(const SceneFrame& frame, std::int64_t level) const {
    const std::string inside = four_levels_ ? std::string("/") + kLevels[level] : "";
    return folder_ + inside + "/" + frame.name + ".png";
  }

  std::string folder_;
  bool four_levels_;
};

class CocoMasks : public ObjectMasks {
 public:
  CocoMasks(std::string path, SceneLayout layout)
      : path_(std::move(path)),
        first_number_(layout == SceneLayout::kHyperNerf ? 1 : 0),
        images_(read_coco_annotations(path_, {layout, false})) {
    for (const AnnotatedImage& image : images_)
      for (const auto& [label, objects] : image.labels)
        number_of_.emplace(label, static_cast<std::int32_t>(number_of_.size()) + 1);
  }

  bool has(const SceneFrame& frame) const override { return find(frame) != nullptr; }

  Tensor<std::int32_t, 3> read(const SceneFrame& frame) const override {
    const AnnotatedImage* image = find(frame);
    if (image == nullptr)
      fail(ErrorKind::kRead, path_, ": annotates no picture of frame ", frame.number);
    Tensor<std::int32_t, 3> labels(Shape{std::int64_t{1}, image->height, image->width});
    Tensor<std::uint8_t, 2> mask(Shape{image->height, image->width});
    for (const auto& [label, objects] : image->labels) {
      paint_label(mask, objects, PolygonRule::kAll);
      for (std::int64_t i = 0; i < mask.size(); ++i)
        if (mask.data()[i] != 0) labels.data()[i] = number_of_.at(label);
    }
    return labels;
  }

  std::string describe() const override {
    std::string text = "annotations in " + path_ + ":";
    for (const auto& [label, number] : number_of_) text += concat(" ", number, " ", label, ";");
    return text.substr(0, text.size() - 1);
  }

 private:
  const AnnotatedImage* find(const SceneFrame& frame) const {
    for (const AnnotatedImage& image : images_)
      if (image.frame == frame.number - first_number_) return &image;
    return nullptr;
  }

  std::string path_;
  std::int64_t first_number_;
  std::vector<AnnotatedImage> images_;
  std::map<std::string, std::int32_t> number_of_;
};

}  // namespace

std::unique_ptr<ObjectMasks> ObjectMasks::open(const std::string& path, const Scene& scene) {
  if (path.ends_with(".json")) return std::make_unique<CocoMasks>(path, scene.layout());
  const auto any = [&](const std::string& inside, const char* extension) {
    return std::any_of(scene.frames().begin(), scene.frames().end(), [&](const SceneFrame& frame) {
      return is_there(path + inside + "/" + frame.name + extension);
    });
  };
  if (any("", ".npy")) return std::make_unique<NpyMasks>(path);
  if (any("", ".png")) return std::make_unique<PngMasks>(path, false);
  if (any("/default", ".png")) return std::make_unique<PngMasks>(path, true);
  fail(ErrorKind::kRead, path, ": holds no masks for the frames of ", scene.path(), ", such as ",
       scene.frames().front().name, ".npy, ", scene.frames().front().name, ".png or default/",
       scene.frames().front().name, ".png");
}

}  // namespace lvggt
