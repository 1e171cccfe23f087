// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <map>
#include <optional>
#include <span>
#include <string>
#include <utility>
#include <vector>

namespace lvggt {

// One float32 tensor of a training checkpoint; its values belong to the trainer.
struct TrainingTensor {
  std::string name;
  std::vector<std::int64_t> shape;
  std::span<float> values;
};

// What training needs to go on exactly where it stopped, beside the tensors.
struct TrainingState {
  std::int64_t step = 0;      // optimisation steps behind it
  std::string config;         // of the model, as JSON (to_json)
  std::string data_manifest;  // hash of the data set
  using Named = std::vector<std::pair<std::string, std::string>>;
  Named settings;      // what the trajectory depends on: a run resumes with the same ones only
  Named surroundings;  // may differ, but then results are not bit-equal: threads, ranks
  std::map<std::string, std::string> values;  // position of the sampler, best score, counters
};

// How `found`, from a checkpoint, differs from what a run wants: "batch was 4 and is 8", one entry
// each for the configuration, the data and every setting. The values play no part.
std::vector<std::string> state_differences(const TrainingState& found, const TrainingState& wanted);

// The training checkpoints of one run: step_000000120.safetensors in a folder of their own, each
// with the state and a SHA-256 of every tensor and of the header in its metadata. The weights stand
// under their published names, so that such a file is a decoder checkpoint too.
//
// A checkpoint is written to a temporary name, synced and renamed, then marked as complete by a
// small file beside it (step_000000120.done). The last `keep` and the best one stay, older ones are
// removed once a newer one is complete. Whatever happens while one is written, the one before stays
// valid. Errors: kWrite (disk full, folder not writable), kRead, kFormat, kUnsupported, kMismatch.
class TrainingCheckpoints {
 public:
  struct Options {
    std::string folder;
    std::int64_t keep = 3;     // the newest ones, at least 1
    std::string tool_version;  // "1.2.3", of the program that writes and reads
  };

  // Creates the folder when it is missing; its parent exists.
  explicit TrainingCheckpoints(Options options);

  // The steps there are files for, ascending, complete or not.
  std::vector<std::int64_t> steps() const;

  std::string path(std::int64_t step) const;

  // About the size of a checkpoint of these tensors, in bytes.
  static std::int64_t file_bytes(std::span<const TrainingTensor> tensors);

  // Free bytes where the folder is.
  std::int64_t free_bytes() const;

  // An Error of kind kWrite when `copies` more checkpoints of these tensors do not fit on the disk.
  void check_space(std::span<const TrainingTensor> tensors, std::int64_t copies) const;

  // Writes the checkpoint of state.step and removes those no longer kept. `best_step` is kept too.
  void save(const TrainingState& state, std::span<const TrainingTensor> tensors,
            std::optional<std::int64_t> best_step = std::nullopt);

  struct Loaded {
    TrainingState state;
    std::string path;
    std::vector<std::string> warnings;  // what was passed over, and what is not as it was
  };

  // Fills `tensors` from the newest intact checkpoint; nothing when there is none at all. Damaged
  // ones (cut short, changed bytes, no mark) are passed over with a warning; a checkpoint that is
  // intact but has no mark is taken only when there is no other. Errors: kFormat when all are
  // damaged; kUnsupported when the newest was written by a newer version of the program; kMismatch,
  // listing the differences, when it does not belong to `wanted` and `force` is not set.
  std::optional<Loaded> load_newest(std::span<const TrainingTensor> tensors,
                                    const TrainingState& wanted, bool force) const;

  // Removes every checkpoint, for a run that starts anew.
  void remove_all();

 private:
  struct Candidate {
    std::int64_t step = 0;
    bool marked = false;
  };
  std::string mark_path(std::int64_t step) const;
  std::vector<Candidate> candidates(std::vector<std::string>& warnings) const;
  TrainingState read(std::int64_t step, std::span<const TrainingTensor> tensors,
                     const TrainingState& wanted, bool force,
                     std::vector<std::string>& warnings) const;
  void refuse_newer_version(const std::string& path, const std::string& version) const;
  void remove(std::int64_t step) const;
  void prune(std::int64_t newest, std::optional<std::int64_t> best_step) const;

  Options options_;
};

}  // namespace lvggt
