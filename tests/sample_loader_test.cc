// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/sample_loader.h"

#include <doctest/doctest.h>

#include <cstring>
#include <filesystem>
#include <optional>

#include "tests/support/files.h"
#include "tests/support/safetensors_bytes.h"
#include "tests/support/tiny_scene.h"

using namespace lvggt;
namespace fs = std::filesystem;

namespace {

// A data set of `num_frames` frames to train on and, if any, more that are held out.
struct Data {
  explicit Data(int num_frames, int held_out = 0) : scene(num_frames + held_out), ctx(1) {
    scene.make_tokens();
    TrainingSetOptions options;
    options.scenes = {scene.path()};
    if (held_out > 0)
      options.split.train = FrameRanges::parse("1-" + std::to_string(num_frames), "test");
    if (held_out > 0)
      options.split.held_out = FrameRanges::parse(
          std::to_string(num_frames + 1) + "-" + std::to_string(num_frames + held_out), "test");
    set.emplace(TrainingSet::open(options, ctx));
  }
  std::string token_file(int i) const {
    return scene.tokens() + "/" + scene.name(i) + ".safetensors";
  }

  test::TinyScene scene;
  Context ctx;
  std::optional<TrainingSet> set;
};

LoaderOptions options_of(std::int64_t batch_size) {
  LoaderOptions options;
  options.order.batch_size = batch_size;
  options.order.seed = 5;
  return options;
}

std::vector<std::int64_t> samples_of(const Batch& batch) {
  return {batch.samples().begin(), batch.samples().end()};
}

// Whether the batch's values are those of its samples.
bool values_fit(const Batch& batch) {
  const DecoderBatch& b = batch.view();
  for (std::size_t i = 0; i < batch.samples().size(); ++i) {
    const auto at = static_cast<std::int64_t>(i);
    const int frame = static_cast<int>(batch.samples()[i]);
    for (std::size_t t = 0; t < 4; ++t)
      if (b.taps[t](at, 1, 7) != test::TinyScene::token(frame, static_cast<int>(t), 128 + 7))
        return false;
    if (b.images(at, 2, 3, 1) != static_cast<float>((6 + 6 + 20 * frame) % 256) / 255.0f ||
        b.features(at, 2, 0, 0, 1) != test::TinyScene::code(frame, 0, 1) ||
        b.mask(at, 0, 0, 0) != 1 || b.mask(at, 0, 27, 0) != 0)
      return false;
  }
  return true;
}

}  // namespace

TEST_CASE("sample_loader: every sample comes once an epoch, with its own values") {
  const Data data(6);
  SampleLoader loader(*data.set, options_of(2));
  CHECK(loader.batches_per_epoch() == 3);
  CHECK(SampleLoader::count_batches(*data.set, options_of(2)) == 3);
  for (int epoch = 0; epoch < 3; ++epoch) {
    std::vector<int> seen(6);
    for (int i = 0; i < 3; ++i) {
      CHECK(loader.position() == LoaderPosition{epoch, i});
      const Batch batch = loader.next();
      CHECK(batch.position() == LoaderPosition{epoch, i});
      CHECK(batch.view().num_frames() == 2);
      CHECK(batch.view().h == 2);
      CHECK(batch.view().w == 3);
      CHECK(batch.global_size() == 2);
      CHECK(values_fit(batch));
      for (const std::int64_t sample : batch.samples()) ++seen[static_cast<std::size_t>(sample)];
    }
    for (const int times : seen) CHECK(times == 1);
  }
  CHECK(loader.num_skipped() == 0);
}

TEST_CASE("D36: the batches are the same for any number of threads and of batches read ahead") {
  const Data data(7);
  std::vector<std::vector<std::int64_t>> expected;
  for (const auto& [threads, prefetch] : {std::pair{1, 1}, {2, 3}, {5, 2}, {8, 8}}) {
    LoaderOptions options = options_of(3);
    options.threads = threads;
    options.prefetch = prefetch;
    SampleLoader loader(*data.set, options);
    for (std::size_t i = 0; i < 8; ++i) {
      const Batch batch = loader.next();
      CHECK(values_fit(batch));
      if (expected.size() <= i) expected.push_back(samples_of(batch));
      CHECK(samples_of(batch) == expected[i]);
    }
  }
}

TEST_CASE("sample_loader: it continues from a saved position as if it had never stopped") {
  const Data data(6);
  SampleLoader whole(*data.set, options_of(2));
  std::vector<std::vector<std::int64_t>> all;
  for (int i = 0; i < 9; ++i) all.push_back(samples_of(whole.next()));
  for (std::size_t stop = 0; stop < 9; ++stop) {
    const LoaderPosition position{static_cast<std::int64_t>(stop / 3),
                                  static_cast<std::int64_t>(stop % 3)};
    SampleLoader rest(*data.set, options_of(2), position);
    CHECK(samples_of(rest.next()) == all[stop]);
  }
  for (const LoaderPosition wrong : {LoaderPosition{0, 3}, {0, -1}, {-1, 0}})
    CHECK_THROWS_AS(SampleLoader(*data.set, options_of(2), wrong), Error);
}

