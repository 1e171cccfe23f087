// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/safetensors.h"

#include <algorithm>
#include <array>
#include <cstring>
#include <filesystem>
#include <numeric>

#include "kernels/io/printable.h"
#include "kernels/io/safetensors_header.h"
#include "kernels/io/safetensors_index.h"
#include "lvggt/io/checked.h"

namespace lvggt {
namespace {

namespace fs = std::filesystem;

constexpr std::string_view kIndexName = "model.safetensors.index.json";
constexpr std::string_view kIndexSuffix = ".index.json";
constexpr std::int64_t kLengthBytes = 8;  // the header's length comes first

// Elements converted at a time: small enough for the cache, large enough to make the system calls
// vanish.
constexpr std::int64_t kBlockElements = 1 << 16;

// The first bytes, for a hint at what the file is.
std::string head_of(const InputFile& file) {
  std::array<char, 512> head;
  const auto num_bytes = static_cast<std::size_t>(std::min<std::int64_t>(file.size(), head.size()));
  file.read_at(0, head.data(), num_bytes);
  return {head.data(), num_bytes};
}

template <class... Args>
[[noreturn]] void fail_format(const InputFile& file, const Args&... args) {
  const std::string hint = content_hint(head_of(file));
  fail(ErrorKind::kFormat, file.path(), " is not a safetensors file: ", args...,
       hint.empty() ? "" : "; ", hint);
}

// Reads and checks the length field; returns the header's length.
std::int64_t read_header_length(const InputFile& file, const Limits& limits) {
  if (file.size() == 0)
    fail(ErrorKind::kFormat, file.path(), " is not a safetensors file: it is empty");
  if (file.size() < kLengthBytes)
    fail_format(file, "it has only ", file.size(), " bytes, fewer than the ", kLengthBytes,
                " of the header length");
  std::uint64_t length;
  file.read_at(0, &length, sizeof(length));
  const auto rest = static_cast<std::uint64_t>(file.size() - kLengthBytes);
  if (length > rest)
    fail_format(file, "the header length at byte 0 is ", length, ", but only ", rest,
                " bytes follow");
  if (length > limits.header_bytes)
    fail(ErrorKind::kLimit, file.path(), ": the header length at byte 0 is ", length,
         ", above the limit of ", limits.header_bytes);
  if (length < 2)
    fail_format(file, "the header length at byte 0 is ", length, ", too short for JSON");
  return static_cast<std::int64_t>(length);
}

SafetensorsHeader read_header(const InputFile& file, const Limits& limits) {
  const std::int64_t length = read_header_length(file, limits);
  std::string json(static_cast<std::size_t>(length), '\0');
  file.read_at(kLengthBytes, json.data(), json.size());
  // The header of a file of another kind is rarely even the start of an object.
  const std::size_t first = json.find_first_not_of(" \t\r\n");
  if (first == std::string::npos) fail_format(file, "the header is blank");
  const std::int64_t data_begin = kLengthBytes + length;
  SafetensorsHeader header =
      parse_safetensors_header(json, file.size() - data_begin, file.path(), limits);
  for (TensorEntry& entry : header.entries) entry.offset += data_begin;
  return header;
}

// Reads elements of type T from `offset` block by block and hands each block on.
template <class T, class Body>
void for_each_block(const InputFile& file, std::int64_t offset, std::int64_t count, Body&& body) {
  std::vector<T> block(static_cast<std::size_t>(std::min(count, kBlockElements)));
  for (std::int64_t done = 0; done < count;) {
    const std::int64_t n = std::min(count - done, kBlockElements);
    const auto num_bytes = static_cast<std::size_t>(size_product(n, sizeof(T)));
    file.read_at(offset, block.data(), num_bytes);
    body(std::span<const T>(block.data(), static_cast<std::size_t>(n)), done);
    offset += static_cast<std::int64_t>(num_bytes);
    done += n;
  }
}

void read_widened(const InputFile& file, Dtype dtype, std::int64_t offset, std::span<float> out) {
  const auto num_bytes = [&](std::size_t n) {
    return static_cast<std::size_t>(size_product(static_cast<std::int64_t>(n), dtype_size(dtype)));
  };
  std::vector<std::byte> block(num_bytes(std::min<std::size_t>(out.size(), kBlockElements)));
  while (!out.empty()) {
    const auto part = out.first(std::min<std::size_t>(out.size(), kBlockElements));
    const auto bytes = std::span(block).first(num_bytes(part.size()));
    file.read_at(offset, bytes.data(), bytes.size());
    to_float32(dtype, bytes, part);
    offset += static_cast<std::int64_t>(bytes.size());
    out = out.subspan(part.size());
  }
}

template <class T>
std::vector<std::int64_t> read_integers(const InputFile& file, const TensorEntry& entry) {
  std::vector<std::int64_t> out(static_cast<std::size_t>(entry.size()));
  for_each_block<T>(
      file, entry.offset, entry.size(), [&](std::span<const T> block, std::int64_t first) {
        for (std::size_t i = 0; i < block.size(); ++i) {
          if (!std::in_range<std::int64_t>(block[i]))
            fail(ErrorKind::kUnsupported, file.path(), ": tensor ", in_quotes(entry.name),
                 " holds ", block[i], " at element ", first + static_cast<std::int64_t>(i),
                 ", which does not fit 63 bits");
          out[static_cast<std::size_t>(first) + i] = static_cast<std::int64_t>(block[i]);
        }
      });
  return out;
}

std::string find_in_folder(const std::string& folder) {
  const fs::path index = fs::path(folder) / kIndexName;
  std::error_code error;
  if (fs::exists(index, error)) return index.string();
  std::vector<std::string> found;
  for (fs::directory_iterator it(folder, error), end; !error && it != end; it.increment(error))
    if (it->path().extension() == ".safetensors") found.push_back(it->path().string());
  if (error) fail(ErrorKind::kRead, "cannot read the folder ", folder, ": ", error.message());
  if (found.size() != 1)
    fail(ErrorKind::kRead, folder, " is a directory with ", found.size(),
         " .safetensors files and no ", kIndexName, "; name the file instead");
  return found.front();
}

}  // namespace

std::string shape_text(std::span<const std::int64_t> shape) {
  std::string text = "[";
  for (std::size_t axis = 0; axis < shape.size(); ++axis)
    text += (axis == 0 ? "" : ",") + std::to_string(shape[axis]);
  return text + "]";
}

Safetensors Safetensors::open(const std::string& path, const Limits& limits) {
  std::error_code error;
  const std::string file = fs::is_directory(path, error) ? find_in_folder(path) : path;
  Safetensors result;
  result.path_ = path;
  if (file.ends_with(kIndexSuffix)) {
    const SafetensorsIndex index = read_safetensors_index(file, limits);
    for (const std::string& shard : index.shards) result.add_file(shard, limits);
    check_safetensors_index(index, result.entries_, result.files_);
  } else {
    result.add_file(file, limits);
  }
  result.sort_names();
  return result;
}

void Safetensors::add_file(const std::string& path, const Limits& limits) {
  const std::size_t file_idx = files_.size();
  files_.emplace_back(path);
  SafetensorsHeader header = read_header(files_.back(), limits);
  if (header.entries.size() > limits.tensors - entries_.size())
    fail(ErrorKind::kLimit, path_, ": more than ", limits.tensors, " tensors in all shards");
  for (TensorEntry& entry : header.entries) entry.file_idx = file_idx;
  if (entries_.empty()) {
    entries_ = std::move(header.entries);
  } else {
    std::move(header.entries.begin(), header.entries.end(), std::back_inserter(entries_));
  }
  metadata_.merge(header.metadata);
}

void Safetensors::sort_names() {
  by_name_.resize(entries_.size());
  std::iota(by_name_.begin(), by_name_.end(), 0u);
  std::sort(by_name_.begin(), by_name_.end(),
            [&](std::uint32_t a, std::uint32_t b) { return entries_[a].name < entries_[b].name; });
}

std::vector<std::string> Safetensors::files() const {
  std::vector<std::string> paths;
  for (const InputFile& file : files_) paths.push_back(file.path());
  return paths;
}

const TensorEntry* Safetensors::find(std::string_view name) const {
  const auto it = std::lower_bound(
      by_name_.begin(), by_name_.end(), name,
      [&](std::uint32_t i, std::string_view wanted) { return entries_[i].name < wanted; });
  if (it == by_name_.end() || entries_[*it].name != name) return nullptr;
  return &entries_[*it];
}

const TensorEntry& Safetensors::at(std::string_view name) const {
  const TensorEntry* entry = find(name);
  LVGGT_CHECK(entry != nullptr, path_, " has no tensor ", in_quotes(name));
  return *entry;
}

void Safetensors::check_rank(const TensorEntry& entry, int rank) const {
  LVGGT_CHECK(entry.shape.size() == static_cast<std::size_t>(rank), path_, ": tensor ",
              in_quotes(entry.name), " has shape ", shape_text(entry.shape), ", but ", rank,
              " dimensions are expected");
}

void Safetensors::read_into(std::string_view name, std::span<float> out) const {
  const TensorEntry& entry = at(name);
  LVGGT_CHECK(static_cast<std::int64_t>(out.size()) == entry.size(), path_, ": tensor ",
              in_quotes(name), " has shape ", shape_text(entry.shape), ", but ", out.size(),
              " values are expected");
  read_part(name, 0, out);
}

void Safetensors::read_part(std::string_view name, std::int64_t first, std::span<float> out) const {
  const TensorEntry& entry = at(name);
  const auto count = static_cast<std::int64_t>(out.size());
  LVGGT_CHECK(first >= 0 && first <= entry.size() && count <= entry.size() - first, path_,
              ": tensor ", in_quotes(name), " has ", entry.size(), " elements, but ", count,
              " from ", first, " are asked for");
  const InputFile& file = files_[entry.file_idx];
  // In range, because the part lies inside the tensor and the tensor inside the file.
  const std::int64_t offset = entry.offset + size_product(first, dtype_size(entry.dtype));
  if (!dtype_is_float(entry.dtype))
    fail(ErrorKind::kMismatch, path_, ": tensor ", in_quotes(name), " holds ",
         dtype_name(entry.dtype), ", but floating-point numbers are expected");
  if (entry.dtype == Dtype::kF32) {
    file.read_at(offset, out.data(), out.size_bytes());
  } else {
    read_widened(file, entry.dtype, offset, out);
  }
  file.check_unchanged();
}

std::vector<std::int64_t> Safetensors::read_int64(std::string_view name) const {
  const TensorEntry& entry = at(name);
  const InputFile& file = files_[entry.file_idx];
  const auto read = [&] {
    switch (entry.dtype) {
      case Dtype::kI8:
        return read_integers<std::int8_t>(file, entry);
      case Dtype::kBool:
      case Dtype::kU8:
        return read_integers<std::uint8_t>(file, entry);
      case Dtype::kI16:
        return read_integers<std::int16_t>(file, entry);
      case Dtype::kU16:
        return read_integers<std::uint16_t>(file, entry);
      case Dtype::kI32:
        return read_integers<std::int32_t>(file, entry);
      case Dtype::kU32:
        return read_integers<std::uint32_t>(file, entry);
      case Dtype::kI64:
        return read_integers<std::int64_t>(file, entry);
      case Dtype::kU64:
        return read_integers<std::uint64_t>(file, entry);
      default:
        break;
    }
    fail(ErrorKind::kMismatch, path_, ": tensor ", in_quotes(name), " holds ",
         dtype_name(entry.dtype), ", but integers are expected");
  };
  std::vector<std::int64_t> values = read();
  file.check_unchanged();
  return values;
}

void Safetensors::read_bytes(const TensorEntry& entry, std::span<std::byte> out) const {
  LVGGT_CHECK(static_cast<std::int64_t>(out.size()) == entry.num_bytes, path_, ": tensor ",
              in_quotes(entry.name), " has ", entry.num_bytes, " bytes, but ", out.size(),
              " are expected");
  const InputFile& file = files_.at(entry.file_idx);
  file.read_at(entry.offset, out.data(), out.size());
  file.check_unchanged();
}

}  // namespace lvggt
