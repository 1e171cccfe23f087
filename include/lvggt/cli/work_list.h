// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <fcntl.h>
#include <sys/file.h>
#include <sys/stat.h>
#include <unistd.h>

#include <cerrno>
#include <cstdint>
#include <cstring>
#include <filesystem>
#include <fstream>
#include <functional>
#include <map>
#include <new>
#include <optional>
#include <string>
#include <string_view>
#include <system_error>
#include <utility>
#include <vector>

#include "lvggt/cli/output_folder.h"
#include "lvggt/cli/program.h"
#include "lvggt/core/error.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/input_file.h"

// A list of inputs that several processes work off together, on one machine or on many that share a
// file system. There is no coordinator: who works on an input holds a lock on the file OUT.lock
// beside its output folder OUT, and the lock ends with the process, however it ends.
namespace lvggt::cli {

struct WorkItem {
  std::string input;
  std::string out;  // its output folder
};

// Which items of the list are ours, without any locks: number `shard` of `num_shards`, from 1.
struct Shard {
  std::int64_t shard = 1, num_shards = 1;
};

// "2/8"; kUsage for anything else.
inline Shard parse_shard(const std::string& text) {
  Shard s;
  const std::size_t slash = text.find('/');
  if (slash == std::string::npos ||
      !parse_number(std::string_view(text).substr(0, slash), s.shard) ||
      !parse_number(std::string_view(text).substr(slash + 1), s.num_shards) || s.num_shards < 1 ||
      s.shard < 1 || s.shard > s.num_shards)
    fail(ErrorKind::kUsage, "--shard: '", text, "' is not I/N with I from 1 to N, such as 2/8");
  return s;
}

// One input a line, as INPUT or INPUT<tab>NAME, where NAME is that of its output folder: otherwise
// the input's file name without extension. Paths are relative to the working directory. Empty lines
// and lines that start with # are left out. `folder_of` makes an output folder of input and name.
// Errors: kRead, kFormat for a list without entries, a name that is no file name, or two inputs of
// one name.
inline std::vector<WorkItem> read_work_list(
    const std::string& path,
    const std::function<std::string(const std::string& input, const std::string& name)>&
        folder_of) {
  const std::string text = read_text_file(path);
  std::vector<WorkItem> items;
  std::map<std::string, std::string> input_of;  // by output folder
  for (std::size_t at = 0; at < text.size();) {
    const std::size_t end = std::min(text.find('\n', at), text.size());
    std::string line = text.substr(at, end - at);
    at = end + 1;
    if (!line.empty() && line.back() == '\r') line.pop_back();
    if (line.empty() || line[0] == '#') continue;
    const std::size_t tab = line.find('\t');
    const std::string input = without_trailing_slashes(line.substr(0, tab));
    const std::filesystem::path file(input);
    const std::string name = tab != std::string::npos              ? line.substr(tab + 1)
                             : std::filesystem::is_directory(file) ? file.filename().string()
                                                                   : file.stem().string();
    if (input.empty() || name.empty() || name[0] == '.' || name.find_first_of("/\t") != name.npos ||
        line.find('\0') != std::string::npos)
      fail(ErrorKind::kFormat, path, ": the line '", line,
           "' is neither INPUT nor INPUT<tab>NAME with a NAME that a folder can have");
    WorkItem item{input, folder_of(input, name)};
    if (const auto [known, is_new] = input_of.emplace(item.out, input); !is_new)
      fail(ErrorKind::kFormat, path, ": ", known->second, " and ", input, " would both go to ",
           item.out, "; give one of them another name, after a tab");
    items.push_back(std::move(item));
  }
  if (items.empty()) fail(ErrorKind::kFormat, path, ": names no input");
  return items;
}

// The lock on one item, held while it lives.
class Claim {
 public:
  // Nothing when another process holds it. Errors: kWrite, also when the file system has no locks.
  static std::optional<Claim> try_take(const std::string& out) {
    const std::string path = out + ".lock";
    while (true) {
      const int fd = ::open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC | O_NOFOLLOW, 0666);
      if (fd < 0) fail(ErrorKind::kWrite, path, ": cannot be created: ", std::strerror(errno));
      if (::flock(fd, LOCK_EX | LOCK_NB) != 0) {
        const int error = errno;
        ::close(fd);
        if (error == EWOULDBLOCK) return std::nullopt;
        if (error == EINTR) continue;
        fail(ErrorKind::kWrite, path, ": cannot be locked (", std::strerror(error),
             "); on a file system without locks, divide the list with --shard");
      }
      // Whoever finishes removes the file: a lock on a removed one protects nothing.
      struct stat mine, there;
      if (::fstat(fd, &mine) == 0 && ::stat(path.c_str(), &there) == 0 &&
          mine.st_ino == there.st_ino && mine.st_dev == there.st_dev)
        return Claim(path, fd);
      ::close(fd);
    }
  }
  Claim(Claim&& other) noexcept
      : path_(std::move(other.path_)), fd_(std::exchange(other.fd_, -1)) {}
  Claim& operator=(Claim&&) = delete;
  ~Claim() {
    if (fd_ < 0) return;
    ::unlink(path_.c_str());
    ::close(fd_);
  }