TEST_CASE("E20: ranks together see the batch of one rank, and unequal parts are refused") {
  const Data data(9);
  LoaderOptions options = options_of(4);
  SampleLoader alone(*data.set, options);
  options.num_ranks = 2;
  SampleLoader first(*data.set, options);
  options.rank = 1;
  SampleLoader second(*data.set, options);
  for (int i = 0; i < 4; ++i) {
    auto both = samples_of(first.next());
    const Batch part = second.next();
    CHECK(part.global_size() == 4);
    CHECK(part.view().num_frames() == 2);
    both.insert(both.end(), part.samples().begin(), part.samples().end());
    CHECK(both == samples_of(alone.next()));
  }
  const auto refused = [&](LoaderOptions wrong, std::string_view text) {
    const auto outcome = test::outcome_of([&] { SampleLoader loader(*data.set, wrong); });
    return outcome.kind == ErrorKind::kUsage && outcome.says(text);
  };
  options.num_ranks = 3;
  CHECK(refused(options, "evenly among 3"));
  options.num_ranks = 2;
  options.order.last = LastBatch::kKeep;  // nine frames: the last batch has one
  CHECK(refused(options, "evenly among 2"));
  options.rank = 2;
  CHECK(refused(options, "rank 2 of 2"));
}

TEST_CASE("D24: a kept last batch and a data set smaller than a batch have the samples there are") {
  const Data data(5);
  LoaderOptions options = options_of(2);
  options.order.last = LastBatch::kKeep;
  SampleLoader loader(*data.set, options);
  CHECK(loader.batches_per_epoch() == 3);
  CHECK(loader.next().view().num_frames() == 2);
  CHECK(loader.next().view().num_frames() == 2);
  const Batch last = loader.next();
  CHECK(last.view().num_frames() == 1);
  CHECK(values_fit(last));
  SampleLoader large(*data.set, options_of(8));
  CHECK(large.batches_per_epoch() == 1);
  CHECK(large.next().view().num_frames() == 5);
  CHECK(large.next().position() == LoaderPosition{1, 0});
}

TEST_CASE("sample_loader: held-out frames come in order") {
  const Data data(3, 4);
  LoaderOptions options = options_of(3);
  options.part = Part::kHeldOut;
  options.order.shuffle = false;
  options.order.last = LastBatch::kKeep;
  SampleLoader loader(*data.set, options);
  CHECK(loader.batches_per_epoch() == 2);
  CHECK(samples_of(loader.next()) == std::vector<std::int64_t>{0, 1, 2});
  CHECK(samples_of(loader.next()) == std::vector<std::int64_t>{3});
  const Data none(3);
  CHECK_THROWS_AS(SampleLoader(*none.set, options), Error);
}

TEST_CASE("B23, D22: a sample that cannot be read is replaced, counted and reported; many end the run") {
  const Data data(6);
  SampleLoader whole(*data.set, options_of(3));
  const auto first = samples_of(whole.next());
  const int bad = static_cast<int>(first[1]);
  fs::resize_file(data.token_file(bad), 200);
  for (const int threads : {1, 3}) {
    LoaderOptions options = options_of(3);
    options.threads = threads;
    SampleLoader loader(*data.set, options);
    const Batch batch = loader.next();
    CHECK(samples_of(batch) == std::vector<std::int64_t>{first[0], first[2], first[2]});
    REQUIRE(batch.skipped().size() == 1);
    CHECK(batch.skipped()[0].find(data.scene.name(bad)) != std::string::npos);
    CHECK(batch.skipped()[0].find("left out once") != std::string::npos);
    CHECK(loader.next().skipped().empty());
    CHECK(loader.num_skipped() == 1);
  }
  // Two in one epoch are beyond 1 % of six.
  fs::remove(data.token_file(static_cast<int>(first[0])));
  SampleLoader loader(*data.set, options_of(3));
  const auto outcome = test::outcome_of([&] {
    for (int i = 0; i < 2; ++i) loader.next();
  });
  CHECK_FALSE(outcome.accepted);
  CHECK(outcome.says("too many frames"));
  CHECK(outcome.says(".safetensors"));
  LoaderOptions patient = options_of(3);
  patient.max_skipped = 0.5;
  SampleLoader tolerant(*data.set, patient);
  CHECK(samples_of(tolerant.next()) == std::vector<std::int64_t>{first[2], first[2], first[2]});
  CHECK(tolerant.num_skipped() == 2);
}

TEST_CASE(
    "D46: when no sample of a batch can be read, the error of the thread reaches the caller") {
  const Data data(4);
  for (int i = 0; i < 4; ++i) fs::remove(data.token_file(i));
  LoaderOptions options = options_of(2);
  options.max_skipped = 1;
  SampleLoader loader(*data.set, options);
  CHECK_THROWS_AS(loader.next(), Error);
  CHECK_THROWS_AS(loader.next(), Error);
}

TEST_CASE("sample_loader: batches outlive the loader, and destroying it never waits for a reader") {
  const Data data(6);
  Batch kept;
  {
    SampleLoader loader(*data.set, options_of(2));
    kept = loader.next();
    kept = loader.next();
  }
  CHECK(values_fit(kept));
  for (int i = 0; i < 20; ++i) {
    LoaderOptions options = options_of(2);
    options.threads = 4;
    SampleLoader loader(*data.set, options);
  }
}

TEST_CASE("sample_loader: tokens or targets can be left out, and the memory is stated") {
  const Data data(4);
  LoaderOptions options = options_of(2);
  options.taps = false;
  SampleLoader targets(*data.set, options);
  const Batch batch = targets.next();
  CHECK(batch.view().taps[0].empty());
  CHECK(batch.view().features.extent(0) == 2);
  options.taps = true;
  options.targets = false;
  SampleLoader taps(*data.set, options);
  const Batch tokens = taps.next();
  CHECK(tokens.view().features.empty());
  CHECK(tokens.view().num_frames() == 2);

  const std::size_t sample = sizeof(float) * (4 * 6 * 128 + 28 * 42 * (3 + 3 * 4));
  const std::size_t planned = SampleLoader::planned_bytes(*data.set, options_of(2));
  CHECK(planned >= 3 * 2 * sample);
  CHECK(planned <= 3 * 2 * sample + 2 * 28 * 42 * 64);
}
