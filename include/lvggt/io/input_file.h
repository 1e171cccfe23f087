// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>
#include <utility>

#include "lvggt/io/limits.h"

namespace lvggt {

// A regular file opened for reading at any offset. Directories, pipes, sockets and devices are
// refused without blocking on them. It is read with pread and never mapped: when somebody shortens
// the file meanwhile, a read ends in an Error, where a mapping would end the process. Reads may
// come from several threads.
class InputFile {
 public:
  // Error of kind kRead when the file is missing, unreadable or not a regular file.
  explicit InputFile(const std::string& path);
  ~InputFile();
  InputFile(InputFile&& other) noexcept;
  InputFile& operator=(InputFile&&) = delete;

  const std::string& path() const { return path_; }

  // Bytes, as of opening.
  std::int64_t size() const { return size_; }

  // Fills out[0, num_bytes) from `offset`; an Error of kind kRead when the file ends before that.
  void read_at(std::int64_t offset, void* out, std::size_t num_bytes) const;

  // Error of kind kRead when size or modification time are no longer those of opening.
  void check_unchanged() const;

  // Device and inode: equal for two names of one file.
  std::pair<std::uint64_t, std::uint64_t> identity() const { return {device_, inode_}; }

 private:
  std::string path_;
  int fd_ = -1;
  std::int64_t size_ = 0;
  std::int64_t modified_seconds_ = 0;
  std::int64_t modified_nanoseconds_ = 0;
  std::uint64_t device_ = 0;
  std::uint64_t inode_ = 0;
};

// The whole content of a text file of at most `max_bytes`.
std::string read_text_file(const std::string& path, std::uint64_t max_bytes = Limits{}.json_bytes);

// What the first bytes of a file look like, as the end of a sentence ("it looks like an HTML page,
// ..."), or empty when they look like nothing known. For messages about files that are not what
// they should be.
std::string content_hint(std::string_view head);

}  // namespace lvggt
