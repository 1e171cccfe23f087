// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/sample_loader.h"

#include <algorithm>
#include <condition_variable>
#include <deque>
#include <exception>
#include <map>
#include <mutex>
#include <thread>
#include <utility>

#include "lvggt/core/error.h"

namespace lvggt {

namespace loader_detail {

// One batch from the moment it is scheduled.
struct Buffers {
  LoaderPosition position;
  std::vector<std::int64_t> whole;    // samples of all ranks
  std::vector<std::int64_t> samples;  // of this one; replaced where unreadable
  DecoderBatch view;
  std::array<Tensor<float, 3>, 4> taps;
  Tensor<float, 4> images, mask;
  Tensor<float, 5> features;
  // While it is filled, guarded by the state's mutex.
  std::size_t next_sample = 0, num_done = 0;
  std::vector<std::string> skipped;
  std::exception_ptr error;

  bool complete() const { return num_done == samples.size(); }
};

namespace {

void ensure(auto& tensor, auto shape) {
  if (tensor.empty() || !(tensor.shape() == shape))
    tensor = std::remove_reference_t<decltype(tensor)>(shape);
}

// Makes room for B samples like this one; memory of the right size is kept.
void shape_for(Buffers& b, const TrainingSet& set, const LoaderOptions& options) {
  const auto B = static_cast<std::int64_t>(b.samples.size());
  const Sample& s = set.samples(options.part)[static_cast<std::size_t>(b.samples[0])];
  const std::int64_t levels = set.supervision().levels(), d = set.supervision().dim;
  b.view = {};
  b.view.h = s.h;
  b.view.w = s.w;
  if (options.taps)
    for (std::size_t i = 0; i < 4; ++i) {
      ensure(b.taps[i], Shape{B, s.h * s.w, set.channels()});
      b.view.taps[i] = b.taps[i];
    }
  if (!options.targets) return;
  ensure(b.images, Shape{B, s.H, s.W, std::int64_t{3}});
  ensure(b.features, Shape{B, levels, s.H, s.W, d});
  ensure(b.mask, Shape{B, levels, s.H, s.W});
  b.view.images = b.images;
  b.view.features = b.features;
  b.view.mask = b.mask;
}

SampleViews views_of(Buffers& b, std::size_t i, const LoaderOptions& options) {
  const auto at = static_cast<std::int64_t>(i);
  SampleViews out;
  if (options.taps)
    for (std::size_t tap = 0; tap < 4; ++tap) out.taps[tap] = b.taps[tap][at];
  if (options.targets) {
    out.image = b.images[at];
    out.features = b.features[at];
    out.mask = b.mask[at];
  }
  return out;
}

std::int64_t sample_bytes(const TrainingSet& set, const Sample& s, const LoaderOptions& options) {
  const SupervisionSpec& spec = set.supervision();
  std::int64_t floats = 0;
  if (options.taps) floats += 4 * s.h * s.w * set.channels();
  if (options.targets) floats += s.H * s.W * (3 + spec.levels() * (spec.dim + 1));
  return floats * static_cast<std::int64_t>(sizeof(float));
}

}  // namespace

// What the threads share.
struct State {
  State(const TrainingSet& data, const LoaderOptions& wanted, LoaderPosition start)
      : set(data), options(wanted), scheduled(start), delivered(start) {}

  // Immutable after construction.
  const TrainingSet& set;
  LoaderOptions options;
  std::vector<std::int64_t> groups;  // of each sample
  std::int64_t batches_per_epoch = 0;
  std::int64_t max_skipped = 1;  // in one epoch

  std::mutex mutex;
  std::condition_variable work, done;
  std::deque<std::unique_ptr<Buffers>> queue;  // in order of delivery
  std::vector<std::unique_ptr<Buffers>> spare;
  std::vector<std::vector<std::int64_t>> epoch;  // batches of the epoch being scheduled
  std::int64_t epoch_number = -1;
  LoaderPosition scheduled, delivered;  // the next batch of each
  std::map<std::int64_t, std::int64_t> skipped_in_epoch;
  std::int64_t num_skipped = 0;
  bool stop = false;
  std::vector<std::thread> threads;

