// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <string>
#include <string_view>
#include <vector>

namespace lvggt {

// An output file that appears under its final name only when it is complete: bytes go to a hidden
// temporary file in the same directory, and commit() flushes it, syncs it, renames it and syncs the
// directory. Without commit() the destructor removes the temporary file and an older file of that
// name stays as it was. A symbolic link is followed: the file it points at is replaced, not the
// link. Every failure is an Error of kind kWrite that names the path and the reason. Not
// thread-safe.
class AtomicFile {
 public:
  // Creates the temporary file. Refused: a missing or unwritable parent directory, and a path that
  // names something else than a regular file (a directory, a device, a pipe).
  explicit AtomicFile(const std::string& path);
  ~AtomicFile();
  AtomicFile(AtomicFile&& other) noexcept;
  AtomicFile& operator=(AtomicFile&& other) = delete;

  // The name as it was given.
  const std::string& path() const { return path_; }

  // Bytes written so far.
  std::size_t position() const { return position_; }

  void write(const void* data, std::size_t num_bytes);
  void write(std::string_view text) { write(text.data(), text.size()); }

  // Makes the file appear under its final name. Call it once, after the last write.
  void commit();

 private:
  void flush();
  void write_through(const char* data, std::size_t num_bytes);

  std::string path_;
  std::string final_path_;  // path_ with symbolic links followed
  std::string temporary_path_;
  int fd_ = -1;
  std::size_t position_ = 0;
  std::vector<char> buffer_;
};

// Writes a whole text file atomically.
void write_file(const std::string& path, std::string_view text);

// Checks, before any long work, that `path` can become an output file: its directory exists and can
// be written, and the path is free, or is a regular file and `overwrite` is set. An existing file
// without `overwrite` is an Error of kind kUsage that mentions --force, everything else of kind
// kWrite.
void check_output_file(const std::string& path, bool overwrite);

}  // namespace lvggt
