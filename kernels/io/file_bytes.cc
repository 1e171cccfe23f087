// SPDX-License-Identifier: Apache-2.0
#include "kernels/io/file_bytes.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cerrno>
#include <cstring>

#include "lvggt/core/error.h"

namespace lvggt::detail {

namespace {

// A descriptor of a regular file. Opened without blocking, so that a FIFO cannot hang the caller
// before it is seen to be one.
class InputFile {
 public:
  explicit InputFile(const std::string& path) : path_(path) {
    if (path.find('\0') != std::string::npos)
      fail(ErrorKind::kRead, "a file name contains a NUL byte");
    fd_ = ::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK);
    if (fd_ < 0) fail(ErrorKind::kRead, path, ": cannot be opened: ", std::strerror(errno));
    struct stat status {};
    const bool known = ::fstat(fd_, &status) == 0;
    if (!known || !S_ISREG(status.st_mode)) {
      ::close(fd_);
      fail(ErrorKind::kRead, path, ": is ",
           known && S_ISDIR(status.st_mode) ? "a directory" : "not a regular file",
           ", but a file is expected");
    }
    size_ = status.st_size;
  }
  ~InputFile() { ::close(fd_); }
  InputFile(const InputFile&) = delete;
  InputFile& operator=(const InputFile&) = delete;

  std::int64_t size() const { return size_; }

  // Fewer bytes than asked for only at the end of the file.
  std::vector<std::byte> read(std::size_t count) const {
    std::vector<std::byte> bytes(count);
    std::size_t done = 0;
    while (done < count) {
      const ssize_t n = ::read(fd_, bytes.data() + done, count - done);
      if (n < 0 && errno == EINTR) continue;
      if (n < 0) fail(ErrorKind::kRead, path_, ": cannot be read: ", std::strerror(errno));
      if (n == 0) break;
      done += static_cast<std::size_t>(n);
    }
    bytes.resize(done);
    return bytes;
  }

 private:
  const std::string& path_;
  int fd_ = -1;
  std::int64_t size_ = 0;
};

}  // namespace

std::int64_t regular_file_size(const std::string& path) { return InputFile(path).size(); }

std::vector<std::byte> read_file_head(const std::string& path, std::size_t count) {
  const InputFile file(path);
  return file.read(std::min(count, static_cast<std::size_t>(file.size())));
}

std::vector<std::byte> read_whole_file(const std::string& path, std::int64_t max_bytes) {
  const InputFile file(path);
  if (file.size() > max_bytes)
    fail(ErrorKind::kLimit, path, ": has ", file.size(), " bytes, more than the limit of ",
         max_bytes);
  return file.read(static_cast<std::size_t>(file.size()));
}

}  // namespace lvggt::detail
