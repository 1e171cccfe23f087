// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/checkpoint.h"

#include <algorithm>
#include <array>
#include <charconv>
#include <filesystem>

#include "kernels/train/training_state.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/json.h"
#include "lvggt/io/json_writer.h"
#include "lvggt/io/safetensors.h"

namespace lvggt {
namespace {

namespace fs = std::filesystem;

constexpr std::string_view kPrefix = "step_", kEnding = ".safetensors", kMarkEnding = ".done";

// Nine digits, so that names sort as steps do.
std::string step_name(std::int64_t step) {
  const std::string digits = std::to_string(step);
  return std::string(kPrefix) + std::string(digits.size() < 9 ? 9 - digits.size() : 0, '0') +
         digits;
}

// The step in "step_000000120.safetensors", or nothing.
std::optional<std::int64_t> step_in(std::string_view name, std::string_view ending) {
  if (!name.starts_with(kPrefix) || !name.ends_with(ending)) return std::nullopt;
  name.remove_prefix(kPrefix.size());
  name.remove_suffix(ending.size());
  std::int64_t step = 0;
  const auto [end, error] = std::from_chars(name.data(), name.data() + name.size(), step);
  if (name.size() < 9 || error != std::errc() || end != name.data() + name.size() || step < 0)
    return std::nullopt;
  return step;
}

std::span<const std::byte> bytes_of(std::span<const float> values) { return std::as_bytes(values); }

// "0.1.0" as numbers; what is no number counts as 0.
std::array<int, 3> version_numbers(std::string_view text) {
  std::array<int, 3> numbers{};
  for (int& number : numbers) {
    const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), number);
    if (error != std::errc()) break;
    text.remove_prefix(static_cast<std::size_t>(end - text.data()));
    if (!text.starts_with('.')) break;
    text.remove_prefix(1);
  }
  return numbers;
}

std::string joined(const std::vector<std::string>& parts) {
  std::string text;
  for (const std::string& part : parts) text += (text.empty() ? "" : "; ") + part;
  return text;
}

// Opens a checkpoint and proves its header; kFormat when it is damaged.
Safetensors open_intact(const std::string& path) {
  // A flipped bit may also look like a type or a size that is not supported.
  Safetensors file = [&] {
    try {
      return Safetensors::open(path);
    } catch (const Error& error) {
      fail(ErrorKind::kFormat, error.what());
    }
  }();
  const auto sum = file.metadata().find(training::kHeaderSumKey);
  if (sum == file.metadata().end())
    fail(ErrorKind::kFormat, path, ": is not a training checkpoint: its metadata has no '",
         training::kHeaderSumKey, "'");
  if (sum->second != training::header_sum(file.entries(), file.metadata()))
    fail(ErrorKind::kFormat, path, ": its header does not match its checksum");
  return file;
}

// Every tensor that training wants must be there in its shape, and nothing else.
void check_tensors(const Safetensors& file, std::span<const TrainingTensor> tensors,
                   const std::string& path) {
  std::vector<std::string> faults;
  for (const TrainingTensor& tensor : tensors) {
    const TensorEntry* entry = file.find(tensor.name);
    if (entry == nullptr)
      faults.push_back(tensor.name + " is missing");
    else if (entry->shape != tensor.shape || entry->dtype != Dtype::kF32)
      faults.push_back(concat(tensor.name, " is ", shape_text(entry->shape), ", not ",
                              shape_text(tensor.shape)));
  }
  if (faults.empty() && file.entries().size() != tensors.size())
    faults.push_back(concat("it holds ", file.entries().size(), " tensors, not ", tensors.size()));
  if (faults.size() > 4) faults.resize(4);
  LVGGT_CHECK(faults.empty(), path, ": does not fit the training: ", joined(faults));
}

void read_tensors(const Safetensors& file, std::span<const TrainingTensor> tensors,
                  const std::string& path) {
  const auto text = file.metadata().find(training::kTensorSumsKey);
  if (text == file.metadata().end())
    fail(ErrorKind::kFormat, path, ": its metadata has no '", training::kTensorSumsKey, "'");
  const auto sums = training::parse_sums(text->second, path);
  for (const TrainingTensor& tensor : tensors) {
    file.read_into(tensor.name, tensor.values);
    const auto sum = sums.find(tensor.name);
    if (sum == sums.end() || sum->second != sha256(bytes_of(tensor.values)))
      fail(ErrorKind::kFormat, path, ": tensor ", tensor.name, " does not match its checksum");
  }
}

}  // namespace

