// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>

#include "lvggt/io/frame_source.h"

namespace lvggt {

// Opens a video file with FFmpeg's libraries; link lvggt::video. Single-threaded, one frame in
// memory.
//
// Frames are RGB as displayed: turned and mirrored as the display matrix says, non-square pixels
// stretched to square ones. YUV is converted by the matrix and range the stream names (BT.601 below
// 720 lines, BT.709 from there on, limited range, where it names none); interlaced and HDR material
// is taken as it is, with a warning. Timestamps are the presentation times in the file.
//
// A packet that cannot be decoded is skipped, as ffmpeg does; a file that ends early gives the
// frames there are and sets report().partial. Both are counted and become warnings.
//
// `path` is only ever a file name, never a URL or a pipe, and no other file is opened: playlists
// are refused. FFmpeg's process-wide log level is set to quiet if it still has its default: the
// library never prints.
//
// Errors: kUsage (options out of range, start beyond the last frame), kRead, kFormat (no video in
// it, or no frame that can be decoded), kUnsupported (playlist, no decoder), kMismatch (the size
// changes in the middle: frame and both sizes are named), kLimit.
std::unique_ptr<FrameSource> open_video(const std::string& path,
                                        const FrameSourceOptions& options = {});

}  // namespace lvggt
