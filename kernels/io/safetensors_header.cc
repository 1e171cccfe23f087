// SPDX-License-Identifier: Apache-2.0
#include "kernels/io/safetensors_header.h"

#include <algorithm>
#include <numeric>
#include <optional>

#include "kernels/io/json_events.h"
#include "kernels/io/printable.h"
#include "lvggt/core/error.h"
#include "lvggt/io/checked.h"

namespace lvggt {
namespace {

constexpr std::string_view kMetadataKey = "__metadata__";

std::optional<Dtype> parse_dtype(std::string_view name) {
  for (const Dtype dtype :
       {Dtype::kF32, Dtype::kF16, Dtype::kBF16, Dtype::kF64, Dtype::kI8, Dtype::kU8, Dtype::kI16,
        Dtype::kU16, Dtype::kI32, Dtype::kU32, Dtype::kI64, Dtype::kU64, Dtype::kBool})
    if (dtype_name(dtype) == name) return dtype;
  return std::nullopt;
}

// Receives the events of the header's JSON and builds the entries as they come: the memory it needs
// follows from the header's own length, never from a number in it.
class HeaderEvents : public JsonEvents {
 public:
  HeaderEvents(const std::string& path, const Limits& limits)
      : JsonEvents(path, limits.json_depth), limits_(limits) {}

  SafetensorsHeader take() && { return std::move(header_); }

 private:
  enum class Where { kStart, kTop, kMetadata, kEntry, kShape, kOffsets, kIgnored };
  enum Field { kNone = 0, kDtype = 1, kShapeField = 2, kOffsetsField = 4 };

  template <class... Args>
  [[noreturn]] void bad(const Args&... args) const {
    fail(ErrorKind::kFormat, source(), ": ", args...);
  }
  template <class... Args>
  [[noreturn]] void bad_entry(const Args&... args) const {
    bad("tensor ", in_quotes(key_), ": ", args...);
  }

  void on_object() override {
    switch (where_) {
      case Where::kStart:
        where_ = Where::kTop;
        return;
      case Where::kTop:
        where_ = key_ == kMetadataKey ? Where::kMetadata : Where::kEntry;
        if (where_ == Where::kEntry) begin_entry();
        return;
      default:
        on_composite("an object");
    }
  }

  void on_array() override {
    if (where_ == Where::kEntry && field_ == kShapeField) {
      where_ = Where::kShape;
    } else if (where_ == Where::kEntry && field_ == kOffsetsField) {
      where_ = Where::kOffsets;
      offsets_.clear();
    } else {
      on_composite("an array");
    }
  }

  // An object or array where a plain value belongs, or inside a field that is not ours.
  void on_composite(const char* what) {
    if (where_ == Where::kIgnored) {
      ++ignored_depth_;
    } else if (where_ == Where::kEntry && field_ == kNone) {
      where_ = Where::kIgnored;
      ignored_depth_ = 1;
    } else {
      on_wrong(what);
    }
  }

  void on_end() override {
    switch (where_) {
      case Where::kIgnored:
        if (--ignored_depth_ == 0) where_ = Where::kEntry;
        return;
      case Where::kShape:
      case Where::kOffsets:
        where_ = Where::kEntry;
        return;
      case Where::kEntry:
        end_entry();
        where_ = Where::kTop;
        return;
      default:
        where_ = Where::kTop;
        return;
    }
  }

  void on_key(std::string&& key) override {
    switch (where_) {
      case Where::kTop:
        on_name(std::move(key));
        return;
      case Where::kMetadata:
        metadata_key_ = std::move(key);
        if (header_.metadata.contains(metadata_key_))
          bad("__metadata__ has the key ", in_quotes(metadata_key_), " twice");
        return;
      case Where::kEntry:
        on_field(key);
        return;
      default:
        return;
    }
  }

