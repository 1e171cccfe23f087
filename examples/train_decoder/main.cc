// SPDX-License-Identifier: Apache-2.0
// Trains the Semantic Bridging Decoder on labelled scenes: from tokens and label maps to a
// checkpoint that lift_video loads.
#include <fcntl.h>
#include <sys/file.h>
#include <unistd.h>

#include <cerrno>
#include <chrono>
#include <cstdio>
#include <filesystem>
#include <string>

#include "examples/train_decoder/option_groups.h"
#include "examples/train_decoder/ranks.h"
#include "examples/train_decoder/session.h"
#include "lvggt/cli/output_folder.h"
#include "lvggt/cli/program.h"
#include "lvggt/cli/threads.h"
#include "lvggt/io/hash.h"
#include "lvggt/train/training_tensors.h"

namespace train_decoder {
namespace {

using namespace lvggt;

void say(const Ranks& ranks, const std::string& line) {
  if (ranks.first()) std::fprintf(stderr, "train_decoder: %s\n", line.c_str());
}

// Holds the output folder for this process; another training into it is refused.
class FolderLock {
 public:
  explicit FolderLock(const std::string& folder) {
    const std::string path = folder + "/.lock";
    fd_ = ::open(path.c_str(), O_RDWR | O_CREAT | O_CLOEXEC, 0666);
    if (fd_ < 0) fail(ErrorKind::kWrite, path, ": cannot be written");
    // Some network file systems have no locks; then there is none.
    if (::flock(fd_, LOCK_EX | LOCK_NB) != 0 && errno == EWOULDBLOCK) {
      ::close(fd_);
      fail(ErrorKind::kUsage, folder, ": another training is writing to this folder");
    }
  }
  ~FolderLock() { ::close(fd_); }
  FolderLock(const FolderLock&) = delete;
  FolderLock& operator=(const FolderLock&) = delete;

