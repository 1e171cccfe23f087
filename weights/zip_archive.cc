// SPDX-License-Identifier: Apache-2.0
#include "weights/zip_archive.h"

#include <zip.h>

#include <algorithm>
#include <array>
#include <cstring>
#include <numeric>

#include "lvggt/core/error.h"
#include "lvggt/io/checked.h"

namespace lvggt {
namespace {

// A checkpoint has an entry a storage; as many as a model may have tensors, and a few more.
constexpr std::uint64_t kMaxEntries = 1'000'100;

constexpr std::size_t kMaxNameBytes = 1024;

// An entry's directory record has at least this size.
constexpr std::int64_t kDirectoryRecordBytes = 46;

struct CloseFile {
  void operator()(zip_file_t* file) const { zip_fclose(file); }
};

// Opens the archive with libzip's consistency checks, among them that the directory agrees with
// what precedes each entry.
zip_t* open_zip(const InputFile& file) {
  std::array<char, 64> head{};
  const auto num_head = static_cast<std::size_t>(std::min<std::int64_t>(file.size(), head.size()));
  file.read_at(0, head.data(), num_head);
  const std::string_view start(head.data(), num_head);
  if (!start.starts_with("PK")) {
    const std::string hint = content_hint(start);
    fail(ErrorKind::kFormat, file.path(), " is not a zip archive",
         num_head == 0 ? ": it is empty" : "", hint.empty() ? "" : "; ", hint);
  }
  int code = 0;
  zip_t* archive = zip_open(file.path().c_str(), ZIP_RDONLY | ZIP_CHECKCONS, &code);
  if (archive == nullptr) {
    zip_error_t error;
    zip_error_init_with_code(&error, code);
    const std::string text = zip_error_strerror(&error);
    zip_error_fini(&error);
    fail(ErrorKind::kFormat, file.path(), " is not a valid zip archive: ", text,
         "; it may be an incomplete download");
  }
  return archive;
}

bool leaves_archive(std::string_view name) {
  if (name.empty() || name.front() == '/' || name.find('\\') != std::string_view::npos) return true;
  for (std::size_t begin = 0; begin <= name.size();) {
    const std::size_t end = std::min(name.find('/', begin), name.size());
    if (name.substr(begin, end - begin) == "..") return true;
    begin = end + 1;
  }
  return false;
}

}  // namespace

void ZipArchive::Close::operator()(zip* archive) const { zip_discard(archive); }

ZipArchive::ZipArchive(const std::string& path) : file_(path), zip_(open_zip(file_)) {
  const auto num_entries =
      static_cast<std::uint64_t>(zip_get_num_entries(zip_.get(), ZIP_FL_UNCHANGED));
  if (num_entries > kMaxEntries ||
      num_entries > static_cast<std::uint64_t>(file_.size() / kDirectoryRecordBytes))
    fail(ErrorKind::kLimit, path, " has ", num_entries,
         " entries, too many for a checkpoint of this size");
  std::int64_t total = 0;
  for (std::uint64_t i = 0; i < num_entries; ++i) add_entry(i, &total);
  by_name_.resize(entries_.size());
  std::iota(by_name_.begin(), by_name_.end(), 0u);
  std::sort(by_name_.begin(), by_name_.end(),
            [&](std::uint32_t a, std::uint32_t b) { return entries_[a].name < entries_[b].name; });
  for (std::size_t i = 1; i < by_name_.size(); ++i)
    if (entries_[by_name_[i - 1]].name == entries_[by_name_[i]].name)
      fail(ErrorKind::kFormat, path, " has the entry ", entries_[by_name_[i]].name, " twice");
}

void ZipArchive::add_entry(std::uint64_t i, std::int64_t* total) {
  zip_stat_t info;
  if (zip_stat_index(zip_.get(), i, ZIP_FL_UNCHANGED, &info) != 0)
    fail(ErrorKind::kFormat, path(), ", entry ", i, ": ", zip_strerror(zip_.get()));
  constexpr zip_uint64_t kNeeded =
      ZIP_STAT_NAME | ZIP_STAT_SIZE | ZIP_STAT_COMP_METHOD | ZIP_STAT_ENCRYPTION_METHOD;
  if ((info.valid & kNeeded) != kNeeded)
    fail(ErrorKind::kFormat, path(), ", entry ", i, ": its directory record is incomplete");
  const std::string name = info.name;
  if (name.size() > kMaxNameBytes)
    fail(ErrorKind::kLimit, path(), ", entry ", i, ": its name has ", name.size(), " bytes");
  if (leaves_archive(name))
    fail(ErrorKind::kFormat, path(), ", entry ", i, ": its name leads out of the archive");
  if (info.encryption_method != ZIP_EM_NONE)
    fail(ErrorKind::kUnsupported, path(), ", entry ", name, ": it is encrypted");
  if (info.comp_method != ZIP_CM_STORE)
    fail(ErrorKind::kUnsupported, path(), ", entry ", name,
         ": it is compressed, which torch.save never does; save the checkpoint again");
  // Stored entries lie in the file byte by byte, so all of them together cannot exceed it.
  const auto sum = info.size <= INT64_MAX
                       ? checked_add(*total, static_cast<std::int64_t>(info.size))
                       : std::nullopt;
  if (!sum || *sum > file_.size())
    fail(ErrorKind::kFormat, path(), ", entry ", name,
         ": the entries up to here claim more bytes than the ", file_.size(), " of the file");
  *total = *sum;
  entries_.push_back({name, static_cast<std::int64_t>(info.size)});
}

std::int64_t ZipArchive::find(std::string_view name) const {
  const auto it =
      std::lower_bound(by_name_.begin(), by_name_.end(), name,
                       [&](std::uint32_t i, std::string_view n) { return entries_[i].name < n; });
  return it == by_name_.end() || entries_[*it].name != name ? -1 : static_cast<std::int64_t>(*it);
}

void ZipArchive::read(std::int64_t entry_idx, std::span<std::byte> out) {
  const Entry& entry = entries_.at(static_cast<std::size_t>(entry_idx));
  LVGGT_CHECK(static_cast<std::int64_t>(out.size()) == entry.num_bytes, path(), ", entry ",
              entry.name, " has ", entry.num_bytes, " bytes, but ", out.size(), " are expected");
  const std::unique_ptr<zip_file_t, CloseFile> stream(
      zip_fopen_index(zip_.get(), static_cast<zip_uint64_t>(entry_idx), ZIP_FL_UNCHANGED));
  if (stream == nullptr)
    fail(ErrorKind::kFormat, path(), ", entry ", entry.name, ": ", zip_strerror(zip_.get()));
  // One byte more than there should be: libzip checks length and CRC when it meets the end.
  std::size_t done = 0;
  std::byte extra;
  for (;;) {
    const bool full = done == out.size();
    const zip_int64_t got =
        zip_fread(stream.get(), full ? &extra : out.data() + done, full ? 1 : out.size() - done);
    if (got < 0)
      fail(ErrorKind::kFormat, path(), ", entry ", entry.name, ": ",
           zip_file_strerror(stream.get()));
    if (got == 0) break;
    if (full) fail(ErrorKind::kFormat, path(), ", entry ", entry.name, " is longer than it claims");
    done += static_cast<std::size_t>(got);
  }
  if (done != out.size())
    fail(ErrorKind::kFormat, path(), ", entry ", entry.name, " ends after ", done, " of ",
         out.size(), " bytes");
  file_.check_unchanged();
}

}  // namespace lvggt