TrainingCheckpoints::TrainingCheckpoints(Options options) : options_(std::move(options)) {
  LVGGT_CHECK(options_.keep >= 1, "checkpoints: at least one must be kept, not ", options_.keep);
  std::error_code error;
  fs::create_directory(options_.folder, error);
  if (error)
    fail(ErrorKind::kWrite, options_.folder, ": cannot create the folder: ", error.message());
}

std::string TrainingCheckpoints::path(std::int64_t step) const {
  return options_.folder + "/" + step_name(step) + std::string(kEnding);
}

std::string TrainingCheckpoints::mark_path(std::int64_t step) const {
  return options_.folder + "/" + step_name(step) + std::string(kMarkEnding);
}

std::vector<std::int64_t> TrainingCheckpoints::steps() const {
  std::vector<std::int64_t> steps;
  std::error_code error;
  fs::directory_iterator files(options_.folder, error);
  if (error) fail(ErrorKind::kRead, options_.folder, ": cannot be listed: ", error.message());
  for (const auto& file : files)
    if (const auto step = step_in(file.path().filename().string(), kEnding)) steps.push_back(*step);
  std::sort(steps.begin(), steps.end());
  return steps;
}

std::int64_t TrainingCheckpoints::file_bytes(std::span<const TrainingTensor> tensors) {
  // Beside its values a tensor costs an entry of the header and a checksum.
  constexpr std::size_t kEntryBytes = 256, kHeaderBytes = 65536;
  std::size_t bytes = kHeaderBytes;
  for (const TrainingTensor& tensor : tensors)
    bytes += tensor.values.size_bytes() + 2 * tensor.name.size() + kEntryBytes;
  return static_cast<std::int64_t>(bytes);
}

std::int64_t TrainingCheckpoints::free_bytes() const {
  std::error_code error;
  const fs::space_info space = fs::space(options_.folder, error);
  if (error)
    fail(ErrorKind::kWrite, options_.folder, ": its free space is unknown: ", error.message());
  constexpr std::uintmax_t kMost = std::uintmax_t{1} << 62;
  return static_cast<std::int64_t>(std::min(space.available, kMost));
}

void TrainingCheckpoints::check_space(std::span<const TrainingTensor> tensors,
                                      std::int64_t copies) const {
  const std::int64_t wanted = copies * file_bytes(tensors), available = free_bytes();
  if (available < wanted)
    fail(ErrorKind::kWrite, options_.folder, ": ",
         copies > 1 ? "the checkpoints need " : "the next checkpoint needs ", wanted,
         " bytes, but only ", available, " are free on that disk");
}

void TrainingCheckpoints::save(const TrainingState& state, std::span<const TrainingTensor> tensors,
                               std::optional<std::int64_t> best_step) {
  check_space(tensors, 1);
  const std::string path = this->path(state.step);
  std::map<std::string, std::string> sums;
  std::vector<TensorEntry> entries;
  for (const TrainingTensor& tensor : tensors) {
    sums[tensor.name] = sha256(bytes_of(tensor.values));
    entries.push_back({tensor.name, Dtype::kF32, tensor.shape, 0, 0, 0});
  }
  std::map<std::string, std::string> metadata{
      {"format", "pt"},
      {training::kConfigKey, state.config},
      {training::kStateKey, training::state_json(state, options_.tool_version)},
      {training::kTensorSumsKey, training::sums_json(sums)}};
  const std::string sum = training::header_sum(entries, metadata);
  metadata[training::kHeaderSumKey] = sum;

  // An older mark must not vouch for the file that takes its place.
  std::error_code ignored;
  fs::remove(mark_path(state.step), ignored);
  SafetensorsWriter out(path);
  for (const auto& [key, value] : metadata) out.set_metadata(key, value);
  for (const TrainingTensor& tensor : tensors) out.declare(tensor.name, Dtype::kF32, tensor.shape);
  for (const TrainingTensor& tensor : tensors) out.write(tensor.name, bytes_of(tensor.values));
  out.finish();

  JsonWriter mark;
  mark.begin_object();
  mark.field("bytes", static_cast<std::int64_t>(fs::file_size(path)));
  mark.field("header_sha256", sum);
  mark.end_object();
  write_file(mark_path(state.step), mark.take());
  prune(state.step, best_step);
}

void TrainingCheckpoints::remove(std::int64_t step) const {
  // The mark first: a file without one is never the first choice.
  for (const std::string& file : {mark_path(step), path(step)}) {
    std::error_code error;
    fs::remove(file, error);
    if (error) fail(ErrorKind::kWrite, file, ": cannot be removed: ", error.message());
  }
}

