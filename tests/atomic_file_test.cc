// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/atomic_file.h"

#include <doctest/doctest.h>
#include <sys/stat.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <iterator>
#include <string>

#include "lvggt/core/error.h"
#include "tests/support/temp_dir.h"

namespace {

namespace fs = std::filesystem;
using lvggt::AtomicFile;
using lvggt::Error;
using lvggt::ErrorKind;
using lvggt::test::TempDir;

std::string content(const std::string& path) {
  std::ifstream in(path, std::ios::binary);
  return {std::istreambuf_iterator<char>(in), {}};
}

std::size_t num_files(const TempDir& dir) {
  return static_cast<std::size_t>(std::distance(fs::directory_iterator(dir.path()), {}));
}

template <class F>
ErrorKind kind_of_error(F&& f) {
  try {
    f();
  } catch (const Error& error) {
    return error.kind();
  }
  FAIL("no error");
  return ErrorKind::kUsage;
}

}  // namespace

TEST_CASE("AtomicFile: the file appears only at commit, with every byte") {
  const TempDir dir;
  const std::string path = dir / "out.bin";
  std::string expected;
  {
    AtomicFile file(path);
    for (int i = 0; i < 1000; ++i) {
      const std::string piece(static_cast<std::size_t>(i), static_cast<char>('a' + i % 26));
      file.write(piece);
      expected += piece;
    }
    const std::string large(1 << 20, 'x');
    file.write(large);
    expected += large;
    CHECK(file.position() == expected.size());
    CHECK_FALSE(fs::exists(path));
    file.commit();
  }
  CHECK(content(path) == expected);
  CHECK(num_files(dir) == 1);
}

TEST_CASE("AtomicFile: without commit nothing is left and the old file stays") {
  const TempDir dir;
  const std::string path = dir / "out.txt";
  lvggt::write_file(path, "old");
  {
    AtomicFile file(path);
    file.write("new");
  }
  CHECK(content(path) == "old");
  CHECK(num_files(dir) == 1);
}

TEST_CASE("AtomicFile: a moved-from file leaves the moved-to one alone") {
  const TempDir dir;
  AtomicFile first(dir / "a");
  first.write("text");
  {
    AtomicFile second(std::move(first));
    second.commit();
  }
  CHECK(content(dir / "a") == "text");
}

TEST_CASE("AtomicFile: a symbolic link keeps pointing at the file that is replaced") {
  const TempDir dir;
  lvggt::write_file(dir / "target", "old");
  fs::create_symlink("target", dir / "link");
  lvggt::write_file(dir / "link", "new");
  CHECK(fs::is_symlink(dir / "link"));
  CHECK(content(dir / "target") == "new");
}

TEST_CASE("AtomicFile: a name of 255 bytes works") {
  const TempDir dir;
  const std::string path = dir / std::string(255, 'n');
  lvggt::write_file(path, "x");
  CHECK(content(path) == "x");
}

TEST_CASE(
    "D02: an output whose parent is missing, a file, or a directory of that name is refused") {
  const TempDir dir;
  lvggt::write_file(dir / "file", "keep");
  fs::create_directory(dir / "folder");
  REQUIRE(mkfifo((dir / "fifo").c_str(), 0600) == 0);
  for (const std::string& path :
       {dir / "missing/out", dir / "file/out", dir / "folder", dir / "folder/", dir / "fifo",
        std::string("/dev/full"), std::string()}) {
    CAPTURE(path);
    CHECK(kind_of_error([&] { AtomicFile file(path); }) == ErrorKind::kWrite);
    CHECK(kind_of_error([&] { lvggt::check_output_file(path, true); }) == ErrorKind::kWrite);
  }
  CHECK(content(dir / "file") == "keep");
  CHECK(num_files(dir) == 3);
}

TEST_CASE("D02: a read-only directory is refused") {
  if (geteuid() == 0) return;  // nothing is read-only to the superuser
  const TempDir dir;
  fs::permissions(dir.path(), fs::perms::owner_read | fs::perms::owner_exec);
  CHECK(kind_of_error([&] { AtomicFile file(dir / "out"); }) == ErrorKind::kWrite);
  CHECK(kind_of_error([&] { lvggt::check_output_file(dir / "out", false); }) == ErrorKind::kWrite);
  fs::permissions(dir.path(), fs::perms::owner_all);
}

TEST_CASE("D02: an existing output needs --force") {
  const TempDir dir;
  lvggt::write_file(dir / "out", "old");
  CHECK(kind_of_error([&] { lvggt::check_output_file(dir / "out", false); }) == ErrorKind::kUsage);
  lvggt::check_output_file(dir / "out", true);
  lvggt::check_output_file(dir / "new", false);
  CHECK(num_files(dir) == 1);
}

TEST_CASE(
    "D03: names with a space, a newline, a quote or bytes that are not UTF-8 are just names") {
  const TempDir dir;
  for (const char* name : {"a b", "a\nb", "a\"b'", "\xff\xfe"}) {
    lvggt::write_file(dir / name, name);
    CHECK(content(dir / name) == name);
  }
  CHECK(kind_of_error([&] { AtomicFile file(dir / std::string(4096, 'x')); }) == ErrorKind::kWrite);
}
