// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>

namespace lvggt {

// What a file or an option may ask for at most. A reader takes a Limits with these defaults; a
// program that trusts its input may raise them. Going beyond one is an Error of kind kLimit.
struct Limits {
  std::uint64_t header_bytes = 100'000'000;            // header of a safetensors file
  std::uint64_t tensors = 1'000'000;                   // tensors in one model
  std::size_t rank = 8;                                // dimensions of one tensor
  std::size_t name_bytes = 1024;                       // name of a tensor, bytes of UTF-8
  std::int64_t image_pixels = std::int64_t{1} << 28;   // width x height of one picture
  std::int64_t video_frames = 10'000'000;              // frames of one video
  std::size_t query_bytes = 4096;                      // text of one query
  std::size_t json_depth = 64;                         // nesting of JSON values
  std::uint64_t json_bytes = std::uint64_t{64} << 20;  // a JSON file
};

}  // namespace lvggt
