// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>

#include "examples/evaluate/protocol.h"
#include "lvggt/field/contact_sheet.h"

namespace evaluate {

// A scene's masks beside the truth, for eight of the annotated frames: the picture, then for each
// phrase what was found rightly (green), found wrongly (red) and missed (blue).
class MaskSheet {
 public:
  MaskSheet(const std::string& picture_folder, const std::string& title);
  void add(const FrameView& view);
  // Nothing when no frame was added.
  void write(const std::string& path) const;

 private:
  std::string folder_, title_;
  std::unique_ptr<lvggt::ContactSheet> sheet_;
};

// The similarity of each state sentence over the annotated frames, as it was and smoothed, with the
// threshold and the annotated frames.
void write_time_lines(const std::string& path, const SceneResult& scene);

}  // namespace evaluate
