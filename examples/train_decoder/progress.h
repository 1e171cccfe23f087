// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <unistd.h>

#include <chrono>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>

#include "lvggt/cli/progress.h"
#include "lvggt/train/decoder_trainer.h"

namespace train_decoder {

// "57/168 [###...] loss 0.1234 (l1 0.05, cos 0.2, rgb 0.03 0.002), rate 1.0e-03, 0.45 s a step,
// 0:50 left".
inline std::string progress_line(std::int64_t done, std::int64_t total,
                                 const lvggt::StepReport& report, double seconds_per_step) {
  using lvggt::cli::fixed;
  char rate[32];
  std::snprintf(rate, sizeof rate, "%.1e", report.learning_rate);
  const lvggt::LossTerms& loss = report.loss;
  return std::to_string(done) + "/" + std::to_string(total) + " loss " + fixed(loss.total, 4) +
         " (l1 " + fixed(loss.l1, 3) + ", cos " + fixed(loss.cos, 3) + ", rgb " +
         fixed(loss.img_l1, 3) + " " + fixed(loss.img_l2, 4) + "), rate " + rate + ", " +
         fixed(seconds_per_step, 2) + " s a step, " +
         lvggt::cli::duration_text(seconds_per_step * static_cast<double>(total - done)) + " left";
}

// Shows the steps on stderr: one line that is redrawn on a terminal, a line every few seconds
// otherwise.
class Progress {
 public:
  explicit Progress(bool quiet) : quiet_(quiet) {
    const char* terminal = std::getenv("TERM");
    redraw_ = isatty(STDERR_FILENO) == 1 && terminal != nullptr && std::string(terminal) != "dumb";
  }
  ~Progress() { clear(); }
  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;

  void show(std::int64_t done, std::int64_t total, const lvggt::StepReport& report,
            double seconds_per_step) {
    if (quiet_) return;
    const auto now = Clock::now();
    const double interval = redraw_ ? 0.1 : 5;
    if (shown_ && done != total && std::chrono::duration<double>(now - last_).count() < interval)
      return;
    shown_ = true;
    last_ = now;
    const std::string line = progress_line(done, total, report, seconds_per_step);
    if (!redraw_) {
      std::fprintf(stderr, "%s\n", line.c_str());
      return;
    }
    std::fprintf(stderr, "\r%s %s\x1b[K", lvggt::cli::progress_bar(done, total, 16).c_str(),
                 line.c_str());
    std::fflush(stderr);
    drawn_ = true;
  }

  // Removes the line, so that another message can be printed.
  void clear() {
    if (drawn_) std::fprintf(stderr, "\r\x1b[K");
    drawn_ = false;
  }

 private:
  using Clock = std::chrono::steady_clock;
  bool quiet_, redraw_ = false, shown_ = false, drawn_ = false;
  Clock::time_point last_;
};

}  // namespace train_decoder
