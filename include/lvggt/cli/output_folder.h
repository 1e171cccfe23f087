// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <unistd.h>

#include <algorithm>
#include <filesystem>
#include <string>
#include <vector>

#include "lvggt/core/error.h"

namespace lvggt::cli {

// What may happen to results that are already there.
enum class Existing { kRefuse, kReplace, kResume };

// The file that marks a folder as one of ours.
inline constexpr const char* kRunFile = "run.json";

// "a/b/" and "a/b" are the same folder.
inline std::string without_trailing_slashes(std::string path) {
  while (path.size() > 1 && path.back() == '/') path.pop_back();
  return path;
}

// Whether `name` is one that a file has while it is written (io/atomic_file.h): ".NAME.TAG.tmp"
// with 16 hexadecimal digits.
inline bool is_temporary_file(const std::string& name) {
  constexpr std::size_t kTag = 16, kEnd = 4;  // ".tmp"
  if (name.size() < kTag + kEnd + 3 || name.front() != '.' || !name.ends_with(".tmp")) return false;
  const std::string tag = name.substr(name.size() - kTag - kEnd, kTag);
  return name[name.size() - kTag - kEnd - 1] == '.' &&
         tag.find_first_not_of("0123456789abcdef") == std::string::npos;
}

// Whether a folder holds anything but the unfinished files of a killed run.
inline bool holds_anything(const std::string& path) {
  std::error_code error;
  for (const auto& entry : std::filesystem::directory_iterator(path, error))
    if (!is_temporary_file(entry.path().filename().string())) return true;
  return false;
}

// Checks, before any long work and without changing anything, that `path` can become the output
// folder: it is there or its parent is, it can be written, and it is empty, or holds an earlier run
// (run.json) that may be replaced or resumed. Returns whether it holds an earlier run. Errors:
// kUsage for existing results without the option, kWrite for everything else.
inline bool check_output_folder(const std::string& path, Existing existing) {
  namespace fs = std::filesystem;
  if (path.empty()) fail(ErrorKind::kUsage, "the name of the output folder is empty");
  std::error_code error;
  const fs::file_status status = fs::status(path, error);
  if (status.type() == fs::file_type::not_found) {
    fs::path parent = fs::path(path).parent_path();
    if (parent.empty()) parent = ".";
    if (!fs::is_directory(parent, error))
      fail(ErrorKind::kWrite, path, ": cannot be created, because there is no folder ",
           parent.string());
    if (access(parent.c_str(), W_OK | X_OK) != 0)
      fail(ErrorKind::kWrite, path, ": cannot be created, because the folder ", parent.string(),
           " is not writable");
    return false;
  }
  if (error) fail(ErrorKind::kWrite, path, ": ", error.message());
  if (!fs::is_directory(status))
    fail(ErrorKind::kWrite, path, ": is a file, but the output is a folder");
  if (access(path.c_str(), W_OK | X_OK) != 0)
    fail(ErrorKind::kWrite, path, ": the folder is not writable");
  if (!holds_anything(path)) return false;
  if (!fs::exists(path + "/" + kRunFile, error))
    fail(ErrorKind::kUsage, path, ": the folder is not empty and holds no earlier run (", kRunFile,
         "); choose another one");
  if (existing == Existing::kRefuse)
    fail(ErrorKind::kUsage, path,
         ": holds an earlier run; --force replaces it, --resume continues it");
  return true;
}

// Creates the folder; its parent exists. Errors: kWrite.
inline void create_output_folder(const std::string& path) {
  std::error_code error;
  std::filesystem::create_directory(path, error);
  if (error) fail(ErrorKind::kWrite, path, ": cannot create the folder: ", error.message());
}

// Whether `name` is one that an earlier run wrote: digits and one of the endings.
inline bool is_numbered_file(const std::string& name, const std::vector<std::string>& endings) {
  const std::size_t digits = name.find_first_not_of("0123456789");
  if (digits == 0 || digits == std::string::npos) return false;
  return std::find(endings.begin(), endings.end(), name.substr(digits)) != endings.end();
}

// Removes the unfinished files that a killed run left in `path` and the folders inside. Only for a
// folder that nobody else is writing to. Errors: kWrite.
inline void remove_unfinished_files(const std::string& path) {
  namespace fs = std::filesystem;
  std::vector<fs::path> unfinished;
  std::error_code error;
  for (const auto& entry : fs::recursive_directory_iterator(path, error))
    if (is_temporary_file(entry.path().filename().string())) unfinished.push_back(entry.path());
  for (const fs::path& file : unfinished) {
    if (!fs::remove(file, error) && error)
      fail(ErrorKind::kWrite, file.string(), ": cannot be removed: ", error.message());
  }
}

// Removes what an earlier run left: `files`, and in `folders` the files named by a number, with the
// folders themselves once empty. Anything else stays. Missing ones do not matter. Errors: kWrite.
inline void remove_earlier_run(const std::string& path, const std::vector<std::string>& files,
                               const std::vector<std::string>& folders) {
  namespace fs = std::filesystem;
  const auto remove = [](const fs::path& file) {
    std::error_code error;
    fs::remove(file, error);
    if (error && error != std::errc::directory_not_empty)
      fail(ErrorKind::kWrite, file.string(), ": cannot be removed: ", error.message());
  };
  for (const std::string& folder : folders) {
    const fs::path inside = fs::path(path) / folder;
    std::error_code error;
    if (!fs::is_directory(fs::symlink_status(inside, error))) continue;
    std::vector<fs::path> numbered;
    for (const auto& entry : fs::directory_iterator(inside, error))
      if (is_numbered_file(entry.path().filename().string(),
                           {".png", ".json", ".ply", ".safetensors"}))
        numbered.push_back(entry.path());
    for (const fs::path& file : numbered) remove(file);
    remove(inside);
  }
  for (const std::string& file : files) remove(fs::path(path) / file);
}

}  // namespace lvggt::cli
