// SPDX-License-Identifier: Apache-2.0
#include "lvggt/cli/work_list.h"

#include <doctest/doctest.h>
#include <sys/wait.h>

#include <filesystem>
#include <map>

#include "tests/support/files.h"
#include "tests/support/safetensors_bytes.h"
#include "tests/support/temp_dir.h"

using namespace lvggt;
using cli::WorkItem;
using cli::WorkResult;
namespace fs = std::filesystem;

namespace {

// A list whose outputs go to a folder of their own.
struct List {
  std::vector<WorkItem> items(int n) const {
    std::vector<WorkItem> result;
    for (int i = 0; i < n; ++i)
      result.push_back({"input" + std::to_string(i), dir / ("out" + std::to_string(i))});
    return result;
  }
  int work_off(const std::vector<WorkItem>& work, std::function<WorkResult(const WorkItem&)> call,
               const cli::ListOptions& options = {}) {
    return cli::WorkOff(work, options,
                        {[&] { return interrupt; }, std::move(call),
                         [&](const std::string& line) { said += line + "\n"; }})
        .run();
  }
  bool says(const std::string& text) const { return said.find(text) != std::string::npos; }

  test::TempDir dir;
  std::string said;
  bool interrupt = false;
};

test::Outcome read_list(const std::string& text) {
  const test::TempDir dir;
  test::write_bytes(dir / "list.txt", text);
  return test::outcome_of([&] {
    cli::read_work_list(dir / "list.txt",
                        [](const std::string&, const std::string& name) { return "o/" + name; });
  });
}

}  // namespace

TEST_CASE("work_list: one input a line, with the name of its output folder after a tab") {
  const test::TempDir dir;
  fs::create_directory(dir / "some.folder");
  test::write_bytes(dir / "list.txt", "# videos\r\na/clip.mp4\r\n\nb/clip.mp4\tother\n" +
                                          (dir / "some.folder/") + "\n/x/with space.mov");
  const auto items = cli::read_work_list(
      dir / "list.txt",
      [](const std::string& input, const std::string& name) { return name + " of " + input; });
  REQUIRE(items.size() == 4);
  CHECK(items[0].out == "clip of a/clip.mp4");
  CHECK(items[1].out == "other of b/clip.mp4");
  CHECK(items[2].out == "some.folder of " + (dir / "some.folder"));
  CHECK(items[3].input == "/x/with space.mov");
  CHECK(read_list("a/clip.mp4\nb/clip.mov\n").says("would both go to o/clip"));
  CHECK(read_list("a\ta/../b\n").kind == ErrorKind::kFormat);
  CHECK(read_list("a\t..\n").kind == ErrorKind::kFormat);
  CHECK(read_list("a\t\n").kind == ErrorKind::kFormat);
  CHECK(read_list("\tb\n").kind == ErrorKind::kFormat);
  CHECK(read_list("# nothing\n").says("names no input"));
}

TEST_CASE("E14: a shard out of range or of another form is refused") {
  CHECK(cli::parse_shard("2/8").shard == 2);
  CHECK(cli::parse_shard("1/1").num_shards == 1);
  for (const char* wrong : {"0/8", "9/8", "-1/8", "1/0", "1", "/", "a/b", "1/8x", "1 /8", ""})
    CHECK(test::outcome_of([&] { cli::parse_shard(wrong); }).kind == ErrorKind::kUsage);
}

TEST_CASE("work_list: every item is worked on once; shards share them out") {
  List list;
  std::map<std::string, int> times;
  const auto work = [&](const WorkItem& item) {
    ++times[item.input];
    CHECK(fs::exists(item.out + ".lock"));
    return WorkResult::kDone;
  };
  CHECK(list.work_off(list.items(5), work) == 0);
  CHECK(times.size() == 5);
  for (const auto& [input, n] : times) CHECK(n == 1);
  CHECK(fs::is_empty(list.dir.path()));
  for (int shard = 1; shard <= 3; ++shard)
    CHECK(list.work_off(list.items(5), work, {{shard, 3}}) == 0);
  for (const auto& [input, n] : times) CHECK(n == 2);
  CHECK(list.says("2 of 2 inputs done"));
}

