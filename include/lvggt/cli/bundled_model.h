// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <filesystem>
#include <string>
#include <vector>

#include "lvggt/core/error.h"
#include "lvggt/model/small_model.h"

#ifndef LVGGT_BUNDLED_FROM_PROGRAM
#error \
    "lvggt_uses_small_model(TARGET) in CMakeLists.txt says where the programs find the small model"
#endif

namespace lvggt::cli {

// What a program says when nobody named weights; one line.
inline constexpr const char* kSmallModelNotice =
    "no --weights: using the bundled small model, trained on rendered scenes, so results are rough "
    "(published checkpoints: weights/README.md)";

// The path of a bundled file, from where this program lies: the same in the build tree and where
// it is installed.
inline std::string bundled_path(const BundledFile& file) {
  std::error_code error;
  const std::filesystem::path program = std::filesystem::read_symlink("/proc/self/exe", error);
  if (error)
    fail(ErrorKind::kRead, "cannot tell where this program lies, and so where ", file.name,
         " is: ", error.message(), "; name the weights with --weights");
  return (program.parent_path() / LVGGT_BUNDLED_FROM_PROGRAM / file.name)
      .lexically_normal()
      .string();
}

// That path once the file is checked, see check_bundled_file().
inline std::string find_bundled_file(const BundledFile& file) {
  const std::string path = bundled_path(file);
  check_bundled_file(file, path);
  return path;
}

// `weights` becomes the small model's path if it is empty, and say(line) hears of it.
template <class Say>
void default_to_small_model(std::string& weights, const Say& say) {
  if (!weights.empty()) return;
  weights = find_bundled_file(kSmallModel);
  say(kSmallModelNotice);
}

// What loading `weights` warned of; nothing for the small model, whose content is known.
template <class Model>
std::vector<std::string> load_warnings(const Model& model, const std::string& weights) {
  if (weights == bundled_path(kSmallModel)) return {};
  return model.warnings();
}

}  // namespace lvggt::cli
