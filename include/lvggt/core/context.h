// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <memory>
#include <string>

#include "lvggt/core/arena.h"

namespace lvggt {

// Threads this process may use: the CPUs of its affinity mask, at most the cgroup's CPU quota
// rounded down, at least 1. When `reason` is given it receives a phrase saying which of them
// decided.
int available_threads(std::string* reason = nullptr);

// Most threads a Context accepts.
inline constexpr int kMaxThreads = 1024;

// Owns the threads and the scratch memory that operators use; always their last argument. There is
// nothing global: two contexts are independent. One context serves one calling thread at a time.
class Context {
 public:
  // num_threads 0 means available_threads(); negative or above kMaxThreads is an error.
  explicit Context(int num_threads = 0);
  ~Context();
  Context(const Context&) = delete;
  Context& operator=(const Context&) = delete;

  int num_threads() const { return num_threads_; }
  Arena& arena() { return arena_; }

  struct Threads;  // oneTBB stays in kernels/core/parallel.cc
  Threads& threads() { return *threads_; }

 private:
  int num_threads_;
  Arena arena_;
  std::unique_ptr<Threads> threads_;
};

}  // namespace lvggt
