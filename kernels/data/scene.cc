// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/scene.h"

#include <algorithm>
#include <charconv>
#include <filesystem>
#include <set>
#include <system_error>

#include "kernels/io/printable.h"
#include "lvggt/core/error.h"
#include "lvggt/io/frame_source.h"
#include "lvggt/io/input_file.h"

namespace lvggt {

namespace {

namespace fs = std::filesystem;

constexpr const char* kHyperNerfImages = "rgb/2x";
constexpr const char* kNeu3dCamera = "cam00";
constexpr const char* kNeu3dImages = "cam00/images";

bool is_folder(const std::string& path) {
  std::error_code ignored;
  return fs::is_directory(path, ignored);
}

bool is_there(const std::string& path) {
  std::error_code ignored;
  return fs::exists(path, ignored);
}

// Hidden files, folders and files that are no pictures are not frames.
std::vector<SceneFrame> list_frames(const std::string& folder) {
  std::vector<SceneFrame> frames;
  std::error_code error;
  fs::directory_iterator entry(folder, error);
  for (; !error && entry != fs::directory_iterator(); entry.increment(error)) {
    const std::string name = entry->path().filename().string();
    std::error_code ignored;
    if (name.starts_with('.') || !has_image_extension(name) || entry->is_directory(ignored))
      continue;
    SceneFrame frame;
    frame.name = name.substr(0, name.rfind('.'));
    frame.image = folder + "/" + name;
    const char* end = frame.name.data() + frame.name.size();
    const auto [stop, fault] = std::from_chars(frame.name.data(), end, frame.number);
    if (fault != std::errc() || stop != end || frame.number < 0)
      fail(ErrorKind::kFormat, folder, ": ", in_quotes(name),
           " is not named by a frame number, such as 000001.png");
    frames.push_back(std::move(frame));
  }
  if (error) fail(ErrorKind::kRead, "cannot list the folder ", folder, ": ", error.message());
  std::sort(frames.begin(), frames.end(), [](const SceneFrame& a, const SceneFrame& b) {
    return a.number != b.number ? a.number < b.number : a.image < b.image;
  });
  return frames;
}

}  // namespace

bool Scene::is_scene(const std::string& path) {
  return is_folder(path + "/" + kHyperNerfImages) || is_folder(path + "/" + kNeu3dImages);
}

Scene Scene::open(const std::string& path) {
  Scene scene;
  scene.path_ = path;
  while (scene.path_.size() > 1 && scene.path_.back() == '/') scene.path_.pop_back();
  if (!is_folder(scene.path_)) fail(ErrorKind::kRead, path, ": there is no such folder");
  scene.name_ = fs::path(scene.path_).filename().string();
  if (scene.name_.empty() || scene.name_ == "." || scene.name_ == "..") {
    std::error_code ignored;
    scene.name_ = fs::canonical(scene.path_, ignored).filename().string();
  }
  const bool hyper_nerf = is_folder(scene.path_ + "/" + kHyperNerfImages);
  const bool neu3d = is_folder(scene.path_ + "/" + kNeu3dImages);
  if (hyper_nerf == neu3d)
    fail(ErrorKind::kFormat, path, ": ", hyper_nerf ? "has both " : "is no scene: it has neither ",
         kHyperNerfImages, " (HyperNeRF layout) ", hyper_nerf ? "and " : "nor ", kNeu3dImages,
         " (Neu3D layout)");
  scene.layout_ = hyper_nerf ? SceneLayout::kHyperNerf : SceneLayout::kNeu3d;
  scene.image_folder_ = scene.path_ + "/" + (hyper_nerf ? kHyperNerfImages : kNeu3dImages);
  scene.frames_ = list_frames(scene.image_folder_);
  if (scene.frames_.empty())
    fail(ErrorKind::kFormat, scene.image_folder_, ": holds no PNG or JPEG picture");
  std::int64_t missing = 0, first_missing = 0;
  for (std::size_t i = 1; i < scene.frames_.size(); ++i) {
    const SceneFrame &before = scene.frames_[i - 1], &frame = scene.frames_[i];
    if (frame.number == before.number)
      fail(ErrorKind::kFormat, before.image, " and ", frame.image, " are both frame ",
           frame.number);
    if (missing == 0) first_missing = before.number + 1;
    missing += frame.number - before.number - 1;
  }
  if (missing > 0)
    scene.warnings_.push_back(concat(scene.image_folder_, ": ", missing,
                                     missing == 1 ? " frame number is" : " frame numbers are",
                                     " missing between the first and the last, such as ",
                                     first_missing, "; the frames there are taken as one stream"));
  return scene;
}

std::pair<std::string, std::string> Scene::label_files(const SceneFrame& frame,
                                                       const SupervisionSpec& spec) const {
  std::vector<std::string> stems;
  if (layout_ == SceneLayout::kHyperNerf) {
    stems = {path_ + "/" + spec.folder() + "/" + frame.name};
  } else {
    stems = {path_ + "/" + kNeu3dCamera + "/" + spec.folder() + "/" + frame.name,
             path_ + "/" + spec.folder() + "/" + kNeu3dCamera + "-" + frame.name};
  }
  for (const std::string& stem : stems) {
    const bool rows = is_there(stem + "_s.npy"), codes = is_there(stem + "_f.npy");
    if (rows && codes) return {stem + "_s.npy", stem + "_f.npy"};
    if (rows || codes)
      fail(ErrorKind::kRead, stem, rows ? "_f.npy" : "_s.npy", " is missing, although ", stem,
           rows ? "_s.npy" : "_f.npy", " is there");
  }
  fail(ErrorKind::kRead, stems[0], "_s.npy is missing",
       stems.size() > 1 ? concat(", and so is ", stems[1], "_s.npy") : "");
}

std::vector<std::string> read_list_file(const std::string& path) {
  const std::string text = read_text_file(path);
  const fs::path folder = fs::path(path).parent_path();
  std::vector<std::string> entries;
  std::set<std::string> seen;
  for (std::size_t at = 0; at < text.size();) {
    std::size_t end = std::min(text.find('\n', at), text.size());
    std::string line = text.substr(at, end - at);
    at = end + 1;
    while (!line.empty() && (line.back() == '\r' || line.back() == ' ')) line.pop_back();
    if (line.empty() || line[0] == '#') continue;
    if (line.find('\0') != std::string::npos)
      fail(ErrorKind::kFormat, path, ": is no list of names, it holds a zero byte");
    line = (folder / line).string();  // an absolute name stays as it is
    if (!seen.insert(line).second)
      fail(ErrorKind::kFormat, path, ": names ", in_quotes(line), " twice");
    entries.push_back(std::move(line));
  }
  if (entries.empty()) fail(ErrorKind::kFormat, path, ": names nothing");
  return entries;
}

}  // namespace lvggt
