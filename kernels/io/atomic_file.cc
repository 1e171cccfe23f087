// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/atomic_file.h"

#include <fcntl.h>
#include <sys/stat.h>
#include <unistd.h>

#include <algorithm>
#include <cstdint>
#include <cstdio>
#include <cstring>
#include <filesystem>
#include <random>
#include <utility>

#include "kernels/io/system_error.h"
#include "lvggt/core/error.h"

namespace lvggt {
namespace {

namespace fs = std::filesystem;

// Small writes are gathered into blocks of this size, larger ones go straight to the system.
constexpr std::size_t kBufferBytes = std::size_t{1} << 18;

// One write() call moves at most about 2 GiB; staying below keeps progress in sane steps.
constexpr std::size_t kMaxWriteBytes = std::size_t{1} << 30;

[[noreturn]] void fail_write(const std::string& path, int error) {
  fail(ErrorKind::kWrite, "cannot write ", path, ": ", system_error_text(error));
}

std::string directory_of(const std::string& path) {
  const std::string parent = fs::path(path).parent_path().string();
  return parent.empty() ? "." : parent;
}

// Where the bytes end up: links are followed so that replacing keeps the link.
std::string resolve_links(const std::string& path) {
  std::error_code error;
  if (!fs::is_symlink(fs::symlink_status(path, error))) return path;
  const fs::path resolved = fs::weakly_canonical(path, error);
  if (error) fail_write(path, error.value());
  return resolved.string();
}

// Refuses what a rename would destroy or could not replace.
bool check_replaceable(const std::string& path, const std::string& final_path) {
  if (path.empty()) fail(ErrorKind::kWrite, "cannot write a file with an empty name");
  if (path.back() == '/')
    fail(ErrorKind::kWrite, "cannot write ", path,
         ": the name ends in a slash, as a directory's does");
  struct stat info;
  if (::stat(final_path.c_str(), &info) != 0) {
    if (errno == ENOENT) return false;
    fail_write(path, errno);
  }
  if (S_ISDIR(info.st_mode)) fail(ErrorKind::kWrite, "cannot write ", path, ": it is a directory");
  if (!S_ISREG(info.st_mode))
    fail(ErrorKind::kWrite, "cannot write ", path, ": it exists and is not a regular file");
  return true;
}

// Refuses a parent directory that is missing or not one.
void check_parent(const std::string& path, const std::string& final_path) {
  const std::string directory = directory_of(final_path);
  struct stat info;
  if (::stat(directory.c_str(), &info) != 0)
    fail(ErrorKind::kWrite, "cannot write ", path, ": its directory ", directory,
         " cannot be used: ", system_error_text(errno));
  if (!S_ISDIR(info.st_mode))
    fail(ErrorKind::kWrite, "cannot write ", path, ": ", directory, " is not a directory");
}

// A hidden name that no other process uses; the final name is shortened so that it always fits.
std::string temporary_name(const std::string& final_path) {
  constexpr std::size_t kMaxShownName = 200;  // of the 255 bytes a name may have
  static constexpr char kDigits[] = "0123456789abcdef";
  std::random_device random;
  std::string tag(16, '0');
  for (char& c : tag) c = kDigits[random() % 16];
  const std::string name = fs::path(final_path).filename().string().substr(0, kMaxShownName);
  return (fs::path(directory_of(final_path)) / ("." + name + "." + tag + ".tmp")).string();
}

// Some file systems cannot sync a directory or a file; that is not a failed write.
bool sync_unsupported(int error) { return error == EINVAL || error == ENOTSUP || error == ENOSYS; }

void sync_directory(const std::string& path, const std::string& final_path) {
  const int fd = ::open(directory_of(final_path).c_str(), O_RDONLY | O_DIRECTORY | O_CLOEXEC);
  if (fd < 0) return;  // a directory that may be written but not listed cannot be synced
  const int error = ::fsync(fd) == 0 ? 0 : errno;
  ::close(fd);
  if (error != 0 && !sync_unsupported(error)) fail_write(path, error);
}

}  // namespace

AtomicFile::AtomicFile(const std::string& path) : path_(path), final_path_(resolve_links(path)) {
  check_replaceable(path_, final_path_);
  check_parent(path_, final_path_);
  buffer_.reserve(kBufferBytes);
  do {
    temporary_path_ = temporary_name(final_path_);
    fd_ = ::open(temporary_path_.c_str(), O_WRONLY | O_CREAT | O_EXCL | O_CLOEXEC, 0666);
  } while (fd_ < 0 && (errno == EEXIST || errno == EINTR));
  if (fd_ < 0) fail_write(path_, errno);
}

AtomicFile::~AtomicFile() {
  if (fd_ >= 0) ::close(fd_);
  if (!temporary_path_.empty()) ::unlink(temporary_path_.c_str());
}

AtomicFile::AtomicFile(AtomicFile&& other) noexcept
    : path_(std::move(other.path_)),
      final_path_(std::move(other.final_path_)),
      temporary_path_(std::exchange(other.temporary_path_, std::string())),
      fd_(std::exchange(other.fd_, -1)),
      position_(other.position_),
      buffer_(std::move(other.buffer_)) {}

void AtomicFile::write(const void* data, std::size_t num_bytes) {
  if (fd_ < 0) fail(ErrorKind::kWrite, "cannot write ", path_, ": it is already complete");
  if (num_bytes == 0) return;
  if (buffer_.size() + num_bytes > kBufferBytes) flush();
  const char* bytes = static_cast<const char*>(data);
  if (num_bytes >= kBufferBytes) {
    write_through(bytes, num_bytes);
  } else {
    buffer_.insert(buffer_.end(), bytes, bytes + num_bytes);
  }
  position_ += num_bytes;
}

void AtomicFile::flush() {
  write_through(buffer_.data(), buffer_.size());
  buffer_.clear();
}

void AtomicFile::write_through(const char* data, std::size_t num_bytes) {
  while (num_bytes > 0) {
    const ssize_t written = ::write(fd_, data, std::min(num_bytes, kMaxWriteBytes));
    if (written < 0) {
      if (errno == EINTR) continue;
      fail_write(path_, errno);
    }
    data += written;
    num_bytes -= static_cast<std::size_t>(written);
  }
}

void AtomicFile::commit() {
  if (fd_ < 0) fail(ErrorKind::kWrite, "cannot write ", path_, ": it is already complete");
  flush();
  while (::fsync(fd_) != 0) {
    if (errno == EINTR) continue;
    if (!sync_unsupported(errno)) fail_write(path_, errno);
    break;
  }
  // After close the descriptor is gone whatever it returns; a delayed write error shows up here.
  if (::close(std::exchange(fd_, -1)) != 0 && errno != EINTR) fail_write(path_, errno);
  check_replaceable(path_, final_path_);
  if (::rename(temporary_path_.c_str(), final_path_.c_str()) != 0) fail_write(path_, errno);
  temporary_path_.clear();
  sync_directory(path_, final_path_);
}

void write_file(const std::string& path, std::string_view text) {
  AtomicFile file(path);
  file.write(text);
  file.commit();
}

void check_output_file(const std::string& path, bool overwrite) {
  const std::string final_path = resolve_links(path);
  const bool exists = check_replaceable(path, final_path);
  check_parent(path, final_path);
  if (exists && !overwrite)
    fail(ErrorKind::kUsage, path,
         " exists already; choose another name, or add --force to replace it");
  if (::access(directory_of(final_path).c_str(), W_OK | X_OK) != 0) fail_write(path, errno);
}

}  // namespace lvggt
