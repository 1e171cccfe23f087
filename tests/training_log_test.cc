// SPDX-License-Identifier: Apache-2.0
#include "lvggt/train/training_log.h"

#include <doctest/doctest.h>

#include <limits>

#include "lvggt/core/error.h"
#include "tests/support/files.h"
#include "tests/support/temp_dir.h"

namespace {

using namespace lvggt;

LogLine line(std::int64_t step, double loss) {
  LogLine result(step);
  result.add("loss", loss);
  return result;
}

}  // namespace

TEST_CASE("TrainingLog: every line is a JSON object whose numbers read back as the same bits") {
  const test::TempDir dir;
  const double third = 1.0 / 3;
  {
    TrainingLog log = TrainingLog::start(dir / "log.jsonl");
    LogLine first = line(1, third);
    first.add("refused", "gradient of \"x\"");
    first.add("grad_norm", std::numeric_limits<double>::quiet_NaN());
    log.append(first);
    log.append(line(2, 0.25));
  }
  const auto lines = read_log(dir / "log.jsonl");
  REQUIRE(lines.size() == 2);
  CHECK(lines[0].find("loss")->as_double("") == third);
  CHECK(lines[0].find("grad_norm")->is_null());
  CHECK(lines[0].find("refused")->as_string("") == "gradient of \"x\"");
  CHECK(log_curve(lines, "loss") == std::vector<std::array<double, 2>>{{1, third}, {2, 0.25}});
  CHECK(log_curve(lines, "grad_norm").empty());
  CHECK(log_csv(lines) ==
        "step,loss,refused,grad_norm\n1,0.3333333333333333,\"gradient of \"\"x\"\"\",\n2,0.25,,\n");
  CHECK(read_log(dir / "missing").empty());
}

TEST_CASE("TrainingLog: resuming drops later steps and a line that was cut") {
  const test::TempDir dir;
  const std::string path = dir / "log.jsonl";
  {
    TrainingLog log = TrainingLog::start(path);
    for (int step = 1; step <= 5; ++step) log.append(line(step, step));
  }
  const std::string whole = test::read_bytes(path);
  test::write_bytes(path, whole + "{\"step\": 6, \"lo");
  {
    TrainingLog log = TrainingLog::resume(path, 3);
    log.append(line(4, 4));
    log.append(line(5, 5));
  }
  CHECK(test::read_bytes(path) == whole);
  TrainingLog::start(path);
  CHECK(test::read_bytes(path).empty());
  { TrainingLog log = TrainingLog::resume(dir / "new.jsonl", 3); }
  CHECK(test::read_bytes(dir / "new.jsonl").empty());
}

TEST_CASE("D09: a log on a full disk is an error that names it") {
  CHECK_THROWS_AS(TrainingLog::start("/no/such/folder/log.jsonl"), Error);
  TrainingLog log = TrainingLog::start("/dev/full");
  CHECK_THROWS_AS(log.append(line(1, 1)), Error);
}

TEST_CASE("draw_loss_curve: a panel for each kind of number the log has") {
  std::vector<Json> lines;
  for (int step = 1; step <= 50; ++step)
    lines.push_back(Json::parse("{\"step\": " + std::to_string(step) + ", \"loss\": " +
                                    std::to_string(1.0 / step) + ", \"learning_rate\": 0.001}",
                                "test"));
  const auto small = draw_loss_curve(lines, "cup");
  lines.push_back(
      Json::parse(R"({"step": 50, "held_out_miou": 0.9, "held_out_psnr": 25})", "test"));
  const auto large = draw_loss_curve(lines, "cup");
  CHECK(large.extent(0) == 2 * small.extent(0));
  CHECK(draw_loss_curve({}, "nothing").extent(0) > 0);
}
