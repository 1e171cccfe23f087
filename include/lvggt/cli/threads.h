// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdlib>
#include <string>
#include <string_view>

#include "lvggt/cli/program.h"
#include "lvggt/core/context.h"

namespace lvggt::cli {

struct ThreadChoice {
  int threads = 1;
  std::string reason;  // "--threads", "2 CPUs in the affinity mask", ...
};

// How many threads a program uses: `option` (its --threads, 0 if not given), else
// LVGGT_NUM_THREADS, else OMP_NUM_THREADS, else available_threads(). The variables are passed by
// value, null when unset. A wrong LVGGT_NUM_THREADS is a kUsage error; OMP_NUM_THREADS, which is
// not ours, is ignored unless it starts with a number in range.
inline ThreadChoice choose_threads(int option, const char* own_variable, const char* omp_variable) {
  if (option != 0) return {option, "--threads"};
  int threads = 0;
  if (own_variable != nullptr) {
    if (!parse_number(std::string_view(own_variable), threads) || threads < 1 ||
        threads > kMaxThreads)
      fail(ErrorKind::kUsage, "LVGGT_NUM_THREADS is '", own_variable,
           "', which is not a whole number from 1 to ", kMaxThreads);
    return {threads, "LVGGT_NUM_THREADS"};
  }
  if (omp_variable != nullptr) {
    // A list gives a number for each level of nesting; the first is ours.
    const std::string_view list(omp_variable);
    if (parse_number(list.substr(0, list.find(',')), threads) && threads >= 1 &&
        threads <= kMaxThreads)
      return {threads, "OMP_NUM_THREADS"};
  }
  ThreadChoice choice;
  choice.threads = available_threads(&choice.reason);
  return choice;
}

inline ThreadChoice choose_threads(int option) {
  return choose_threads(option, std::getenv("LVGGT_NUM_THREADS"), std::getenv("OMP_NUM_THREADS"));
}

// The option behind it.
inline CLI::Option* add_threads_option(Program& program, int& threads) {
  return program
      .add_number("--threads", threads,
                  "Threads; otherwise LVGGT_NUM_THREADS, OMP_NUM_THREADS or all CPUs this process "
                  "may use",
                  1, kMaxThreads)
      ->default_str("");
}

}  // namespace lvggt::cli
