// SPDX-License-Identifier: Apache-2.0
#include "weights/zip_archive.h"

#include <doctest/doctest.h>

#include <string>
#include <vector>

#include "tests/support/pth_bytes.h"
#include "tests/support/safetensors_bytes.h"

using lvggt::ErrorKind;
using lvggt::ZipArchive;
using lvggt::test::Outcome;
using lvggt::test::outcome_of;
using lvggt::test::TempDir;
using lvggt::test::write_zip;
using lvggt::test::ZipEntry;

namespace {

// Opens an archive and reads every entry.
Outcome read_archive(const std::string& path) {
  return outcome_of([&] {
    ZipArchive archive(path);
    for (std::size_t i = 0; i < archive.entries().size(); ++i) {
      std::vector<std::byte> bytes(static_cast<std::size_t>(archive.entries()[i].num_bytes));
      archive.read(static_cast<std::int64_t>(i), bytes);
    }
  });
}

Outcome read_entries(const std::vector<ZipEntry>& entries) {
  const TempDir dir;
  write_zip(dir / "a.zip", entries);
  return read_archive(dir / "a.zip");
}

Outcome read_bytes(const std::string& bytes) {
  const TempDir dir;
  lvggt::write_file(dir / "a.zip", bytes);
  return read_archive(dir / "a.zip");
}

// A valid archive with the entries "first" and "other".
std::string archive_bytes() {
  const TempDir dir;
  write_zip(dir / "a.zip", {{"first", "0123456789abcdef"}, {"other", "ghijklmnopqrstuv"}});
  return lvggt::read_text_file(dir / "a.zip");
}

void replace_all(std::string& text, const std::string& from, const std::string& to) {
  for (std::size_t at = text.find(from); at != std::string::npos;
       at = text.find(from, at + to.size()))
    text.replace(at, from.size(), to);
}

}  // namespace

TEST_CASE("ZipArchive: stored entries are found and read") {
  const TempDir dir;
  write_zip(dir / "a.zip", {{"x/data.pkl", "abc"}, {"x/empty", ""}});
  ZipArchive archive(dir / "a.zip");
  REQUIRE(archive.entries().size() == 2);
  CHECK(archive.find("x/empty") == 1);
  CHECK(archive.find("x/none") == -1);
  std::string bytes(3, '\0');
  archive.read(archive.find("x/data.pkl"), std::as_writable_bytes(std::span(bytes)));
  CHECK(bytes == "abc");
}

TEST_CASE("B14: compressed entries, and with them zip bombs, are refused") {
  const Outcome outcome = read_entries({{"bomb", std::string(10'000'000, '\0'), true}});
  CHECK(outcome.kind == ErrorKind::kUnsupported);
  CHECK(outcome.says("bomb: it is compressed"));
}

TEST_CASE("B14: encrypted entries are refused") {
  const Outcome outcome = read_entries({{"secret", "0123456789", false, true}});
  CHECK(outcome.kind == ErrorKind::kUnsupported);
  CHECK(outcome.says("secret: it is encrypted"));
}

TEST_CASE("B14: names that lead out of the archive are refused") {
  for (const char* name : {"../a", "a/../b", "/etc/passwd", "a\\b", "..", "a/.."}) {
    const Outcome outcome = read_entries({{name, "x"}});
    CAPTURE(outcome.message);
    CHECK(outcome.kind == ErrorKind::kFormat);
    CHECK(outcome.says("leads out of the archive"));
  }
}

TEST_CASE("B14: an entry twice is refused") {
  std::string bytes = archive_bytes();
  replace_all(bytes, "other", "first");
  const Outcome outcome = read_bytes(bytes);
  CAPTURE(outcome.message);
  CHECK(outcome.kind == ErrorKind::kFormat);
}

TEST_CASE("B14: a wrong CRC is refused") {
  std::string bytes = archive_bytes();
  replace_all(bytes, "0123456789abcdef", "0123456789abcdeF");
  const Outcome outcome = read_bytes(bytes);
  CAPTURE(outcome.message);
  CHECK(outcome.kind == ErrorKind::kFormat);
  CHECK(outcome.says("CRC"));
}

TEST_CASE("B14: a directory at odds with what precedes an entry is refused") {
  const std::string whole = archive_bytes();
  const std::size_t directory = whole.find("PK\1\2");
  REQUIRE(directory != std::string::npos);
  // Offsets within a directory record: CRC 16, compressed size 20, size 24, name 46.
  for (const std::size_t at :
       {std::size_t{16}, std::size_t{20}, std::size_t{24}, std::size_t{46}}) {
    std::string bytes = whole;
    bytes[directory + at] = static_cast<char>(bytes[directory + at] + 1);
    const Outcome outcome = read_bytes(bytes);
    CAPTURE(at);
    CAPTURE(outcome.message);
    CHECK(outcome.kind == ErrorKind::kFormat);
  }
}

TEST_CASE("B14: entries that claim more bytes than the file has are refused") {
  std::string bytes = archive_bytes();
  const std::size_t directory = bytes.find("PK\1\2");
  for (const std::size_t record : {std::size_t{0}, directory})
    for (const std::size_t at : {std::size_t{20}, std::size_t{24}}) {
      const std::size_t offset =
          record + at - (record == 0 ? 2 : 0);  // local records lack one field
      bytes.replace(offset, 4, std::string("\0\0\0\x10", 4));
    }
  const Outcome outcome = read_bytes(bytes);
  CAPTURE(outcome.message);
  CHECK(outcome.kind == ErrorKind::kFormat);
}

TEST_CASE("B14: an archive cut anywhere, or none at all, is refused") {
  const std::string whole = archive_bytes();
  for (std::size_t n = 0; n < whole.size(); n += 3) {
    const Outcome outcome = read_bytes(whole.substr(0, n));
    CAPTURE(outcome.message);
    CHECK(outcome.kind == ErrorKind::kFormat);
  }
  CHECK(read_bytes("hello").says("plain text"));
  CHECK(read_archive("/dev/zero").kind == ErrorKind::kRead);
  CHECK(read_archive("/").kind == ErrorKind::kRead);
}

TEST_CASE("B14: a zip64 directory that claims 2^40 entries is refused") {
  // End records alone: zip64 end, its locator, and the classic end that points to them.
  std::string bytes = std::string("PK\6\6") + std::string("\x2c\0\0\0\0\0\0\0", 8) +
                      std::string("\x2d\0\x2d\0", 4) + std::string(8, '\0');
  const std::string count("\0\0\0\0\0\1\0\0", 8);
  bytes += count + count + std::string(16, '\0');
  bytes += std::string("PK\6\7") + std::string(12, '\0') + std::string("\1\0\0\0", 4);
  bytes += std::string("PK\5\6") + std::string(4, '\0') + std::string(12, '\xff') +
           std::string("\0\0", 2);
  const Outcome outcome = read_bytes(bytes);
  CAPTURE(outcome.message);
  CHECK_FALSE(outcome.accepted);
}
