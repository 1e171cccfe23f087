// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <string>
#include <string_view>
#include <system_error>

#include "lvggt/core/error.h"
#include "lvggt/io/hash.h"

namespace lvggt {

// A file that comes with lvggt, under share/lvggt where it is installed.
struct BundledFile {
  std::string_view name;
  std::string_view sha256;  // of its content, 64 hexadecimal digits
};

// The trained small geometry model; its card is weights/small_model/README.md.
inline constexpr BundledFile kSmallModel{
    "lvggt_small.safetensors", "c3422236d901d809cd350f4e5d519fdc2e52bf12da5ec90bfd63e101973a2a81"};

// Checks that `path` is that file. Throws kRead when there is none and kMismatch when its content
// is another; both name the path and the expected sum.
inline void check_bundled_file(const BundledFile& file, const std::string& path) {
  std::error_code ignored;
  if (!std::filesystem::exists(path, ignored))
    fail(ErrorKind::kRead, path, ": the small model that comes with lvggt (SHA-256 ", file.sha256,
         ") is missing");
  const std::string found = sha256_file(path);
  LVGGT_CHECK(found == file.sha256, path,
              ": this is not the small model that comes with this version of lvggt, or it is "
              "damaged: its SHA-256 is ",
              found, ", but ", file.sha256, " is expected");
}

}  // namespace lvggt
