// SPDX-License-Identifier: Apache-2.0
#include "kernels/io/safetensors_index.h"

#include <algorithm>
#include <charconv>
#include <filesystem>
#include <optional>

#include "kernels/io/json_events.h"
#include "kernels/io/printable.h"
#include "lvggt/core/error.h"

namespace lvggt {
namespace {

// Collects the strings of "weight_map" and skips everything else.
class IndexEvents : public JsonEvents {
 public:
  IndexEvents(const std::string& path, const Limits& limits)
      : JsonEvents(path, limits.json_depth), limits_(limits) {}

  std::map<std::string, std::string> take() && {
    if (!has_map_) bad("there is no weight_map");
    if (files_.empty()) bad("weight_map is empty");
    return std::move(files_);
  }

 private:
  template <class... Args>
  [[noreturn]] void bad(const Args&... args) const {
    fail(ErrorKind::kFormat, source(), ": ", args...);
  }

  bool in_map() const { return depth_ == 2 && in_weight_map_; }

  void on_object() override {
    value("an object", depth_ == 0 || (depth_ == 1 && in_weight_map_));
    ++depth_;
  }
  void on_array() override {
    value("an array", false);
    ++depth_;
  }
  void on_end() override { --depth_; }
  void on_key(std::string&& key) override {
    if (depth_ == 1) {
      in_weight_map_ = key == "weight_map";
      if (in_weight_map_ && has_map_) bad("weight_map is there twice");
      has_map_ = has_map_ || in_weight_map_;
    } else if (in_map()) {
      if (files_.contains(key)) bad("weight_map lists tensor ", in_quotes(key), " twice");
      if (files_.size() >= limits_.tensors)
        fail(ErrorKind::kLimit, source(), ": more than ", limits_.tensors, " tensors");
      name_ = std::move(key);
    }
  }
  void on_string(std::string&& text) override {
    if (in_map()) {
      files_.emplace(std::move(name_), std::move(text));
    } else {
      value("a string", false);
    }
  }
  void on_integer(std::int64_t) override { value("a number", false); }
  void on_other(std::string_view what) override { value(what, false); }

  // Refuses a value where another kind belongs; outside of weight_map anything goes.
  void value(std::string_view what, bool expected) const {
    if (expected) return;
    if (depth_ == 0) bad("the index is ", what, " where an object is needed");
    if (depth_ == 1 && in_weight_map_) bad("weight_map is ", what, " where an object is needed");
    if (in_map())
      bad("weight_map: the file of tensor ", in_quotes(name_), " is ", what, ", not a string");
  }

  const Limits& limits_;
  std::size_t depth_ = 0;
  bool has_map_ = false;
  bool in_weight_map_ = false;
  std::string name_;
  std::map<std::string, std::string> files_;  // tensor -> file name
};

// N of "...-00001-of-0000N.safetensors".
std::optional<std::size_t> announced_shards(std::string_view name) {
  const std::size_t of = name.rfind("-of-");
  if (of == std::string_view::npos) return std::nullopt;
  const std::string_view digits = name.substr(of + 4);
  std::size_t count = 0;
  const auto [end, error] = std::from_chars(digits.data(), digits.data() + digits.size(), count);
  if (error != std::errc() ||
      std::string_view(end, digits.data() + digits.size()) != ".safetensors")
    return std::nullopt;
  return count;
}

void check_shard_name(const std::string& name, const std::string& path) {
  const bool plain = !name.empty() && name != "." && name != ".." &&
                     name.find_first_of(std::string_view("/\\\0", 3)) == std::string::npos;
  if (!plain)
    fail(ErrorKind::kFormat, path, ": weight_map names ", in_quotes(name),
         ", but a shard must be a file in the same folder, given without one");
}

}  // namespace

SafetensorsIndex read_safetensors_index(const std::string& path, const Limits& limits) {
  IndexEvents events(path, limits);
  parse_json_events(read_text_file(path, limits.header_bytes), events, "the index");
  const std::map<std::string, std::string> files = std::move(events).take();

  SafetensorsIndex index;
  index.path = path;
  std::vector<std::string> names;
  for (const auto& [tensor, name] : files) names.push_back(name);
  std::sort(names.begin(), names.end());
  names.erase(std::unique(names.begin(), names.end()), names.end());
  for (const std::string& name : names) {
    check_shard_name(name, path);
    const auto announced = announced_shards(name);
    if (announced && *announced != names.size())
      fail(ErrorKind::kFormat, path, ": ", in_quotes(name), " is one of ", *announced,
           " files by its name, but weight_map lists ", names.size());
    index.shards.push_back((std::filesystem::path(path).parent_path() / name).string());
  }
  for (const auto& [tensor, name] : files)
    index.shard_of.emplace(
        tensor, static_cast<std::size_t>(std::lower_bound(names.begin(), names.end(), name) -
                                         names.begin()));
  return index;
}

void check_safetensors_index(const SafetensorsIndex& index, std::span<const TensorEntry> entries,
                             std::span<const InputFile> files) {
  for (std::size_t i = 0; i < files.size(); ++i)
    for (std::size_t j = 0; j < i; ++j)
      if (files[i].identity() == files[j].identity())
        fail(ErrorKind::kFormat, index.path, ": ", files[j].path(), " and ", files[i].path(),
             " are one file under two names");
  for (const TensorEntry& entry : entries) {
    const auto it = index.shard_of.find(entry.name);
    const std::string& holder = files[entry.file_idx].path();
    if (it == index.shard_of.end())
      fail(ErrorKind::kFormat, holder, ": tensor ", in_quotes(entry.name), " is not listed in ",
           index.path);
    if (it->second != entry.file_idx)
      fail(ErrorKind::kFormat, holder, ": tensor ", in_quotes(entry.name), " is in this file, but ",
           index.path, " says that it is in ", files[it->second].path());
  }
  // Names are unique within a file and each was found in its own, so equal counts mean equal sets.
  if (entries.size() == index.shard_of.size()) return;
  for (const auto& [tensor, shard] : index.shard_of) {
    const bool there =
        std::any_of(entries.begin(), entries.end(),
                    [&name = tensor](const TensorEntry& e) { return e.name == name; });
    if (!there)
      fail(ErrorKind::kFormat, files[shard].path(), ": tensor ", in_quotes(tensor),
           " is missing, but ", index.path, " says that it is in this file");
  }
}

}  // namespace lvggt
