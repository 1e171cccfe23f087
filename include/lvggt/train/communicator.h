// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <span>

namespace lvggt {

// The processes (ranks) that train one model together, each on its share of every batch. All ranks
// make the same calls in the same order; every sum is over the ranks, in place, and leaves the same
// bits on all of them. Errors: what the implementation documents when a rank is lost.
class Communicator {
 public:
  virtual ~Communicator() = default;

  virtual int rank() const = 0;
  virtual int size() const = 0;

  virtual void sum(std::span<double> values) = 0;
  virtual void sum(std::span<float> values) = 0;

  // Starts to sum a part of the flat gradient while the backward pass goes on; `bucket` must not be
  // touched before finish_sums() returns, which waits for all that were started.
  virtual void start_sum(std::span<float> bucket) = 0;
  virtual void finish_sums() = 0;

  // Whether any rank says so.
  virtual bool any(bool value) = 0;
};

// One process alone: every sum is already there.
class SingleProcess final : public Communicator {
 public:
  int rank() const override { return 0; }
  int size() const override { return 1; }
  void sum(std::span<double>) override {}
  void sum(std::span<float>) override {}
  void start_sum(std::span<float>) override {}
  void finish_sums() override {}
  bool any(bool value) override { return value; }
};

}  // namespace lvggt
