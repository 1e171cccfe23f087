// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <zip.h>

#include <cstdint>
#include <cstring>
#include <stdexcept>
#include <string>
#include <string_view>
#include <utility>
#include <vector>

namespace lvggt::test {

// Writes pickles instruction by instruction, correct ones and others.
class PickleWriter {
 public:
  PickleWriter() { op(0x80).byte(2); }

  PickleWriter& op(int code) { return byte(code); }
  PickleWriter& byte(int value) {
    bytes_ += static_cast<char>(value);
    return *this;
  }
  PickleWriter& raw(std::string_view bytes) {
    bytes_ += bytes;
    return *this;
  }
  PickleWriter& u32(std::uint32_t value) {
    char bytes[sizeof(value)];
    std::memcpy(bytes, &value, sizeof(value));
    return raw({bytes, sizeof(value)});
  }
  PickleWriter& text(std::string_view value) {
    return op('X').u32(static_cast<std::uint32_t>(value.size())).raw(value);
  }
  PickleWriter& integer(std::int64_t value) {
    op(0x8a).byte(8);
    char bytes[sizeof(value)];
    std::memcpy(bytes, &value, sizeof(value));
    return raw({bytes, sizeof(value)});
  }
  PickleWriter& integers(const std::vector<std::int64_t>& values) {
    op('(');
    for (const std::int64_t value : values) integer(value);
    return op('t');
  }
  PickleWriter& global(std::string_view module, std::string_view name) {
    return op('c').raw(module).raw("\n").raw(name).raw("\n");
  }
  PickleWriter& storage(std::string_view type, std::string_view key, std::int64_t size) {
    return op('(')
        .text("storage")
        .global("torch", type)
        .text(key)
        .text("cpu")
        .integer(size)
        .op('t')
        .op('Q');
  }
  PickleWriter& tensor(std::string_view type, std::string_view key, std::int64_t size,
                       std::int64_t offset, const std::vector<std::int64_t>& shape,
                       const std::vector<std::int64_t>& strides) {
    global("torch._utils", "_rebuild_tensor_v2").op('(').storage(type, key, size).integer(offset);
    return integers(shape).integers(strides).op(0x89).op('}').op('t').op('R');
  }

  // The pickle, ended.
  std::string done() const { return bytes_ + "."; }

 private:
  std::string bytes_;
};

struct ZipEntry {
  std::string name;
  std::string bytes;
  bool compressed = false;
  bool encrypted = false;
};

// Writes a zip archive through libzip.
inline void write_zip(const std::string& path, const std::vector<ZipEntry>& entries) {
  int code = 0;
  zip_t* archive = zip_open(path.c_str(), ZIP_CREATE | ZIP_TRUNCATE, &code);
  if (archive == nullptr) throw std::runtime_error("cannot create " + path);
  for (const ZipEntry& entry : entries) {
    zip_source_t* source = zip_source_buffer(archive, entry.bytes.data(), entry.bytes.size(), 0);
    const auto index = static_cast<zip_uint64_t>(
        zip_file_add(archive, entry.name.c_str(), source, ZIP_FL_ENC_UTF_8));
    zip_set_file_compression(archive, index, entry.compressed ? ZIP_CM_DEFLATE : ZIP_CM_STORE, 0);
    if (entry.encrypted) zip_file_set_encryption(archive, index, ZIP_EM_AES_256, "secret");
  }
  if (zip_close(archive) != 0) throw std::runtime_error("cannot write " + path);
}

// A checkpoint with this pickle and the storages given as key and bytes.
inline void write_pth(const std::string& path, const std::string& pickle,
                      const std::vector<std::pair<std::string, std::string>>& storages) {
  std::vector<ZipEntry> entries{{"archive/data.pkl", pickle}};
  for (const auto& [key, bytes] : storages) entries.push_back({"archive/data/" + key, bytes});
  entries.push_back({"archive/version", "3\n"});
  write_zip(path, entries);
}

}  // namespace lvggt::test
