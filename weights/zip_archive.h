// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/io/input_file.h"

struct zip;  // libzip's archive

namespace lvggt {

// A zip archive as torch.save writes it: entries stored without compression, none encrypted, no
// name twice. Anything else in it is refused at opening, so the entries together are never larger
// than the file.
class ZipArchive {
 public:
  struct Entry {
    std::string name;
    std::int64_t num_bytes = 0;
  };

  // Errors: kRead, kFormat (not a zip archive, damaged, names twice or outside of the archive),
  // kUnsupported (compressed or encrypted entries), kLimit (too many entries).
  explicit ZipArchive(const std::string& path);

  const std::string& path() const { return file_.path(); }
  std::int64_t num_bytes() const { return file_.size(); }

  // In the order of the archive's directory.
  const std::vector<Entry>& entries() const { return entries_; }

  // Index of the entry of that name, or -1.
  std::int64_t find(std::string_view name) const;

  // Reads a whole entry and checks its CRC; out.size() must be its num_bytes.
  void read(std::int64_t entry_idx, std::span<std::byte> out);

 private:
  struct Close {
    void operator()(zip* archive) const;
  };
  void add_entry(std::uint64_t i, std::int64_t* total);

  InputFile file_;
  std::unique_ptr<zip, Close> zip_;
  std::vector<Entry> entries_;
  std::vector<std::uint32_t> by_name_;
};

}  // namespace lvggt