 private:
  int fd_ = -1;
};

// Removes what an earlier training left in the folder; anything else stays.
void remove_earlier_training(const std::string& output) {
  namespace fs = std::filesystem;
  TrainingCheckpoints({output + "/checkpoints", 1, LVGGT_VERSION}).remove_all();
  cli::remove_earlier_run(output,
                          {cli::kRunFile, kLogFile, "log.csv", "loss.png", "held_out.json",
                           "decoder.safetensors", "best.safetensors"},
                          {});
  for (const auto& entry : fs::directory_iterator(output)) {
    const std::string name = entry.path().filename().string();
    if (name.starts_with("held_out_") && name.ends_with(".png") &&
        cli::is_numbered_file(name.substr(9), {".png"}))
      cli::remove_earlier_run(output, {name}, {});
  }
}

// Makes the output folder ready: fresh, replaced or to be resumed.
void open_output(const Options& options, const RunRecord& record, std::optional<FolderLock>& lock) {
  const cli::Existing existing = options.resume  ? cli::Existing::kResume
                                 : options.force ? cli::Existing::kReplace
                                                 : cli::Existing::kRefuse;
  const bool earlier = cli::check_output_folder(options.output, existing);
  cli::create_output_folder(options.output);
  lock.emplace(options.output);
  if (earlier && !options.resume) remove_earlier_training(options.output);
  write_file(options.output + "/" + cli::kRunFile, record.json());
}

RunRecord make_record(const Options& options, const Setup& setup, const Ranks& ranks,
                      const cli::ThreadChoice& threads, int argc, char** argv) {
  RunRecord record;
  record.version = LVGGT_VERSION;
  record.arguments.assign(argv + 1, argv + argc);
  record.settings = options.settings();
  record.data = setup.set.description();
  record.total_steps = setup.total_steps;
  record.threads = threads.threads;
  record.ranks = ranks.size();
  record.planned_bytes = setup.plan.total();
  return record;
}

// Threads of this rank: when mpirun bound none of the ranks to cores, they share what there is.
cli::ThreadChoice threads_of_rank(const Options& options, const Ranks& ranks) {
  cli::ThreadChoice choice = cli::choose_threads(options.threads);
  const int local = ranks.on_this_machine();
  const bool unbound = choice.threads >= sysconf(_SC_NPROCESSORS_ONLN);
  if (options.threads == 0 && local > 1 && unbound) {
    choice.threads = std::max(1, choice.threads / local);
    choice.reason += concat(", divided among ", local, " ranks");
  }
  return choice;
}

// All ranks must train the same model on the same data from the same start.
Facts facts(const Options& options, const Setup& setup, const std::string& weights) {
  const auto sum = [](const std::string& text) {
    return sha256(std::as_bytes(std::span(text.data(), text.size()))).substr(0, 16);
  };
  Facts facts{{"version", LVGGT_VERSION},
              {"configuration", sum(to_json(setup.config))},
              {"data set", setup.set.manifest_sha256().substr(0, 16)},
              {"weights", weights.substr(0, 16)},
              {"number of steps", std::to_string(setup.total_steps)},
              {"steps between tests", std::to_string(setup.evaluate_every)}};
  for (const auto& setting : options.settings()) facts.push_back(setting);
  return facts;
}

int run(Options& options, Ranks& ranks, int argc, char** argv) {
  using Clock = std::chrono::steady_clock;
  const auto start = Clock::now();
  const cli::InterruptGuard interrupt;
  const cli::ThreadChoice threads = threads_of_rank(options, ranks);
  Context ctx(threads.threads);
  std::optional<Setup> setup;
  ranks.together([&] {
    options.settle();
    if (!options.output.empty()) options.output = cli::without_trailing_slashes(options.output);
    setup.emplace(prepare(options, ranks.rank(), ranks.size(), ctx));
    check_plan(*setup, options, ranks.on_this_machine());
  });
  for (const std::string& warning : setup->set.warnings()) say(ranks, "warning: " + warning);
  for (const std::string& line : describe(*setup, options)) say(ranks, line);
  say(ranks, concat(ranks.size() > 1 ? concat(ranks.size(), " ranks, ") : "", threads.threads,
                    threads.threads == 1 ? " thread (" : " threads (", threads.reason, ")"));
  if (options.dry_run) return 0;

  RunRecord record = make_record(options, *setup, ranks, threads, argc, argv);
  std::optional<FolderLock> lock;
  ranks.together([&] {
    if (ranks.first()) open_output(options, record, lock);
  });
  int status = 0;
  try {
    Session session(options, *setup, ranks, interrupt, record, ctx);
    std::string weights;
    ranks.together([&] { weights = session.start(); });
    ranks.check_same(facts(options, *setup, weights));
    status = session.run();
  } catch (const std::exception& error) {
    record.status = "failed";
    record.error = error.what();
    try {
      if (ranks.first()) write_file(options.output + "/" + cli::kRunFile, record.json());
    } catch (const Error& also) {
      say(ranks, also.what());
    }
    throw;
  }
  record.seconds = std::chrono::duration<double>(Clock::now() - start).count();
  if (ranks.first()) write_file(options.output + "/" + cli::kRunFile, record.json());
  say(ranks, concat(cli::duration_text(record.seconds), " in all, ",
                    cli::bytes_text(cli::peak_resident_bytes()), " at most"));
  return status;
}

int train(Options& options, int argc, char** argv) {
  Ranks ranks(options.rank_timeout);
  return ranks.guarded([&] { return run(options, ranks, argc, argv); });
}

}  // namespace
}  // namespace train_decoder

int main(int argc, char** argv) {
  lvggt::cli::Program program(
      "train_decoder",
      "Trains the Semantic Bridging Decoder on labelled scenes. The geometry encoder stays frozen: "
      "its tokens are read from\nthe folder that make_tokens wrote.",
      LVGGT_VERSION);
  train_decoder::Options options;
  train_decoder::add_options(program, options);
  return program.run(argc, argv, [&] { return train_decoder::train(options, argc, argv); });
}
