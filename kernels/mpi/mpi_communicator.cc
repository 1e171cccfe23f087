// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/mpi_communicator.h"

#include <mpi.h>

#include <algorithm>
#include <chrono>
#include <cstdint>
#include <thread>

namespace lvggt {
namespace {

// Counts are int in MPI; larger spans go in pieces.
constexpr std::size_t kMaxCount = std::size_t{1} << 28;

template <class T>
MPI_Datatype mpi_type();
template <>
MPI_Datatype mpi_type<float>() {
  return MPI_FLOAT;
}
template <>
MPI_Datatype mpi_type<double>() {
  return MPI_DOUBLE;
}

}  // namespace

struct MpiCommunicator::State {
  MPI_Comm comm = MPI_COMM_NULL;  // a duplicate: our messages meet nobody else's
  int rank = 0, size = 1;
  double timeout = 60;
  bool finalise = false;
  std::vector<MPI_Request> requests;

  void check(int code, const char* what) const {
    if (code == MPI_SUCCESS) return;
    char text[MPI_MAX_ERROR_STRING];
    int length = 0;
    MPI_Error_string(code, text, &length);
    throw LostRank(concat("rank ", rank, " of ", size, ": ", what,
                          " failed: ", std::string(text, static_cast<std::size_t>(length))));
  }

  template <class T>
  void start(std::span<T> values) {
    for (std::size_t first = 0; first < values.size(); first += kMaxCount) {
      const auto part = values.subspan(first, std::min(kMaxCount, values.size() - first));
      requests.emplace_back();
      check(MPI_Iallreduce(MPI_IN_PLACE, part.data(), static_cast<int>(part.size()), mpi_type<T>(),
                           MPI_SUM, comm, &requests.back()),
            "MPI_Iallreduce");
    }
  }

  // Moves the messages that are under way; whether all have arrived.
  bool advance() {
    if (requests.empty()) return true;
    int done = 0;
    check(
        MPI_Testall(static_cast<int>(requests.size()), requests.data(), &done, MPI_STATUSES_IGNORE),
        "MPI_Testall");
    if (done != 0) requests.clear();
    return done != 0;
  }

  // Waits for everything that was started, not longer than the time-out.
  void finish() {
    using Clock = std::chrono::steady_clock;
    const auto start = Clock::now();
    while (!advance()) {
      const double waited = std::chrono::duration<double>(Clock::now() - start).count();
      if (waited > timeout)
        throw LostRank(concat("rank ", rank, " of ", size, ": another rank has not answered for ",
                              timeout, " s; it hangs, was killed or lost its connection"));
      // Ranks may share cores: after a moment of polling the others get them.
      if (waited > 0.002) std::this_thread::sleep_for(std::chrono::microseconds(100));
    }
  }
};

MpiCommunicator::MpiCommunicator(double timeout) : state_(std::make_unique<State>()) {
  State& s = *state_;
  s.timeout = timeout;
  int initialised = 0;
  MPI_Initialized(&initialised);
  if (initialised == 0) {
    int provided = 0;
    s.check(MPI_Init_thread(nullptr, nullptr, MPI_THREAD_FUNNELED, &provided), "MPI_Init_thread");
    s.finalise = true;
  }
  s.check(MPI_Comm_dup(MPI_COMM_WORLD, &s.comm), "MPI_Comm_dup");
  MPI_Comm_set_errhandler(s.comm, MPI_ERRORS_RETURN);
  MPI_Comm_rank(s.comm, &s.rank);
  MPI_Comm_size(s.comm, &s.size);
}

MpiCommunicator::~MpiCommunicator() {
  if (state_->comm != MPI_COMM_NULL) MPI_Comm_free(&state_->comm);
  if (state_->finalise) MPI_Finalize();
}

int MpiCommunicator::rank() const { return state_->rank; }
int MpiCommunicator::size() const { return state_->size; }

void MpiCommunicator::sum(std::span<double> values) {
  state_->start(values);
  state_->finish();
}

void MpiCommunicator::sum(std::span<float> values) {
  state_->start(values);
  state_->finish();
}

void MpiCommunicator::start_sum(std::span<float> bucket) {
  state_->start(bucket);
  state_->advance();
}

void MpiCommunicator::finish_sums() { state_->finish(); }

bool MpiCommunicator::any(bool value) {
  double ranks = value ? 1 : 0;
  sum(std::span(&ranks, 1));
  return ranks > 0;
}

std::vector<std::string> MpiCommunicator::gather(const std::string& text) {
  // Lengths first, then all texts side by side; a sum over what the others leave 0 gathers.
  const auto ranks = static_cast<std::size_t>(size()), own = static_cast<std::size_t>(rank());
  std::vector<double> lengths(ranks);
  lengths[own] = static_cast<double>(text.size());
  sum(std::span(lengths));
  std::vector<std::size_t> first(ranks + 1);
  for (std::size_t r = 0; r < ranks; ++r)
    first[r + 1] = first[r] + static_cast<std::size_t>(lengths[r]);
  std::vector<float> bytes(first.back());
  for (std::size_t i = 0; i < text.size(); ++i)
    bytes[first[own] + i] = static_cast<float>(static_cast<unsigned char>(text[i]));
  sum(std::span(bytes));
  std::vector<std::string> texts(ranks);
  for (std::size_t r = 0; r < ranks; ++r)
    for (std::size_t i = first[r]; i < first[r + 1]; ++i)
      texts[r] += static_cast<char>(static_cast<unsigned char>(bytes[i]));
  return texts;
}

void MpiCommunicator::end_all(int status) {
  MPI_Abort(MPI_COMM_WORLD, status);
  // MPI_Abort does not return; the compiler does not know.
  for (;;) std::this_thread::sleep_for(std::chrono::seconds(1));
}

}  // namespace lvggt
