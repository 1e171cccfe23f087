// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>

#include "lvggt/core/tensor.h"
#include "lvggt/io/limits.h"

namespace lvggt {

// Reads a grey PNG of 16 bits a pixel, checked as load_image() does; kFormat for any other picture.
Tensor<std::uint16_t, 2> load_grey16(const std::string& path, const Limits& limits = {});  // [H, W]

// The numbers that write_depth_png() stored; 0 where there is none. Errors: what load_grey16() and
// Json::read() throw, kFormat for a sidecar without a positive scale, kMismatch for another size.
//   numbers: [H, W]
void read_depth_png(View<float, 2> numbers, const std::string& png_path,
                    const std::string& json_path);

}  // namespace lvggt
