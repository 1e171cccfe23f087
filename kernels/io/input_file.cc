// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/input_file.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>

#include "kernels/io/system_error.h"
#include "lvggt/core/error.h"

namespace lvggt {
namespace {

// One read call moves at most about 2 GiB.
constexpr std::size_t kMaxReadBytes = std::size_t{1} << 30;

[[noreturn]] void fail_changed(const std::string& path) {
  fail(ErrorKind::kRead, path, " was changed by another program while it was being read");
}

const char* kind_of_file(mode_t mode) {
  if (S_ISDIR(mode)) return "a directory";
  if (S_ISFIFO(mode)) return "a named pipe";
  if (S_ISSOCK(mode)) return "a socket";
  return "a device";
}

}  // namespace

InputFile::InputFile(const std::string& path) : path_(path) {
  // O_NONBLOCK: opening a pipe nobody writes to must not wait. It means nothing for regular files.
  do {
    fd_ = ::open(path.c_str(), O_RDONLY | O_CLOEXEC | O_NONBLOCK | O_NOCTTY);
  } while (fd_ < 0 && errno == EINTR);
  struct stat info;
  if (fd_ < 0) {
    const int error = errno;
    if (error == ENXIO && ::stat(path.c_str(), &info) == 0)
      fail(ErrorKind::kRead, "cannot read ", path, ": it is ", kind_of_file(info.st_mode),
           ", not a file");
    fail(ErrorKind::kRead, "cannot open ", path, ": ", system_error_text(error));
  }
  const bool known = ::fstat(fd_, &info) == 0;
  if (!known || !S_ISREG(info.st_mode)) {
    const int error = errno;
    ::close(fd_);
    if (!known) fail(ErrorKind::kRead, "cannot read ", path, ": ", system_error_text(error));
    fail(ErrorKind::kRead, "cannot read ", path, ": it is ", kind_of_file(info.st_mode),
         ", not a file");
  }
  size_ = info.st_size;
  modified_seconds_ = info.st_mtim.tv_sec;
  modified_nanoseconds_ = info.st_mtim.tv_nsec;
  device_ = info.st_dev;
  inode_ = info.st_ino;
}

InputFile::~InputFile() {
  if (fd_ >= 0) ::close(fd_);
}

InputFile::InputFile(InputFile&& other) noexcept
    : path_(std::move(other.path_)),
      fd_(std::exchange(other.fd_, -1)),
      size_(other.size_),
      modified_seconds_(other.modified_seconds_),
      modified_nanoseconds_(other.modified_nanoseconds_),
      device_(other.device_),
      inode_(other.inode_) {}

void InputFile::read_at(std::int64_t offset, void* out, std::size_t num_bytes) const {
  char* to = static_cast<char*>(out);
  while (num_bytes > 0) {
    const ssize_t got = ::pread(fd_, to, std::min(num_bytes, kMaxReadBytes), offset);
    if (got < 0) {
      if (errno == EINTR) continue;
      fail(ErrorKind::kRead, "cannot read ", path_, " at byte ", offset, ": ",
           system_error_text(errno));
    }
    if (got == 0) {
      check_unchanged();
      fail(ErrorKind::kRead, path_, " ends at byte ", offset, " although ", num_bytes,
           " more are needed");
    }
    to += got;
    offset += got;
    num_bytes -= static_cast<std::size_t>(got);
  }
}

void InputFile::check_unchanged() const {
  struct stat info;
  if (::fstat(fd_, &info) != 0)
    fail(ErrorKind::kRead, "cannot read ", path_, ": ", system_error_text(errno));
  if (info.st_size != size_ || info.st_mtim.tv_sec != modified_seconds_ ||
      info.st_mtim.tv_nsec != modified_nanoseconds_)
    fail_changed(path_);
}

std::string read_text_file(const std::string& path, std::uint64_t max_bytes) {
  const InputFile file(path);
  if (static_cast<std::uint64_t>(file.size()) > max_bytes)
    fail(ErrorKind::kLimit, path, " has ", file.size(), " bytes, more than the limit of ",
         max_bytes, " for a text file");
  std::string text(static_cast<std::size_t>(file.size()), '\0');
  file.read_at(0, text.data(), text.size());
  file.check_unchanged();
  return text;
}

}  // namespace lvggt
