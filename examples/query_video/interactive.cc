// SPDX-License-Identifier: Apache-2.0
#include "examples/query_video/interactive.h"

#include <poll.h>
#include <unistd.h>

#include <cerrno>
#include <cstdio>
#include <cstring>
#include <optional>

#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/progress.h"
#include "lvggt/model/stage_times.h"

namespace query_video {

using namespace lvggt;

namespace {

constexpr const char* kStatePrefix = "state:";
constexpr std::size_t kKeptCodes = std::size_t{1} << 30;  // bytes at most, and half of what is free

void say(const std::string& line) { std::fprintf(stderr, "query_video: %s\n", line.c_str()); }

// Lines of the standard input, with a look at the interrupt while waiting for them.
class LineReader {
 public:
  explicit LineReader(const cli::InterruptGuard& interrupt) : interrupt_(interrupt) {}

  // The next line without its end; nothing at the end of the input or when interrupted.
  std::optional<std::string> next() {
    for (;;) {
      const std::size_t end = buffer_.find('\n');
      if (end != std::string::npos || (ended_ && !buffer_.empty())) {
        std::string line = buffer_.substr(0, end);
        buffer_.erase(0, end == std::string::npos ? end : end + 1);
        if (!line.empty() && line.back() == '\r') line.pop_back();
        return line;
      }
      if (ended_ || interrupt_.requested()) return std::nullopt;
      fill();
    }
  }

 private:
  void fill() {
    constexpr int kPatience = 200;  // ms between looks at the interrupt
    pollfd waiting{STDIN_FILENO, POLLIN, 0};
    if (poll(&waiting, 1, kPatience) <= 0) return;
    char bytes[4096];
    const ssize_t count = read(STDIN_FILENO, bytes, sizeof bytes);
    if (count < 0 && errno == EINTR) return;
    if (count < 0)
      fail(ErrorKind::kRead, "the standard input cannot be read: ", std::strerror(errno));
    ended_ = count == 0;
    // What is too long for a question is cut, which the encoder then refuses by its length.
    if (buffer_.size() <= static_cast<std::size_t>(2 * kMaxPhraseBytes) ||
        std::memchr(bytes, '\n', static_cast<std::size_t>(count)) != nullptr)
      buffer_.append(bytes, static_cast<std::size_t>(count));
  }

  const cli::InterruptGuard& interrupt_;
  std::string buffer_;
  bool ended_ = false;
};

std::string trimmed(const std::string& text) {
  const std::size_t begin = text.find_first_not_of(" \t");
  if (begin == std::string::npos) return {};
  return text.substr(begin, text.find_last_not_of(" \t") + 1 - begin);
}

Questions question_of(const std::string& line) {
  Questions questions;
  if (line.starts_with(kStatePrefix))
    questions.states.push_back(trimmed(line.substr(std::strlen(kStatePrefix))));
  else
    questions.phrases.push_back(line);
  return questions;
}

void answer(Session& session, const std::string& line, const std::string& out, std::size_t number,
            const cli::InterruptGuard& interrupt, Context& ctx) {
  const Questions questions = question_of(line);
  LVGGT_CHECK(questions.states.empty() || session.sentence_encoder() != nullptr,
              "states need --sentence-encoder and --state-autoencoder");
  AnswerTarget target{out, {false, false, false, true}, "", ""};
  if (!out.empty()) {
    const std::string name = folder_name(number, questions.all().front());
    target.sheet = name + ".png";
    if (!questions.states.empty()) target.time_lines = name + "_time.png";
  }
  const Hooks hooks{[&] { return interrupt.requested(); }, [](std::int64_t) {},
                    [](const std::string& warning) { say("warning: " + warning); }};
  double seconds = 0;
  std::vector<Result> results;
  {
    const StageTimer timer(seconds);
    results = session.ask(questions, target, hooks, ctx);
  }
  const auto frames = static_cast<double>(session.clip().frames.size());
  std::printf("%s  [%s s, %s ms a frame%s]\n",
              sentence_about(results.front(), session.clip()).c_str(),
              cli::fixed(seconds, 2).c_str(), cli::fixed(1000 * seconds / frames, 1).c_str(),
              out.empty() ? "" : (", " + out + "/" + target.sheet).c_str());
  std::fflush(stdout);
}

}  // namespace

int converse(Session& session, const std::string& out, std::size_t memory, Context& ctx) {
  const cli::InterruptGuard interrupt;
  session.keep_codes(std::min(kKeptCodes, memory / 2));
  const bool person = isatty(STDIN_FILENO) == 1;
  if (person)
    say("type what to look for, or \"state: ...\" for when something holds; the end of the input "
        "(Ctrl-D) ends");
  LineReader lines(interrupt);
  std::size_t number = 0;
  for (;;) {
    if (person) std::fputs("> ", stderr);
    const std::optional<std::string> line = lines.next();
    if (!line) break;
    const std::string text = trimmed(*line);
    if (text.empty()) {
      say("an empty line asks nothing");
      continue;
    }
    try {
      answer(session, text, out, ++number, interrupt, ctx);
    } catch (const Error& error) {
      if (error.kind() == ErrorKind::kInterrupted) throw;
      say(std::string("error: ") + error.what());
    }
  }
  return interrupt.requested() ? exit_code(ErrorKind::kInterrupted) : 0;
}

}  // namespace query_video