void TrainingCheckpoints::prune(std::int64_t newest, std::optional<std::int64_t> best_step) const {
  std::vector<std::int64_t> older = steps();
  std::erase_if(older, [&](std::int64_t step) { return step > newest; });
  const auto kept = static_cast<std::size_t>(options_.keep);
  for (std::size_t i = 0; i + kept < older.size(); ++i)
    if (older[i] != best_step) remove(older[i]);
}

void TrainingCheckpoints::remove_all() {
  for (const std::int64_t step : steps()) remove(step);
  for (const auto& file : fs::directory_iterator(options_.folder)) {
    // Marks without a file, and what a killed process was writing.
    const std::string name = file.path().filename().string();
    const bool unfinished = name.starts_with("." + std::string(kPrefix)) && name.ends_with(".tmp");
    std::error_code ignored;
    if (unfinished || step_in(name, kMarkEnding)) fs::remove(file.path(), ignored);
  }
}

// Marked checkpoints from the newest to the oldest, then the others.
std::vector<TrainingCheckpoints::Candidate> TrainingCheckpoints::candidates(
    std::vector<std::string>& warnings) const {
  std::vector<Candidate> found;
  for (const std::int64_t step : steps()) {
    Candidate candidate{step, false};
    try {
      const std::string file = mark_path(step);
      const Json mark = Json::read(file);
      const Json* bytes = mark.find("bytes");
      std::error_code ignored;
      candidate.marked =
          bytes != nullptr &&
          bytes->as_int64(file) == static_cast<std::int64_t>(fs::file_size(path(step), ignored));
    } catch (const Error&) {
      // No mark that can be read is no mark.
    }
    if (!candidate.marked)
      warnings.push_back(path(step) + ": is not marked as complete, so another is preferred");
    found.push_back(candidate);
  }
  std::sort(found.begin(), found.end(), [](const Candidate& a, const Candidate& b) {
    return a.marked != b.marked ? a.marked : a.step > b.step;
  });
  return found;
}

void TrainingCheckpoints::refuse_newer_version(const std::string& path,
                                               const std::string& version) const {
  if (version_numbers(version) > version_numbers(options_.tool_version))
    fail(ErrorKind::kUnsupported, path, ": was written by version ", version,
         ", which is newer than this one, ", options_.tool_version);
}

TrainingState TrainingCheckpoints::read(std::int64_t step, std::span<const TrainingTensor> tensors,
                                        const TrainingState& wanted, bool force,
                                        std::vector<std::string>& warnings) const {
  const std::string path = this->path(step);
  const Safetensors file = open_intact(path);
  training::ParsedState parsed = training::parse_state(file.metadata(), path);
  refuse_newer_version(path, parsed.tool_version);
  const std::vector<std::string> differences = state_differences(parsed.state, wanted);
  if (!differences.empty() && !force)
    fail(ErrorKind::kMismatch, path, ": belongs to another training: ", joined(differences),
         " (--force goes on all the same)");
  check_tensors(file, tensors, path);
  read_tensors(file, tensors, path);
  for (const std::string& difference : differences) warnings.push_back("--force: " + difference);
  for (const auto& [name, value] : wanted.surroundings)
    for (const auto& [old_name, old] : parsed.state.surroundings)
      if (old_name == name && old != value)
        warnings.push_back(concat("the number of ", name, " was ", old, " and is ", value,
                                  ", so the run may not be bit-equal to an uninterrupted one"));
  return std::move(parsed.state);
}

std::optional<TrainingCheckpoints::Loaded> TrainingCheckpoints::load_newest(
    std::span<const TrainingTensor> tensors, const TrainingState& wanted, bool force) const {
  Loaded loaded;
  const std::vector<Candidate> all = candidates(loaded.warnings);
  if (all.empty()) return std::nullopt;
  for (const Candidate& candidate : all) {
    try {
      loaded.state = read(candidate.step, tensors, wanted, force, loaded.warnings);
      loaded.path = path(candidate.step);
      return loaded;
    } catch (const Error& error) {
      // Damage sends us to the one before; what is intact but does not belong here is refused.
      if (error.kind() != ErrorKind::kFormat && error.kind() != ErrorKind::kRead) throw;
      loaded.warnings.push_back(concat("DAMAGED CHECKPOINT passed over: ", error.what()));
    }
  }
  fail(ErrorKind::kFormat, options_.folder, ": none of its ", all.size(),
       " checkpoints is intact: ", joined(loaded.warnings));
}

}  // namespace lvggt
