// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <unistd.h>

#include <algorithm>
#include <charconv>
#include <chrono>
#include <cmath>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <utility>

namespace lvggt::cli {

// A number with some digits after the point, the same in every locale.
inline std::string fixed(double value, int digits) {
  char text[64];
  return {text,
          std::to_chars(text, text + sizeof text, value, std::chars_format::fixed, digits).ptr};
}

// "1:02:03" or "2:03".
inline std::string duration_text(double seconds) {
  const auto total = static_cast<std::int64_t>(std::llround(std::clamp(seconds, 0.0, 1e9)));
  const auto two = [](std::int64_t n) { return (n < 10 ? "0" : "") + std::to_string(n); };
  const std::int64_t minutes = total / 60 % 60, hours = total / 3600;
  return hours > 0 ? std::to_string(hours) + ":" + two(minutes) + ":" + two(total % 60)
                   : std::to_string(minutes) + ":" + two(total % 60);
}

// "57/217 frames, 3.2 frames/s, 0:50 left"; without the total when it is not known (negative).
inline std::string progress_text(std::int64_t done, std::int64_t total, double seconds,
                                 const std::string& unit = "frames") {
  std::string text = std::to_string(done);
  if (total >= 0) text += "/" + std::to_string(total);
  text += " " + unit;
  if (done == 0 || !(seconds > 0)) return text;
  const double rate = static_cast<double>(done) / seconds;
  text += ", " + fixed(rate, rate < 9.95 ? 2 : 0) + " " + unit + "/s";
  if (total > done)
    text += ", " + duration_text(static_cast<double>(total - done) / rate) + " left";
  return text;
}

// "[#####.....]" for a known total, empty otherwise.
inline std::string progress_bar(std::int64_t done, std::int64_t total, int width) {
  if (total <= 0) return "";
  const auto filled =
      static_cast<std::size_t>(width * std::clamp<std::int64_t>(done, 0, total) / total);
  return "[" + std::string(filled, '#') +
         std::string(static_cast<std::size_t>(width) - filled, '.') + "]";
}

// Shows on stderr how far a run is: a bar that is redrawn on a terminal, a line every few seconds
// otherwise (also on a terminal that cannot redraw: TERM unset or "dumb").
class Progress {
 public:
  explicit Progress(std::int64_t total, std::string unit = "frames")
      : total_(total), unit_(std::move(unit)) {
    const char* terminal = std::getenv("TERM");
    redraw_ = isatty(STDERR_FILENO) == 1 && terminal != nullptr && std::string(terminal) != "dumb";
    const char* no_color = std::getenv("NO_COLOR");
    color_ = redraw_ && (no_color == nullptr || *no_color == '\0');
  }
  ~Progress() { clear(); }
  Progress(const Progress&) = delete;
  Progress& operator=(const Progress&) = delete;

  void show(std::int64_t done) {
    const auto now = Clock::now();
    const double interval = redraw_ ? 0.1 : 5;
    if (shown_ && done != total_ && seconds(now - last_) < interval) return;
    shown_ = true;
    last_ = now;
    const std::string text = progress_text(done, total_, seconds(now - start_), unit_);
    if (!redraw_) {
      std::fprintf(stderr, "%s\n", text.c_str());
      return;
    }
    const std::string bar = progress_bar(done, total_, 30);
    std::fprintf(stderr, "\r%s%s%s %s\x1b[K", color_ ? "\x1b[36m" : "", bar.c_str(),
                 color_ ? "\x1b[0m" : "", text.c_str());
    std::fflush(stderr);
    drawn_ = true;
  }

  // Removes the bar, so that another message can be printed.
  void clear() {
    if (drawn_) std::fprintf(stderr, "\r\x1b[K");
    drawn_ = false;
  }

 private:
  using Clock = std::chrono::steady_clock;
  static double seconds(Clock::duration d) { return std::chrono::duration<double>(d).count(); }

  std::int64_t total_;
  std::string unit_;
  Clock::time_point start_ = Clock::now(), last_;
  bool redraw_ = false, color_ = false, shown_ = false, drawn_ = false;
};

}  // namespace lvggt::cli