  void on_name(std::string&& name) {
    key_ = std::move(name);
    if (key_ == kMetadataKey) {
      if (has_metadata_) bad("__metadata__ is there twice");
      has_metadata_ = true;
      return;
    }
    if (header_.entries.size() >= limits_.tensors)
      fail(ErrorKind::kLimit, source(), ": more than ", limits_.tensors, " tensors");
    const std::string fault = tensor_name_fault(key_, limits_);
    if (!fault.empty())
      fail(key_.size() > limits_.name_bytes ? ErrorKind::kLimit : ErrorKind::kFormat, source(),
           ": the name of tensor ", in_quotes(key_), " ", fault);
  }

  void on_field(std::string_view name) {
    field_ = name == "dtype"          ? kDtype
             : name == "shape"        ? kShapeField
             : name == "data_offsets" ? kOffsetsField
                                      : kNone;
    if ((fields_ & field_) != 0) bad_entry("the field ", name, " is there twice");
    fields_ |= field_;
  }

  void on_string(std::string&& text) override {
    if (where_ == Where::kMetadata) {
      header_.metadata.emplace(metadata_key_, std::move(text));
    } else if (where_ == Where::kEntry && field_ == kDtype) {
      const auto dtype = parse_dtype(text);
      if (!dtype)
        fail(ErrorKind::kUnsupported, source(), ": tensor ", in_quotes(key_),
             " has the element type ", in_quotes(text), ", which is not supported");
      header_.entries.back().dtype = *dtype;
    } else if (!ignored()) {
      on_wrong("a string");
    }
  }

  void on_integer(std::int64_t value) override {
    if (where_ == Where::kShape) {
      auto& shape = header_.entries.back().shape;
      if (shape.size() >= limits_.rank)
        fail(ErrorKind::kLimit, source(), ": tensor ", in_quotes(key_), " has more than ",
             limits_.rank, " dimensions");
      shape.push_back(value);
    } else if (where_ == Where::kOffsets) {
      if (offsets_.size() == 2) bad_entry("data_offsets has more than two numbers");
      offsets_.push_back(value);
    } else if (!ignored()) {
      on_wrong("a number");
    }
  }

  // null, true, a fraction, a negative number, ...
  void on_other(std::string_view what) override {
    if (!ignored()) on_wrong(what);
  }

  bool ignored() const {
    return where_ == Where::kIgnored || (where_ == Where::kEntry && field_ == kNone);
  }

  [[noreturn]] void on_wrong(std::string_view what) const {
    switch (where_) {
      case Where::kStart:
        bad("the header is ", what, " where an object is needed");
      case Where::kTop:
        if (key_ == kMetadataKey) bad("__metadata__ is ", what, " where an object is needed");
        bad_entry("the entry is ", what, " where an object is needed");
      case Where::kMetadata:
        bad("__metadata__: the value of ", in_quotes(metadata_key_), " is ", what,
            ", not a string");
      case Where::kShape:
        bad_entry("a dimension is ", what, ", not a whole number from 0 to 2^63-1");
      case Where::kOffsets:
        bad_entry("a data offset is ", what, ", not a whole number from 0 to 2^63-1");
      default:
        break;
    }
    bad_entry("the field ",
              field_ == kDtype        ? "dtype"
              : field_ == kShapeField ? "shape"
                                      : "data_offsets",
              " is ", what, field_ == kDtype ? ", not a string" : ", not an array of numbers");
  }

  void begin_entry() {
    header_.entries.emplace_back().name = key_;
    fields_ = 0;
    field_ = kNone;
  }

  void end_entry() {
    if ((fields_ & kDtype) == 0) bad_entry("the field dtype is missing");
    if ((fields_ & kShapeField) == 0) bad_entry("the field shape is missing");
    if ((fields_ & kOffsetsField) == 0) bad_entry("the field data_offsets is missing");
    TensorEntry& entry = header_.entries.back();
    if (offsets_.size() != 2) bad_entry("data_offsets needs two numbers, it has ", offsets_.size());
    if (offsets_[1] < offsets_[0])
      bad_entry("data_offsets end at ", offsets_[1], ", before their begin ", offsets_[0]);
    const auto volume = checked_volume(entry.shape);
    const auto bytes = volume ? checked_mul(*volume, dtype_size(entry.dtype)) : std::nullopt;
    if (!bytes) bad_entry("the shape ", shape_text(entry.shape), " has too many elements to exist");
    entry.offset = offsets_[0];
    entry.num_bytes = offsets_[1] - offsets_[0];
    if (entry.num_bytes != *bytes)
      bad_entry("data_offsets span ", entry.num_bytes, " bytes, but shape ",
                shape_text(entry.shape), " of ", dtype_name(entry.dtype), " needs ", *bytes);
  }

