// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <span>
#include <string>
#include <vector>

#include "lvggt/core/error.h"
#include "lvggt/train/communicator.h"

namespace lvggt {

// Another rank did not answer in time or MPI failed: this rank cannot go on, and no call to the
// communicator makes sense any more but end_all(). A program's exit status for it is 1.
class LostRank : public Error {
 public:
  explicit LostRank(const std::string& message) : Error(ErrorKind::kWrite, message) {}
};

// All processes that mpirun started, over MPI_COMM_WORLD; in the library lvggt::mpi. Sums of
// gradients are MPI_Iallreduce: they advance at every later call, so that they overlap the backward
// pass. One per process, used by the thread that made it.
class MpiCommunicator final : public Communicator {
 public:
  // Initialises MPI unless the host program has. `timeout` is how many seconds any call waits for
  // the other ranks before it throws LostRank.
  explicit MpiCommunicator(double timeout);
  // Finalises MPI if it was initialised here; waits for the other ranks, so a rank that fails calls
  // end_all() instead.
  ~MpiCommunicator() override;
  MpiCommunicator(const MpiCommunicator&) = delete;
  MpiCommunicator& operator=(const MpiCommunicator&) = delete;

  int rank() const override;
  int size() const override;
  void sum(std::span<double> values) override;
  void sum(std::span<float> values) override;
  void start_sum(std::span<float> bucket) override;
  void finish_sums() override;
  bool any(bool value) override;

  // The text of every rank, in the order of the ranks, on all of them.
  std::vector<std::string> gather(const std::string& text);

  // Ends all ranks at once with this exit status.
  [[noreturn]] void end_all(int status);

 private:
  struct State;
  std::unique_ptr<State> state_;
};

}  // namespace lvggt
