// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <signal.h>
#include <unistd.h>

#include <array>
#include <csignal>

#include "lvggt/core/error.h"

namespace lvggt::cli {

namespace interrupt_detail {

// The only state a signal handler may touch. One program, one flag: it is global like the signals
// are.
inline volatile std::sig_atomic_t requested = 0;

inline void handle(int) {
  if (requested != 0) _exit(exit_code(ErrorKind::kInterrupted));
  requested = 1;
  constexpr char kMessage[] =
      "\ninterrupted: finishing what is being written (again to stop at once)\n";
  // Nothing can be done if the message cannot be shown.
  [[maybe_unused]] const auto written = ::write(STDERR_FILENO, kMessage, sizeof kMessage - 1);
}

}  // namespace interrupt_detail

// While it lives, the first SIGINT, SIGTERM, SIGHUP or SIGUSR1 (which mpirun passes on to its ranks)
// only sets a flag for the program to look at; the second ends the process at once with status 130.
class InterruptGuard {
 public:
  InterruptGuard() {
    interrupt_detail::requested = 0;
    struct sigaction action {};
    action.sa_handler = interrupt_detail::handle;
    sigemptyset(&action.sa_mask);
    action.sa_flags = SA_RESTART;  // a write that is under way goes on
    for (std::size_t i = 0; i < kSignals.size(); ++i) {
      sigaction(kSignals[i], nullptr, &before_[i]);
      // What the parent chose to ignore (nohup) stays ignored.
      if (before_[i].sa_handler != SIG_IGN) sigaction(kSignals[i], &action, nullptr);
    }
  }
  ~InterruptGuard() {
    for (std::size_t i = 0; i < kSignals.size(); ++i) sigaction(kSignals[i], &before_[i], nullptr);
  }
  InterruptGuard(const InterruptGuard&) = delete;
  InterruptGuard& operator=(const InterruptGuard&) = delete;

  bool requested() const { return interrupt_detail::requested != 0; }

 private:
  static constexpr std::array<int, 4> kSignals{SIGINT, SIGTERM, SIGHUP, SIGUSR1};
  std::array<struct sigaction, 4> before_{};
};

}  // namespace lvggt::cli