  const Limits& limits_;
  SafetensorsHeader header_;
  Where where_ = Where::kStart;
  std::string key_;  // of the entry being read
  std::string metadata_key_;
  bool has_metadata_ = false;
  unsigned fields_ = 0;  // of the entry, seen so far
  Field field_ = kNone;
  std::vector<std::int64_t> offsets_;
  std::size_t ignored_depth_ = 0;
};

void check_names(const std::vector<TensorEntry>& entries, const std::string& path) {
  std::vector<std::uint32_t> order(entries.size());
  std::iota(order.begin(), order.end(), 0u);
  std::sort(order.begin(), order.end(),
            [&](std::uint32_t a, std::uint32_t b) { return entries[a].name < entries[b].name; });
  for (std::size_t i = 1; i < order.size(); ++i)
    if (entries[order[i - 1]].name == entries[order[i]].name)
      fail(ErrorKind::kFormat, path, ": tensor ", in_quotes(entries[order[i]].name),
           " is there twice");
}

// Every byte after the header belongs to exactly one tensor.
void check_layout(const std::vector<TensorEntry>& entries, std::int64_t data_bytes,
                  const std::string& path) {
  std::vector<std::uint32_t> order(entries.size());
  std::iota(order.begin(), order.end(), 0u);
  std::sort(order.begin(), order.end(), [&](std::uint32_t a, std::uint32_t b) {
    const TensorEntry &x = entries[a], &y = entries[b];
    return x.offset != y.offset ? x.offset < y.offset : x.num_bytes < y.num_bytes;
  });
  std::int64_t end = 0;
  for (const std::uint32_t i : order) {
    const TensorEntry& entry = entries[i];
    // Both terms are at most 2^63-1 and non-negative: the parser saw them as begin <= end.
    const std::int64_t entry_end = entry.offset + entry.num_bytes;
    if (entry.offset > end)
      fail(ErrorKind::kFormat, path, ": bytes ", end, " to ", entry.offset,
           " of the data, before tensor ", in_quotes(entry.name), ", belong to no tensor");
    if (entry.offset < end)
      fail(ErrorKind::kFormat, path, ": tensor ", in_quotes(entry.name), " starts at byte ",
           entry.offset, " of the data, inside another tensor that ends at ", end);
    if (entry_end > data_bytes)
      fail(ErrorKind::kFormat, path, ": tensor ", in_quotes(entry.name), " ends at byte ",
           entry_end, " of the data, but the file has only ", data_bytes,
           "; it may be an incomplete download");
    end = entry_end;
  }
  if (end != data_bytes)
    fail(ErrorKind::kFormat, path, ": ", data_bytes - end,
         " bytes after the last tensor belong to none");
}

}  // namespace

std::string tensor_name_fault(std::string_view name, const Limits& limits) {
  if (name.size() > limits.name_bytes)
    return concat("has ", name.size(), " bytes, more than the limit of ", limits.name_bytes);
  const bool control = std::any_of(name.begin(), name.end(), [](char c) {
    return static_cast<unsigned char>(c) < 0x20 || c == 0x7f;
  });
  if (control) return "contains a control character";
  for (std::size_t begin = 0; begin <= name.size();) {
    const std::size_t end = std::min(name.find_first_of("/\\", begin), name.size());
    if (name.substr(begin, end - begin) == "..") return "contains '..' as a folder";
    begin = end + 1;
  }
  return {};
}

SafetensorsHeader parse_safetensors_header(std::string_view json, std::int64_t data_bytes,
                                           const std::string& path, const Limits& limits) {
  HeaderEvents events(path, limits);
  parse_json_events(json, events, "the header");
  SafetensorsHeader header = std::move(events).take();
  check_names(header.entries, path);
  check_layout(header.entries, data_bytes, path);
  return header;
}

}  // namespace lvggt
