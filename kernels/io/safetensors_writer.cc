// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <nlohmann/json.hpp>

#include "kernels/io/printable.h"
#include "kernels/io/safetensors_header.h"
#include "lvggt/io/checked.h"
#include "lvggt/io/safetensors.h"

namespace lvggt {
namespace {

// The data starts on a multiple of this, so that aligned tensors stay aligned when the file is
// mapped.
constexpr std::size_t kDataAlignment = 64;

// Elements converted at a time.
constexpr std::size_t kBlockElements = std::size_t{1} << 16;

// JSON string literal; text that is not UTF-8 is an error of the caller.
std::string json_string(const std::string& text, const std::string& path) {
  try {
    return nlohmann::json(text).dump();
  } catch (const nlohmann::json::exception&) {
    fail(ErrorKind::kWrite, "cannot write ", path, ": ", in_quotes(text), " is not UTF-8");
  }
}

}  // namespace

SafetensorsWriter::SafetensorsWriter(const std::string& path) : file_(path) {}

void SafetensorsWriter::set_metadata(const std::string& key, const std::string& value) {
  LVGGT_CHECK(!header_written_, "safetensors: metadata set after the first write to ",
              file_.path());
  metadata_[key] = value;
}

void SafetensorsWriter::declare(const std::string& name, Dtype dtype,
                                std::vector<std::int64_t> shape) {
  LVGGT_CHECK(!header_written_, "safetensors: ", in_quotes(name),
              " declared after the first write to ", file_.path());
  const std::string fault = tensor_name_fault(name, {});
  LVGGT_CHECK(fault.empty(), "safetensors: the name of tensor ", in_quotes(name), " ", fault);
  const auto volume = checked_volume(shape);
  const auto bytes = volume ? checked_mul(*volume, dtype_size(dtype)) : std::nullopt;
  LVGGT_CHECK(bytes && shape.size() <= Limits{}.rank, "safetensors: ", in_quotes(name),
              " cannot have the shape ", shape_text(shape));
  LVGGT_CHECK(by_name_.emplace(name, tensors_.size()).second, "safetensors: ", in_quotes(name),
              " declared twice for ", file_.path());
  std::int64_t offset = 0;
  if (!tensors_.empty()) {
    const auto end = checked_add(tensors_.back().entry.offset, tensors_.back().entry.num_bytes);
    LVGGT_CHECK(end, "safetensors: the tensors of ", file_.path(), " are too large together");
    offset = *end;
  }
  tensors_.push_back({TensorEntry{name, dtype, std::move(shape), 0, offset, *bytes}, {}});
}

void SafetensorsWriter::keep(std::span<const std::byte> bytes) {
  tensors_.back().kept.assign(bytes.begin(), bytes.end());
}

void SafetensorsWriter::add(const std::string& name, std::vector<std::int64_t> shape,
                            std::span<const float> values) {
  const auto volume = checked_volume(shape);
  LVGGT_CHECK(volume == static_cast<std::int64_t>(values.size()), "safetensors: ", in_quotes(name),
              " has shape ", shape_text(shape), " but ", values.size(), " values");
  declare(name, Dtype::kF32, std::move(shape));
  keep(std::as_bytes(values));
}

void SafetensorsWriter::add_int64(const std::string& name, std::vector<std::int64_t> shape,
                                  std::span<const std::int64_t> values) {
  const auto volume = checked_volume(shape);
  LVGGT_CHECK(volume == static_cast<std::int64_t>(values.size()), "safetensors: ", in_quotes(name),
              " has shape ", shape_text(shape), " but ", values.size(), " values");
  declare(name, Dtype::kI64, std::move(shape));
  keep(std::as_bytes(values));
}

void SafetensorsWriter::write_header() {
  std::string json = "{";
  const char* separator = "";
  if (!metadata_.empty()) {
    json += "\"__metadata__\":{";
    for (const auto& [key, value] : metadata_) {
      json += separator + json_string(key, file_.path()) + ":" + json_string(value, file_.path());
      separator = ",";
    }
    json += "}";
  }
  for (const Pending& tensor : tensors_) {
    const TensorEntry& entry = tensor.entry;
    json +=
        separator + json_string(entry.name, file_.path()) +
        concat(":{\"dtype\":\"", dtype_name(entry.dtype), "\",\"shape\":", shape_text(entry.shape),
               ",\"data_offsets\":[", entry.offset, ",", entry.offset + entry.num_bytes, "]}");
    separator = ",";
  }
  json += "}";
  const std::size_t length_bytes = sizeof(std::uint64_t);
  const std::size_t total = length_bytes + json.size();
  json.append((kDataAlignment - total % kDataAlignment) % kDataAlignment, ' ');
  if (json.size() > Limits{}.header_bytes)
    fail(ErrorKind::kLimit, "cannot write ", file_.path(), ": its header would have ", json.size(),
         " bytes, more than the format's limit of ", Limits{}.header_bytes);
  const std::uint64_t length = json.size();
  file_.write(&length, sizeof(length));
  file_.write(json);
  header_written_ = true;
  skip_complete();
}

// Moves on past tensors that have all their bytes, writing those that add() kept.
void SafetensorsWriter::skip_complete() {
  while (current_ < tensors_.size()) {
    Pending& tensor = tensors_[current_];
    if (current_bytes_ == 0 && !tensor.kept.empty()) {
      file_.write(tensor.kept.data(), tensor.kept.size());
      current_bytes_ = tensor.entry.num_bytes;
      tensor.kept = {};
    }
    if (current_bytes_ < tensor.entry.num_bytes) return;
    ++current_;
    current_bytes_ = 0;
  }
}

SafetensorsWriter::Pending& SafetensorsWriter::current(std::string_view name) {
  if (!header_written_) write_header();
  const auto it = by_name_.find(name);
  LVGGT_CHECK(it != by_name_.end(), "safetensors: ", in_quotes(name), " was not declared for ",
              file_.path());
  LVGGT_CHECK(it->second == current_, "safetensors: ", in_quotes(name),
              " written out of turn; next is ",
              current_ < tensors_.size() ? in_quotes(tensors_[current_].entry.name) : "finish()");
  return tensors_[current_];
}

void SafetensorsWriter::append(std::string_view name, std::span<const std::byte> bytes) {
  const Pending& tensor = current(name);
  const auto size = static_cast<std::int64_t>(bytes.size());
  LVGGT_CHECK(size <= tensor.entry.num_bytes - current_bytes_, "safetensors: ", in_quotes(name),
              " needs ", tensor.entry.num_bytes, " bytes, but more were written");
  file_.write(bytes.data(), bytes.size());
  current_bytes_ += size;
}

void SafetensorsWriter::write(std::string_view name, std::span<const std::byte> bytes) {
  if (bytes.empty() && by_name_.contains(name)) return;  // whole tensors may be empty, and parts
  append(name, bytes);
  skip_complete();
}

void SafetensorsWriter::write(std::string_view name, std::span<const float> values) {
  if (values.empty() && by_name_.contains(name)) return;
  const Dtype dtype = current(name).entry.dtype;
  std::vector<std::byte> block;
  for (std::size_t first = 0; first < values.size(); first += kBlockElements) {
    const auto part = values.subspan(first, std::min(kBlockElements, values.size() - first));
    if (dtype == Dtype::kF32) {
      append(name, std::as_bytes(part));
      continue;
    }
    block.resize(static_cast<std::size_t>(
        size_product(static_cast<std::int64_t>(part.size()), dtype_size(dtype))));
    from_float32(dtype, part, block);
    append(name, block);
  }
  skip_complete();
}

void SafetensorsWriter::finish() {
  if (!header_written_) write_header();
  LVGGT_CHECK(current_ == tensors_.size(), "safetensors: ", file_.path(),
              " is finished, but tensor ", in_quotes(tensors_[current_].entry.name), " has only ",
              current_bytes_, " of ", tensors_[current_].entry.num_bytes, " bytes");
  file_.commit();
}

}  // namespace lvggt
