// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/data/supervision.h"

namespace lvggt {

enum class SceneLayout {
  kHyperNerf,  // <scene>/rgb/2x/000001.png
  kNeu3d,      // <scene>/cam00/images/0000.png
};

// One picture of a scene.
struct SceneFrame {
  std::int64_t number = 0;  // the number in the file name, whatever it starts from
  std::string name;         // the file name without its extension; names the frame's tokens too
  std::string image;        // path
};

// A labelled scene as the 4DLangSplat pipeline lays it out. open() lists names only and opens no
// picture.
class Scene {
 public:
  // Errors: kRead (no such folder), kFormat (neither layout or both of them, no pictures, a picture
  // whose name is no number, two pictures of one number).
  static Scene open(const std::string& path);

  // Whether the folder looks like a scene of either layout.
  static bool is_scene(const std::string& path);

  const std::string& path() const { return path_; }
  const std::string& name() const { return name_; }  // of the folder
  SceneLayout layout() const { return layout_; }
  const std::string& image_folder() const { return image_folder_; }
  const std::vector<SceneFrame>& frames() const { return frames_; }  // by ascending number
  const std::vector<std::string>& warnings() const { return warnings_; }

  // Paths of a frame's label map and features. Neu3D files are found under both spellings,
  // <scene>/cam00/<folder>/0000_s.npy and <scene>/<folder>/cam00-0000_s.npy. A missing file is a
  // kRead error that says where it was looked for.
  std::pair<std::string, std::string> label_files(const SceneFrame& frame,
                                                  const SupervisionSpec& spec) const;

 private:
  Scene() = default;

  std::string path_, name_, image_folder_;
  SceneLayout layout_ = SceneLayout::kHyperNerf;
  std::vector<SceneFrame> frames_;
  std::vector<std::string> warnings_;
};

// The folders named by a list file: one a line, relative to the folder of the list; empty lines and
// lines that start with # are left out. Errors: kRead, kFormat (no entry, one entry twice).
std::vector<std::string> read_list_file(const std::string& path);

}  // namespace lvggt
