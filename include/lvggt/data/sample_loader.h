// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <array>
#include <cstdint>
#include <memory>
#include <span>
#include <string>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/data/sample_order.h"
#include "lvggt/data/training_set.h"
#include "lvggt/train/decoder_batch.h"

namespace lvggt {

// Which batch comes next; 0, 0 at the start.
struct LoaderPosition {
  std::int64_t epoch = 0;
  std::int64_t batch = 0;  // within the epoch
  friend bool operator==(const LoaderPosition&, const LoaderPosition&) = default;
};

struct LoaderOptions {
  Part part = Part::kTrain;
  OrderOptions order;  // batch_size is that of all ranks together
  // Rank r of n takes the r-th of n equal parts of every batch, so that n ranks together see what
  // one rank would.
  int rank = 0;
  int num_ranks = 1;
  int threads = 2;   // that read samples; at least 1
  int prefetch = 1;  // batches that are read ahead of the one in use; at least 1
  // Samples of an epoch that may be unreadable: they are counted and replaced by the next one in
  // their batch that can be read. One is always allowed. Beyond that share, next() throws the error
  // of the last of them.
  double max_skipped = 0.01;
  // Only the targets are read, not the tokens (or the other way round).
  bool taps = true;
  bool targets = true;
};

namespace loader_detail {
struct Buffers;
struct State;
}  // namespace loader_detail

// Samples of one optimisation step, this rank's part of them. Owns its memory, which goes back to
// the loader for another batch when it is destroyed (and outlives the loader if need be).
class Batch {
 public:
  Batch();
  Batch(Batch&&) noexcept;
  Batch& operator=(Batch&&) noexcept;
  ~Batch();

  // Views of this batch, valid while it lives.
  const DecoderBatch& view() const;

  // The samples in it, as indices of TrainingSet::samples(part).
  std::span<const std::int64_t> samples() const;
  LoaderPosition position() const;
  // Over all ranks.
  std::int64_t global_size() const;
  // One sentence for each sample of this rank's part that could not be read and was replaced.
  std::span<const std::string> skipped() const;

 private:
  friend class SampleLoader;
  explicit Batch(std::unique_ptr<loader_detail::Buffers> buffers,
                 std::weak_ptr<loader_detail::State> home);

  std::unique_ptr<loader_detail::Buffers> buffers_;
  std::weak_ptr<loader_detail::State> home_;
};

// Delivers the batches of a data set, epoch after epoch, read ahead by threads of its own. Which
// samples a batch holds is a function of the options, the epoch and the batch's number alone; its
// values do not depend on the number of threads. The data set must outlive the loader.
//
//   SampleLoader loader(set, {.order = {.batch_size = 8, .seed = 1}});
//   for (int step = 0; step < 1000; ++step) trainer.step(loader.next().view());
class SampleLoader {
 public:
  // Starts at `position`. Errors: kUsage for options out of range, a part without samples, a
  // position that does not exist, and batches that do not divide evenly among the ranks.
  SampleLoader(const TrainingSet& set, const LoaderOptions& options, LoaderPosition position = {});
  ~SampleLoader();
  SampleLoader(const SampleLoader&) = delete;
  SampleLoader& operator=(const SampleLoader&) = delete;

  // The next batch; waits for it if it is not there yet. Throws what reading it threw; the loader
  // can be asked again then and goes on with the batch after it.
  Batch next();

  // Which batch next() will deliver: to be saved, and given to the constructor to go on from there.
  LoaderPosition position() const;

  // The same in every epoch; at least 1.
  std::int64_t batches_per_epoch() const;

  // Samples replaced so far because they could not be read, by this rank.
  std::int64_t num_skipped() const;

  // batches_per_epoch() of such a loader, without starting one. Errors: those of the constructor.
  static std::int64_t count_batches(const TrainingSet& set, const LoaderOptions& options);

  // Bytes of all batches that can be in memory at once (those read ahead, the one in use, the one
  // it is exchanged for) and of the reading threads.
  static std::size_t planned_bytes(const TrainingSet& set, const LoaderOptions& options);

 private:
  std::shared_ptr<loader_detail::State> state_;
};

}  // namespace lvggt