 private:
  Claim(std::string path, int fd) : path_(std::move(path)), fd_(fd) {}

  std::string path_;
  int fd_;
};

// Tries of an item that ended in an error, one line each, in OUT.failed beside its output folder.
class FailedTries {
 public:
  static constexpr std::int64_t kMaxTries = 2;  // an input that failed so often is left alone

  explicit FailedTries(const std::string& out) : path_(out + ".failed") {}

  std::vector<std::string> lines() const {
    std::vector<std::string> result;
    std::ifstream file(path_);
    for (std::string line; std::getline(file, line);) result.push_back(line);
    return result;
  }
  bool exhausted() const { return static_cast<std::int64_t>(lines().size()) >= kMaxTries; }
  // The claim is held: nobody else writes the file.
  void add(std::string sentence) const {
    for (char& c : sentence)
      if (c == '\n') c = ' ';
    std::string text;
    for (const std::string& line : lines()) text += line + "\n";
    write_file(path_, text + sentence + "\n");
  }
  void clear() const {
    std::error_code ignored;
    std::filesystem::remove(path_, ignored);
  }
  const std::string& path() const { return path_; }

 private:
  std::string path_;
};

// How an item ended.
enum class WorkResult { kDone, kAlreadyDone, kPartial, kInterrupted };

struct ListOptions {
  Shard shard;
  bool retry_failed = false;  // forget earlier failures
};

// Works a list off: items that nobody else works on, each until it is done or has failed twice;
// what failed is tried again after all others. An error of one item is reported and does not stop
// the others.
class WorkOff {
 public:
  struct Calls {
    std::function<bool()> interrupted;
    // Makes or completes one item, and leaves a done one alone.
    std::function<WorkResult(const WorkItem&)> work;
    std::function<void(const std::string&)> say;
  };

  WorkOff(std::vector<WorkItem> items, const ListOptions& options, Calls calls)
      : items_(std::move(items)), options_(options), calls_(std::move(calls)) {
    for (std::size_t i = 0; i < items_.size(); ++i)
      if (static_cast<std::int64_t>(i) % options.shard.num_shards == options.shard.shard - 1)
        ours_.push_back(i);
    states_.resize(items_.size(), State::kOpen);
    if (options_.retry_failed) forget_failures();
  }

  // Returns the exit status: 0, 5 when some inputs could not be done or are partial, 130 when
  // interrupted, that of the last error when nothing at all succeeded.
  int run() {
    for (bool progress = true; progress && !stopped_;) {
      progress = false;
      busy_ = 0;
      for (const std::size_t i : ours_) {
        stopped_ = stopped_ || calls_.interrupted();
        if (stopped_) break;
        if (states_[i] == State::kOpen && attempt(i)) progress = true;
      }
    }
    return conclude();
  }

 private:
  enum class State { kOpen, kDone, kAlreadyDone, kPartial, kFailed };

  void forget_failures() {
    for (const std::size_t i : ours_)
      if (const auto claim = Claim::try_take(items_[i].out)) FailedTries(items_[i].out).clear();
  }