  void prepare();
  void schedule();
  void run();
  void fill(Buffers& batch, std::size_t i);
  LoaderPosition after(LoaderPosition position) const {
    ++position.batch;
    return position.batch < batches_per_epoch ? position : LoaderPosition{position.epoch + 1, 0};
  }
};

void State::prepare() {
  const auto& samples = set.samples(options.part);
  if (samples.empty())
    fail(ErrorKind::kUsage, "there is no frame to ",
         options.part == Part::kTrain ? "train on" : "test on: none is held out");
  if (options.threads < 1 || options.prefetch < 1 || options.num_ranks < 1 || options.rank < 0 ||
      options.rank >= options.num_ranks || !(options.max_skipped >= 0 && options.max_skipped <= 1))
    fail(ErrorKind::kUsage, "loader: ", options.threads, " threads, ", options.prefetch,
         " batches ahead, rank ", options.rank, " of ", options.num_ranks,
         " and a share of skipped samples of ", options.max_skipped, " make no sense");
  std::map<std::array<std::int64_t, 4>, std::int64_t> sizes;
  for (const Sample& s : samples)
    groups.push_back(
        sizes.emplace(std::array{s.h, s.w, s.H, s.W}, static_cast<std::int64_t>(sizes.size()))
            .first->second);
  const auto first = epoch_batches(groups, options.order, delivered.epoch);
  batches_per_epoch = static_cast<std::int64_t>(first.size());
  for (const auto& batch : first)
    if (batch.size() % static_cast<std::size_t>(options.num_ranks) != 0)
      fail(ErrorKind::kUsage, "a batch of ", batch.size(), " frames cannot be split evenly among ",
           options.num_ranks, " processes; choose another batch size",
           options.order.last == LastBatch::kKeep ? " or leave out the incomplete last batch" : "");
  if (delivered.epoch < 0 || delivered.batch < 0 || delivered.batch >= batches_per_epoch)
    fail(ErrorKind::kUsage, "loader: there is no batch ", delivered.batch, " of epoch ",
         delivered.epoch, ", an epoch has ", batches_per_epoch);
  max_skipped = std::max<std::int64_t>(
      1, static_cast<std::int64_t>(options.max_skipped * static_cast<double>(samples.size())));
}

// Puts the next batch into the queue. The mutex is held.
void State::schedule() {
  if (epoch_number != scheduled.epoch) {
    epoch = epoch_batches(groups, options.order, scheduled.epoch);
    epoch_number = scheduled.epoch;
  }
  std::unique_ptr<Buffers> b;
  if (!spare.empty()) {
    b = std::move(spare.back());
    spare.pop_back();
  } else {
    b = std::make_unique<Buffers>();
  }
  b->position = scheduled;
  b->whole = epoch[static_cast<std::size_t>(scheduled.batch)];
  const std::size_t share = b->whole.size() / static_cast<std::size_t>(options.num_ranks);
  const auto begin = b->whole.begin() +
                     static_cast<std::ptrdiff_t>(share * static_cast<std::size_t>(options.rank));
  b->samples.assign(begin, begin + static_cast<std::ptrdiff_t>(share));
  b->next_sample = b->num_done = 0;
  b->skipped.clear();
  b->error = nullptr;
  shape_for(*b, set, options);
  queue.push_back(std::move(b));
  scheduled = after(scheduled);
  work.notify_all();
}

// Reads sample i of the batch, or the next one of the batch that can be read.
void State::fill(Buffers& batch, std::size_t i) {
  const auto& samples = set.samples(options.part);
  const SampleViews out = views_of(batch, i, options);
  const std::size_t n = batch.whole.size();
  const std::size_t own =
      batch.samples.size() * static_cast<std::size_t>(options.rank) + i;  // its place in `whole`
  for (std::size_t attempt = 0;; ++attempt) {
    const std::int64_t sample = batch.whole[(own + attempt) % n];
    try {
      set.read(out, samples[static_cast<std::size_t>(sample)]);
      const std::lock_guard lock(mutex);
      batch.samples[i] = sample;
      return;
    } catch (const Error& error) {
      const std::lock_guard lock(mutex);
      // A neighbour that fails too is counted in its own place.
      if (attempt == 0) {
        ++num_skipped;
        ++skipped_in_epoch[batch.position.epoch];
        batch.skipped.push_back(concat("frame ",
                                       samples[static_cast<std::size_t>(sample)].frame.name,
                                       " is left out once: ", error.what()));
      }
      if (skipped_in_epoch[batch.position.epoch] > max_skipped)
        throw Error(error.kind(),
                    concat("too many frames cannot be read any more (",
                           skipped_in_epoch[batch.position.epoch], " of ", samples.size(),
                           " in this epoch), the last one because ", error.what()));
      if (attempt + 1 == n) throw;
    }
  }
}

void State::run() {
  std::unique_lock lock(mutex);
  while (true) {
    Buffers* batch = nullptr;
    work.wait(lock, [&] {
      if (stop) return true;
      for (const auto& b : queue)
        if (b->next_sample < b->samples.size()) {
          batch = b.get();
          return true;
        }
      return false;
    });
    if (stop) return;
    const std::size_t i = batch->next_sample++;
    lock.unlock();
    std::exception_ptr error;
    try {
      fill(*batch, i);
    } catch (...) {
      error = std::current_exception();
    }
    lock.lock();
    if (error && !batch->error) batch->error = error;
    if (++batch->num_done == batch->samples.size()) done.notify_all();
  }
}

}  // namespace loader_detail

Batch::Batch(std::unique_ptr<loader_detail::Buffers> buffers,
             std::weak_ptr<loader_detail::State> home)
    : buffers_(std::move(buffers)), home_(std::move(home)) {}
Batch::Batch() = default;
Batch::Batch(Batch&&) noexcept = default;

Batch& Batch::operator=(Batch&& other) noexcept {
  std::swap(buffers_, other.buffers_);
  std::swap(home_, other.home_);
  return *this;
}

Batch::~Batch() {
  if (!buffers_) return;
  const auto home = home_.lock();
  if (!home) return;
  const std::lock_guard lock(home->mutex);
  home->spare.push_back(std::move(buffers_));
}

const DecoderBatch& Batch::view() const { return buffers_->view; }
std::span<const std::int64_t> Batch::samples() const { return buffers_->samples; }
LoaderPosition Batch::position() const { return buffers_->position; }
std::int64_t Batch::global_size() const {
  return static_cast<std::int64_t>(buffers_->whole.size());
}
std::span<const std::string> Batch::skipped() const { return buffers_->skipped; }

SampleLoader::SampleLoader(const TrainingSet& set, const LoaderOptions& options,
                           LoaderPosition position)
    : state_(std::make_shared<loader_detail::State>(set, options, position)) {
  state_->prepare();
  {
    const std::lock_guard lock(state_->mutex);
    for (int i = 0; i < options.prefetch; ++i) state_->schedule();
  }
  try {
    for (int i = 0; i < options.threads; ++i)
      state_->threads.emplace_back([state = state_.get()] { state->run(); });
  } catch (const std::system_error& error) {
    // Fewer threads do the same work; without any there is nobody to do it.
    if (state_->threads.empty())
      fail(ErrorKind::kMemory, "loader: no thread can be started: ", error.what());
  }
}

SampleLoader::~SampleLoader() {
  {
    const std::lock_guard lock(state_->mutex);
    state_->stop = true;
  }
  state_->work.notify_all();
  for (std::thread& thread : state_->threads) thread.join();
}

Batch SampleLoader::next() {
  std::unique_lock lock(state_->mutex);
  state_->done.wait(lock, [&] { return state_->queue.front()->complete(); });
  std::unique_ptr<loader_detail::Buffers> b = std::move(state_->queue.front());
  state_->queue.pop_front();
  state_->delivered = state_->after(state_->delivered);
  state_->schedule();
  lock.unlock();
  Batch batch(std::move(b), state_);
  if (batch.buffers_->error) std::rethrow_exception(batch.buffers_->error);
  // Threads finish in any order.
  std::sort(batch.buffers_->skipped.begin(), batch.buffers_->skipped.end());
  return batch;
}

LoaderPosition SampleLoader::position() const {
  const std::lock_guard lock(state_->mutex);
  return state_->delivered;
}

std::int64_t SampleLoader::batches_per_epoch() const { return state_->batches_per_epoch; }

std::int64_t SampleLoader::count_batches(const TrainingSet& set, const LoaderOptions& options) {
  loader_detail::State state(set, options, {});
  state.prepare();
  return state.batches_per_epoch;
}

std::int64_t SampleLoader::num_skipped() const {
  const std::lock_guard lock(state_->mutex);
  return state_->num_skipped;
}

std::size_t SampleLoader::planned_bytes(const TrainingSet& set, const LoaderOptions& options) {
  std::int64_t largest = 0, picture = 0;
  for (const Sample& sample : set.samples(options.part)) {
    largest = std::max(largest, loader_detail::sample_bytes(set, sample, options));
    const ImageTransform& t = set.tokens(sample).manifest().transform;
    picture = std::max(picture, std::int64_t{t.original_width} * t.original_height);
  }
  const std::int64_t share = (options.order.batch_size + options.num_ranks - 1) / options.num_ranks;
  // A thread holds the picture decoded and prepared, its labels, and one level of them widened.
  const std::int64_t thread = picture * (2 * 3 + 12 + 4 * set.supervision().levels() + 16);
  return static_cast<std::size_t>(largest * share * (options.prefetch + 2) +
                                  thread * options.threads);
}

}  // namespace lvggt
