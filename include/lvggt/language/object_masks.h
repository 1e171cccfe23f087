// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <map>
#include <memory>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/data/scene.h"

namespace lvggt {

// Label maps of a scene's objects, from whatever found them. 0 (and below) is background; an
// object has one number in all frames where sentences are to follow it.
class ObjectMasks {
 public:
  virtual ~ObjectMasks() = default;

  // `path` is a folder or file, told apart by what is there for the scene's frames:
  //   NAME.npy     whole numbers [4, H, W] (default, small, middle, large), [1, H, W] or [H, W]
  //   NAME.png     one level; grey values are the numbers, colours count as 65536 R + 256 G + B
  //   default/NAME.png, small/NAME.png, middle/NAME.png, large/NAME.png
  //   FILE.json    COCO polygons or runs; a category is one object, numbered from 1 in the order in
  //                which the file first annotates them; where two overlap the later one counts
  // Errors: kRead when nothing is there for any frame; those of read_coco_annotations.
  static std::unique_ptr<ObjectMasks> open(const std::string& path, const Scene& scene);

  // Whether there are masks for the frame.
  virtual bool has(const SceneFrame& frame) const = 0;

  // The frame's maps.   result: [levels, H, W], 4 levels or 1
  // Errors: kRead (missing), kFormat (no whole numbers), kUnsupported (a PNG of 16 bits a sample),
  // kMismatch (levels of different sizes, another number of levels).
  virtual Tensor<std::int32_t, 3> read(const SceneFrame& frame) const = 0;

  // "4-level .npy files in FOLDER", for messages.
  virtual std::string describe() const = 0;
};

}  // namespace lvggt
