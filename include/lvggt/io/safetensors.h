// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <map>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/dtype.h"
#include "lvggt/io/input_file.h"
#include "lvggt/io/limits.h"

namespace lvggt {

// One tensor of a safetensors file.
struct TensorEntry {
  std::string name;
  Dtype dtype = Dtype::kF32;
  std::vector<std::int64_t> shape;  // empty for a scalar
  std::size_t file_idx = 0;         // which of the files
  std::int64_t offset = 0;          // of the first byte, in that file
  std::int64_t num_bytes = 0;

  std::int64_t size() const { return num_bytes / dtype_size(dtype); }  // elements
};

// "[2,3]", for messages.
std::string shape_text(std::span<const std::int64_t> shape);

// The tensors of a .safetensors file, or of a model in several such files (shards) listed by an
// index. open() checks the whole structure against the format and the size of the file before
// anything sized by it is allocated; tensors are read on demand with bulk reads straight into the
// caller's memory, and nothing is mapped (see InputFile), so memory holds only what was asked for.
// Reads may come from several threads.
//
// Errors: kRead (missing, not a regular file, changed since opening), kFormat (breaks the format;
// the message says where and what the file looks like instead), kUnsupported (an element type lvggt
// does not handle), kLimit (beyond Limits), kMismatch (asked for a tensor, rank or size the file
// does not have).
class Safetensors {
 public:
  // `path` is a .safetensors file, an index (*.index.json), or a folder that holds
  // model.safetensors.index.json or exactly one .safetensors file.
  static Safetensors open(const std::string& path, const Limits& limits = {});

  // The path that open() was given.
  const std::string& path() const { return path_; }

  // The .safetensors files the tensors are in, one unless the model is sharded.
  std::vector<std::string> files() const;

  // In the order of the headers.
  const std::vector<TensorEntry>& entries() const { return entries_; }

  // The entry of that name, or null.
  const TensorEntry* find(std::string_view name) const;

  // The entry of that name; a kMismatch Error when there is none.
  const TensorEntry& at(std::string_view name) const;

  // __metadata__; of all shards together, where the first one wins.
  const std::map<std::string, std::string>& metadata() const { return metadata_; }

  // A floating-point tensor as float32; its rank must be R.
  template <int R>
  Tensor<float, R> read(std::string_view name) const {
    const TensorEntry& entry = at(name);
    check_rank(entry, R);
    Shape<R> shape;
    for (int axis = 0; axis < R; ++axis) shape[axis] = entry.shape[static_cast<std::size_t>(axis)];
    Tensor<float, R> values(shape);
    read_into(name, std::span<float>(values.data(), static_cast<std::size_t>(values.size())));
    return values;
  }

  // A floating-point tensor of any rank as float32, row-major; out.size() must be its number of
  // elements.
  void read_into(std::string_view name, std::span<float> out) const;

  // The same for elements [first, first + out.size()) only.
  void read_part(std::string_view name, std::int64_t first, std::span<float> out) const;

  // A tensor of integers or booleans. U64 values above 2^63 - 1 are a kUnsupported Error.
  std::vector<std::int64_t> read_int64(std::string_view name) const;

  // The stored bytes; out.size() must be num_bytes of the entry.
  void read_bytes(const TensorEntry& entry, std::span<std::byte> out) const;

 private:
  Safetensors() = default;
  void add_file(const std::string& path, const Limits& limits);
  void sort_names();
  void check_rank(const TensorEntry& entry, int rank) const;

  std::string path_;
  std::vector<InputFile> files_;
  std::vector<TensorEntry> entries_;
  std::vector<std::uint32_t> by_name_;  // indices of entries_, sorted by name
  std::map<std::string, std::string> metadata_;
};

// Writes a .safetensors file that appears under its name only at finish(). Tensors are laid out in
// the order of the declare() and add() calls; the header needs all of them, so declare everything,
// then write.
//
//   SafetensorsWriter out("model.safetensors");
//   out.declare("a", Dtype::kF32, {1024, 1024});
//   out.write("a", values);           // may be called repeatedly to append parts
//   out.finish();
class SafetensorsWriter {
 public:
  explicit SafetensorsWriter(const std::string& path);

  // Before the first write().
  void set_metadata(const std::string& key, const std::string& value);
  void declare(const std::string& name, Dtype dtype, std::vector<std::int64_t> shape);

  // Declares a float32 tensor and keeps a copy of its values until finish(): for small files.
  template <int R>
  void add(const std::string& name, View<const float, R> values) {
    LVGGT_CHECK(values.dense(), "safetensors: ", name, " has gaps between its rows");
    const auto& extents = values.shape().extents;
    declare(name, Dtype::kF32, {extents.begin(), extents.end()});
    keep(std::as_bytes(
        std::span<const float>(values.data(), static_cast<std::size_t>(values.size()))));
  }
  template <int R>
  void add(const std::string& name, const Tensor<float, R>& values) {
    add(name, values.view());
  }
  void add(const std::string& name, std::vector<std::int64_t> shape, std::span<const float> values);
  void add_int64(const std::string& name, std::vector<std::int64_t> shape,
                 std::span<const std::int64_t> values);

  // Appends stored bytes to the declared tensor `name`: the one after the last complete one.
  void write(std::string_view name, std::span<const std::byte> bytes);

  // The same from float32, rounded to the declared type (F32, F16, BF16 or F64).
  void write(std::string_view name, std::span<const float> values);

  // Completes the file. Every declared tensor must have been written in full.
  void finish();

 private:
  struct Pending {
    TensorEntry entry;
    std::vector<std::byte> kept;  // values given to add()
  };
  void keep(std::span<const std::byte> bytes);
  void write_header();
  void skip_complete();
  void append(std::string_view name, std::span<const std::byte> bytes);
  Pending& current(std::string_view name);

  AtomicFile file_;
  std::map<std::string, std::string> metadata_;
  std::vector<Pending> tensors_;
  std::map<std::string, std::size_t, std::less<>> by_name_;
  bool header_written_ = false;
  std::size_t current_ = 0;         // tensor being written
  std::int64_t current_bytes_ = 0;  // of it, so far
};

}  // namespace lvggt