TEST_CASE("E12: an item that another process holds is left to it, and free when that one dies") {
  List list;
  const auto items = list.items(3);
  int ready[2], go[2];
  REQUIRE(pipe(ready) == 0);
  REQUIRE(pipe(go) == 0);
  const pid_t child = fork();
  if (child == 0) {
    const auto claim = cli::Claim::try_take(items[1].out);
    char c = claim ? 'y' : 'n';
    if (write(ready[1], &c, 1) != 1 || read(go[0], &c, 1) != 1) _exit(1);
    _exit(0);
  }
  char answer = 0;
  REQUIRE(read(ready[0], &answer, 1) == 1);
  REQUIRE(answer == 'y');
  CHECK_FALSE(cli::Claim::try_take(items[1].out));
  std::vector<std::string> done;
  const auto work = [&](const WorkItem& item) {
    done.push_back(item.input);
    return WorkResult::kDone;
  };
  CHECK(list.work_off(items, work) == 0);
  CHECK(done == std::vector<std::string>{"input0", "input2"});
  CHECK(list.says("1 in the hands of other processes"));
  kill(child, SIGKILL);  // leaves its file behind, but not its lock
  waitpid(child, nullptr, 0);
  CHECK(fs::exists(items[1].out + ".lock"));
  CHECK(list.work_off({items[1]}, work) == 0);
  CHECK(done.back() == "input1");
  for (const int fd : {ready[0], ready[1], go[0], go[1]}) close(fd);
}

TEST_CASE("E15: a poison input is tried twice, after the others, and then left out") {
  List list;
  std::vector<std::string> tries;
  const auto work = [&](const WorkItem& item) {
    tries.push_back(item.input);
    if (item.input == "input0") fail(ErrorKind::kFormat, "poison\nof two lines");
    return WorkResult::kDone;
  };
  CHECK(list.work_off(list.items(3), work) == 5);
  CHECK(tries == std::vector<std::string>{"input0", "input1", "input2", "input0"});
  CHECK(list.says("error: input0: poison"));
  CHECK(list.says("left out, it failed 2 times"));
  CHECK(list.says("2 of 3 inputs done, 1 failed"));
  CHECK(test::read_bytes(list.dir / "out0.failed") == "poison of two lines\npoison of two lines\n");
  // A rerun does not try it again, unless told to; alone, its error is the program's.
  tries.clear();
  CHECK(list.work_off({list.items(1)[0]}, work) == 5);
  CHECK(tries.empty());
  cli::ListOptions retry;
  retry.retry_failed = true;
  CHECK(list.work_off({list.items(1)[0]}, work, retry) == 3);
  CHECK(tries.size() == 2);
  const auto cured = [](const WorkItem&) { return WorkResult::kDone; };
  CHECK(list.work_off({list.items(1)[0]}, cured, retry) == 0);
  CHECK_FALSE(fs::exists(list.dir / "out0.failed"));
}

TEST_CASE("work_list: an input that fails once and then works is done") {
  List list;
  int tries = 0;
  CHECK(list.work_off(list.items(1), [&](const WorkItem&) {
    if (++tries == 1) fail(ErrorKind::kRead, "the network is away");
    return WorkResult::kDone;
  }) == 0);
  CHECK(tries == 2);
  CHECK(fs::is_empty(list.dir.path()));
}

TEST_CASE("work_list: a full disk is no fault of the input, and no lock can be taken nowhere") {
  List list;
  int tries = 0;
  CHECK(list.work_off(list.items(2), [&](const WorkItem& item) {
    ++tries;
    if (item.input == "input0") fail(ErrorKind::kWrite, "no space left");
    return WorkResult::kDone;
  }) == 5);
  CHECK(tries == 2);
  CHECK_FALSE(fs::exists(list.dir / "out0.failed"));
  std::vector<WorkItem> nowhere{{"input", list.dir / "no/such/out"}};
  CHECK(list.work_off(nowhere, [&](const WorkItem&) { return WorkResult::kDone; }) == 1);
  CHECK(list.says("cannot be created"));
}

TEST_CASE("work_list: an interrupt ends the work with status 130; partial results with 5") {
  List list;
  int tries = 0;
  CHECK(list.work_off(list.items(3), [&](const WorkItem&) {
    ++tries;
    list.interrupt = true;
    return WorkResult::kInterrupted;
  }) == 130);
  CHECK(tries == 1);
  CHECK(list.says("3 left for a rerun"));
  list.interrupt = false;
  CHECK(list.work_off(list.items(2), [&](const WorkItem& item) {
    return item.input == "input0" ? WorkResult::kPartial : WorkResult::kAlreadyDone;
  }) == 5);
}