  // Whether something was tried, so that another pass over the rest makes sense.
  bool attempt(std::size_t i) {
    const WorkItem& item = items_[i];
    const FailedTries failures(item.out);
    try {
      const std::optional<Claim> claim = Claim::try_take(item.out);
      if (!claim) {
        ++busy_;
        return false;
      }
      if (failures.exhausted()) {
        states_[i] = State::kFailed;
        calls_.say(concat(item.input, ": left out, it failed ", failures.lines().size(), " times (",
                          failures.path(), "; --retry-failed tries again)"));
        return false;
      }
      calls_.say(concat("input ", i + 1, " of ", items_.size(), ": ", item.input));
      try {
        states_[i] = state_after(calls_.work(item));
        if (!stopped_) failures.clear();
      } catch (const Error& error) {
        failed(i, error, failures);
      } catch (const std::bad_alloc&) {
        failed(i, Error(ErrorKind::kMemory, "not enough memory"), failures);
      }
    } catch (const Error& error) {  // no lock, or no record of the failure: not the input's fault
      failed(i, Error(ErrorKind::kWrite, error.what()), failures);
    }
    return true;
  }

  State state_after(WorkResult result) {
    switch (result) {
      case WorkResult::kDone:
        return State::kDone;
      case WorkResult::kAlreadyDone:
        return State::kAlreadyDone;
      case WorkResult::kPartial:
        return State::kPartial;
      case WorkResult::kInterrupted:
        break;
    }
    stopped_ = true;
    return State::kOpen;
  }

  void failed(std::size_t i, const Error& error, const FailedTries& failures) {
    last_error_ = exit_code(error.kind());
    if (error.kind() == ErrorKind::kInterrupted) {
      stopped_ = true;
      return;
    }
    calls_.say(concat("error: ", items_[i].input, ": ", error.what()));
    // A full disk or a missing permission says nothing about the input.
    if (error.kind() == ErrorKind::kWrite)
      states_[i] = State::kFailed;
    else
      failures.add(error.what());
  }

  int conclude() {
    std::map<State, std::int64_t> count;
    for (const std::size_t i : ours_) ++count[states_[i]];
    std::string summary = concat(count[State::kDone], " of ", ours_.size(), " inputs done");
    const auto add = [&](std::int64_t number, const char* what) {
      if (number > 0) summary += concat(", ", number, " ", what);
    };
    add(count[State::kAlreadyDone], "done before");
    add(count[State::kPartial], "partial");
    add(count[State::kFailed], "failed");
    add(stopped_ ? 0 : busy_, "in the hands of other processes");
    add(stopped_ ? count[State::kOpen] : 0, "left for a rerun");
    calls_.say(summary);
    if (stopped_) return exit_code(ErrorKind::kInterrupted);
    if (count[State::kFailed] + count[State::kPartial] == 0) return 0;
    const bool nothing = count[State::kFailed] == static_cast<std::int64_t>(ours_.size());
    return nothing && last_error_ != 0 ? last_error_ : 5;
  }

  std::vector<WorkItem> items_;
  ListOptions options_;
  Calls calls_;
  std::vector<std::size_t> ours_;
  std::vector<State> states_;
  std::int64_t busy_ = 0;
  int last_error_ = 0;
  bool stopped_ = false;
};

// What a program with --list says about it in its --help.
inline constexpr const char* kListHelp =
    "With --list, several processes may share the list: start the same command as often as you\n"
    "like, on one machine, on many with one file system, or by mpirun -n 4 (which only starts "
    "them;\n"
    "no MPI is needed). Each takes the next input that nobody has: it holds a lock on OUT.lock\n"
    "beside the output folder OUT, which ends with the process, so that what a killed one left is\n"
    "done by the others or by a rerun, and nothing is done twice. An input that fails is reported\n"
    "and tried once more after the others, then left out (OUT.failed says why). Locks are "
    "flock():\n"
    "they hold between machines on NFS version 4, Lustre (mounted with flock), GPFS and the like;\n"
    "on a file system without them give each process its part with --shard I/N.";

}  // namespace lvggt::cli
