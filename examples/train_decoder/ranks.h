// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <functional>
#include <memory>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/train/communicator.h"

namespace train_decoder {

using Facts = std::vector<std::pair<std::string, std::string>>;

// The processes of this training: those that mpirun started, or this one alone.
class Ranks {
 public:
  // Throws kUsage when mpirun started several but the program was built without MPI.
  explicit Ranks(double timeout);
  ~Ranks();

  lvggt::Communicator& communicator() { return *communicator_; }
  int rank() const { return communicator_->rank(); }
  int size() const { return communicator_->size(); }
  bool first() const { return rank() == 0; }  // the one that writes and talks

  // Ranks on this machine, as mpirun says.
  int on_this_machine() const;

  // Does what may fail on some of the ranks; when it did on any, all of them throw, with the errors
  // of the ranks that have one.
  void together(const std::function<void()>& work);

  // Throws kMismatch on all ranks, naming what differs, unless all ranks have the same facts.
  void check_same(const Facts& facts);

  // Runs the training: an error of one rank ends all of them, at once and with its status.
  int guarded(const std::function<int()>& body);

 private:
  std::vector<std::string> gather(const std::string& text);

  std::unique_ptr<lvggt::Communicator> communicator_;
};

}  // namespace train_decoder
