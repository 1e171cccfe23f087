// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/mapped_file.h"

#include <fcntl.h>
#include <sys/mman.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstring>

#include "lvggt/core/error.h"
#include "lvggt/io/input_file.h"

namespace lvggt {

MappedFile::MappedFile(const std::string& path) : path_(path) {
  const InputFile checked(path);  // a regular file that can be read
  num_bytes_ = static_cast<std::size_t>(checked.size());
  if (num_bytes_ == 0) return;
  const int fd = ::open(path.c_str(), O_RDONLY | O_CLOEXEC);
  if (fd < 0) fail(ErrorKind::kRead, path, ": cannot be opened: ", std::strerror(errno));
  struct stat status;
  const bool same = ::fstat(fd, &status) == 0 && status.st_size == checked.size();
  void* mapped = same ? ::mmap(nullptr, num_bytes_, PROT_READ, MAP_SHARED, fd, 0) : MAP_FAILED;
  const int error = errno;
  ::close(fd);
  if (!same) fail(ErrorKind::kRead, path, ": changed while it was opened");
  if (mapped == MAP_FAILED)
    fail(ErrorKind::kMemory, path, ": its ", num_bytes_,
         " bytes cannot be mapped: ", std::strerror(error));
  data_ = static_cast<const std::byte*>(mapped);
}

MappedFile::~MappedFile() {
  if (data_ != nullptr) ::munmap(const_cast<std::byte*>(data_), num_bytes_);
}

}  // namespace lvggt
