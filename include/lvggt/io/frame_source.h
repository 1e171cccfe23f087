// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <limits>
#include <memory>
#include <optional>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/io/image.h"

namespace lvggt {

// Which frames of the input to deliver: start, start + stride, ... at most max_frames of them.
struct FrameSourceOptions {
  std::int64_t start = 0;                                              // >= 0
  std::int64_t stride = 1;                                             // >= 1
  std::int64_t max_frames = std::numeric_limits<std::int64_t>::max();  // >= 1
  double images_per_second = 30;  // > 0; gives the frames of a folder, which have no times, theirs
  Limits limits{};                // of every frame
};

struct InputFrame {
  std::int64_t source_index =
      0;                 // position in the folder or video, counted from 0 before the selection
  double timestamp = 0;  // seconds, greater than that of the frame before
  std::string name;      // file name of an image, "frame 12" of a video
  Image image;
};

// What had to be skipped or repaired so far.
struct InputReport {
  std::int64_t skipped_files = 0;        // entries of the folder that are not images
  std::int64_t damaged_packets = 0;      // video data that could not be decoded
  std::int64_t damaged_frames = 0;       // delivered or passed over although decoded with errors
  std::int64_t repaired_timestamps = 0;  // missing or not increasing in the file
  bool partial = false;                  // the input ends before the end it announces
};

// Frames of one size, one after the other, in constant memory.
class FrameSource {
 public:
  virtual ~FrameSource() = default;

  // The next selected frame; nothing after the last. Throws Error as load_image() and open_video()
  // do, and kMismatch when a frame's size differs from the first one's.
  virtual std::optional<InputFrame> next() = 0;

  // How many frames the whole selection has, -1 if unknown. For a video it is what the file claims.
  virtual std::int64_t expected_frames() const = 0;

  const InputReport& report() const { return report_; }

  // One sentence each; complete once next() has returned nothing.
  const std::vector<std::string>& warnings() const { return warnings_; }

 protected:
  InputReport report_;
  std::vector<std::string> warnings_;
};

// Orders names as people do: runs of digits by value, so that "frame2.png" comes before
// "frame10.png".
bool natural_less(std::string_view a, std::string_view b);

// Whether the name ends in .png, .jpg or .jpeg, in any case.
bool has_image_extension(std::string_view name);

// The PNG and JPEG files (by extension, in any case) of a folder in natural order, or one image
// file. Hidden files, folders and other files are skipped and counted. Errors: kUsage (options out
// of range, start beyond the last frame), kRead, kUnsupported (no image in the folder).
std::unique_ptr<FrameSource> open_images(const std::string& path,
                                         const FrameSourceOptions& options = {});

// How a video file is opened: open_video of lvggt/io/video.h, which needs the library lvggt::video.
using VideoOpener = std::unique_ptr<FrameSource> (*)(const std::string& path,
                                                     const FrameSourceOptions& options);

// A folder of images, an image or a video:
//   auto frames = open_frames(path, options, open_video);
// Without a VideoOpener a video is a kUnsupported error. The path is never anything but a file
// name.
std::unique_ptr<FrameSource> open_frames(const std::string& path,
                                         const FrameSourceOptions& options = {},
                                         VideoOpener video = nullptr);

}  // namespace lvggt
