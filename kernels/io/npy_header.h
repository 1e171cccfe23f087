// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/io/dtype.h"
#include "lvggt/io/limits.h"

namespace lvggt::detail {

// What the dictionary in the header of a .npy file says.
struct NpyHeader {
  Dtype dtype = Dtype::kF32;
  bool fortran_order = false;
  std::vector<std::int64_t> shape;
};

// Parses {'descr': '<f4', 'fortran_order': False, 'shape': (3, 4), } and nothing more general: keys
// in any order, each once, padded with white space. `path` opens every message.
NpyHeader parse_npy_header(std::string_view text, const std::string& path, const Limits& limits);

// The text for these; the dtype must have a name in numpy.
std::string npy_header_text(Dtype dtype, const std::vector<std::int64_t>& shape);

}  // namespace lvggt::detail
