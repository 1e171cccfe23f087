// SPDX-License-Identifier: Apache-2.0
// Started by mpirun with several ranks; every rank runs every case.
#define DOCTEST_CONFIG_IMPLEMENT
#include <doctest/doctest.h>

#include <chrono>
#include <cstdio>
#include <cstring>
#include <string>
#include <thread>
#include <vector>

#include "lvggt/train/mpi_communicator.h"

namespace {

lvggt::MpiCommunicator* communicator = nullptr;

}  // namespace

TEST_CASE("MpiCommunicator: sums and any() see every rank") {
  auto& comm = *communicator;
  const int N = comm.size(), r = comm.rank();
  REQUIRE(N >= 2);
  std::vector<double> doubles{1.0 + r, 0.5};
  comm.sum(std::span(doubles));
  CHECK(doubles[0] == N * (N + 1) / 2.0);
  CHECK(doubles[1] == 0.5 * N);
  std::vector<float> floats(1000, static_cast<float>(r));
  comm.sum(std::span(floats));
  CHECK(floats[999] == static_cast<float>(N * (N - 1) / 2));
  comm.sum(std::span<float>());
  CHECK(comm.any(r == N - 1));
  CHECK_FALSE(comm.any(false));
}

TEST_CASE("MpiCommunicator: buckets that are started one by one arrive all together") {
  auto& comm = *communicator;
  const int N = comm.size(), r = comm.rank();
  std::vector<float> gradient(100000);
  for (std::size_t i = 0; i < gradient.size(); ++i)
    gradient[i] = static_cast<float>(r + 1) * static_cast<float>(i % 7);
  const std::span<float> all(gradient);
  for (std::size_t first = 0; first < gradient.size(); first += 30000)
    comm.start_sum(all.subspan(first, std::min<std::size_t>(30000, gradient.size() - first)));
  comm.finish_sums();
  bool right = true;
  for (std::size_t i = 0; i < gradient.size(); ++i)
    right &= gradient[i] == static_cast<float>(N * (N + 1) / 2) * static_cast<float>(i % 7);
  CHECK(right);
  comm.finish_sums();
}

TEST_CASE("MpiCommunicator: gathers a text of each rank, also empty ones and any byte") {
  auto& comm = *communicator;
  const std::string own =
      comm.rank() == 0 ? "" : "rank \xff" + std::to_string(comm.rank()) + std::string(1, '\0');
  const auto texts = comm.gather(own);
  REQUIRE(texts.size() == static_cast<std::size_t>(comm.size()));
  CHECK(texts[0].empty());
  CHECK(texts[1] ==
        "rank \xff"
        "1" +
            std::string(1, '\0'));
  CHECK(texts[static_cast<std::size_t>(comm.rank())] == own);
}

// With the argument "hang" the last rank never answers: the others must end all of them.
int hang(lvggt::MpiCommunicator& comm) {
  try {
    if (comm.rank() == comm.size() - 1) std::this_thread::sleep_for(std::chrono::hours(1));
    comm.any(false);
  } catch (const lvggt::LostRank& error) {
    std::fprintf(stderr, "%s\n", error.what());
    comm.end_all(7);
  }
  return 0;
}

int main(int argc, char** argv) {
  const bool hanging = argc > 1 && std::strcmp(argv[1], "hang") == 0;
  lvggt::MpiCommunicator comm(hanging ? 0.5 : 60);
  if (hanging) return hang(comm);
  communicator = &comm;
  doctest::Context context;
  const int failed = context.run();
  return comm.any(failed != 0) ? 1 : 0;
}
