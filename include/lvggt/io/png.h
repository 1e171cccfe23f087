// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>

#include "lvggt/core/tensor.h"

namespace lvggt {

// Writes an 8-bit PNG, RGB or grey by the number of channels. The file appears only when complete.
// Errors: kMismatch for a shape no PNG can have, kWrite.
//   pixels: [H, W, 3 or 1]
void write_png(const std::string& path, View<const std::uint8_t, 3> pixels);

// Writes a 16-bit grey PNG.
//   pixels: [H, W]
void write_png(const std::string& path, View<const std::uint16_t, 2> pixels);

}  // namespace lvggt
