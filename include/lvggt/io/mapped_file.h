// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <span>
#include <string>
#include <utility>

namespace lvggt {

// A whole regular file mapped for reading, for weights larger than the memory: pages are read when
// they are first used and given back by the system when it needs them. Everything else is read with
// InputFile, which survives a file that somebody shortens meanwhile; here that ends the process.
class MappedFile {
 public:
  // Errors: those of InputFile; kMemory when the system refuses the mapping.
  explicit MappedFile(const std::string& path);
  ~MappedFile();
  MappedFile(MappedFile&& other) noexcept
      : path_(std::move(other.path_)),
        data_(std::exchange(other.data_, nullptr)),
        num_bytes_(std::exchange(other.num_bytes_, 0)) {}
  MappedFile& operator=(MappedFile&&) = delete;

  const std::string& path() const { return path_; }
  std::span<const std::byte> bytes() const { return {data_, num_bytes_}; }

 private:
  std::string path_;
  const std::byte* data_ = nullptr;
  std::size_t num_bytes_ = 0;
};

}  // namespace lvggt
