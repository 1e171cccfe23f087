// SPDX-License-Identifier: Apache-2.0
// Models in several safetensors files with an index.
#include <doctest/doctest.h>

#include <filesystem>
#include <string>
#include <vector>

#include "tests/support/safetensors_bytes.h"

using lvggt::ErrorKind;
using lvggt::Safetensors;
using lvggt::test::Outcome;
using lvggt::test::outcome_of;
using lvggt::test::TempDir;

namespace {

constexpr const char* kFirst = "model-00001-of-00002.safetensors";
constexpr const char* kSecond = "model-00002-of-00002.safetensors";

void write_shard(const std::string& path, const std::vector<std::string>& names, float value) {
  lvggt::SafetensorsWriter out(path);
  out.set_metadata("written by", path);
  for (const std::string& name : names) out.add(name, {1}, std::vector<float>{value});
  out.finish();
}

// Tensors a and b in the first shard, c in the second.
void write_shards(const TempDir& dir) {
  write_shard(dir / kFirst, {"a", "b"}, 1);
  write_shard(dir / kSecond, {"c"}, 2);
}

std::string map_entry(const std::string& name, const std::string& file) {
  return "\"" + name + "\":\"" + file + "\"";
}

std::string good_map() {
  return map_entry("a", kFirst) + "," + map_entry("b", kFirst) + "," + map_entry("c", kSecond);
}

Outcome open_index(const TempDir& dir, const std::string& weight_map) {
  const std::string path = dir / "model.safetensors.index.json";
  lvggt::write_file(path, "{\"metadata\":{\"total_size\":12},\"weight_map\":{" + weight_map + "}}");
  return outcome_of([&] { Safetensors::open(path); });
}

void check_format(const Outcome& outcome, const char* says) {
  CAPTURE(outcome.message);
  CHECK_FALSE(outcome.accepted);
  CHECK(outcome.kind == ErrorKind::kFormat);
  CHECK(outcome.says(says));
}

}  // namespace

TEST_CASE("Safetensors: a sharded model opens by its index or its folder") {
  const TempDir dir;
  write_shards(dir);
  CHECK(open_index(dir, good_map()).accepted);
  for (const std::string& path : {dir / "model.safetensors.index.json", dir.path()}) {
    const auto model = Safetensors::open(path);
    CHECK(model.entries().size() == 3);
    CHECK(model.files().size() == 2);
    CHECK(model.read<1>("b")[0] == 1);
    CHECK(model.read<1>("c")[0] == 2);
    CHECK(model.metadata().at("written by") == dir / kFirst);
  }
}

TEST_CASE(
    "Safetensors: a folder opens when it holds one file, and is refused when that is not clear") {
  const TempDir dir;
  write_shard(dir / "one.safetensors", {"a"}, 3);
  CHECK(Safetensors::open(dir.path()).read<1>("a")[0] == 3);
  write_shard(dir / "two.safetensors", {"a"}, 3);
  CHECK(outcome_of([&] { Safetensors::open(dir.path()); }).says("2 .safetensors files"));
}

TEST_CASE("A59: an index whose shard is missing is refused") {
  const TempDir dir;
  write_shards(dir);
  std::filesystem::remove(dir / kSecond);
  const Outcome outcome = open_index(dir, good_map());
  CHECK(outcome.kind == ErrorKind::kRead);
  CHECK(outcome.says(kSecond));
}

TEST_CASE("A59: an index that names a shard or a tensor twice is refused") {
  const TempDir dir;
  write_shards(dir);
  check_format(open_index(dir, good_map() + "," + map_entry("a", kFirst)), "'a' twice");
  check_format(open_index(dir, good_map() + "," + map_entry("a", kSecond)), "'a' twice");
  std::filesystem::create_hard_link(dir / kFirst, dir / "again.safetensors");
  std::filesystem::create_symlink(dir / "again.safetensors", dir / "z.safetensors");
  check_format(
      open_index(dir, map_entry("a", "again.safetensors") + "," + map_entry("b", "z.safetensors")),
      "one file under two names");
}

TEST_CASE("A59: a tensor in two shards, in the wrong one, in none or not listed is refused") {
  const TempDir dir;
  write_shards(dir);
  write_shard(dir / kSecond, {"c", "a"}, 2);
  check_format(open_index(dir, good_map()), "'a' is in this file");
  write_shard(dir / kSecond, {"c"}, 2);
  check_format(open_index(dir, map_entry("a", kFirst) + "," + map_entry("b", kSecond) + "," +
                                   map_entry("c", kSecond)),
               "'b' is in this file");
  check_format(open_index(dir, good_map() + "," + map_entry("d", kSecond)), "'d' is missing");
  check_format(open_index(dir, map_entry("a", kFirst) + "," + map_entry("c", kSecond)),
               "'b' is not listed");
}

TEST_CASE("A59: a shard outside of the index's folder is refused") {
  const TempDir dir;
  write_shards(dir);
  for (const char* name : {"/etc/passwd", "../x.safetensors", "..", ".", "", "sub/x.safetensors",
                           "a\\\\b", "x\\u0000.safetensors"})
    check_format(open_index(dir, map_entry("a", name)),
                 "a shard must be a file in the same folder");
}

TEST_CASE("A59: an index that lists fewer shards than their names announce is refused") {
  const TempDir dir;
  write_shards(dir);
  check_format(open_index(dir, map_entry("a", kFirst) + "," + map_entry("b", kFirst)),
               "is one of 2 files by its name, but weight_map lists 1");
}

TEST_CASE("A59: an index that is not an object with a weight_map of strings is refused") {
  const TempDir dir;
  const auto open_text = [&](const std::string& text) {
    lvggt::write_file(dir / "x.index.json", text);
    return outcome_of([&] { Safetensors::open(dir / "x.index.json"); });
  };
  check_format(open_text(""), "not valid JSON");
  check_format(open_text("[]"), "is an array");
  check_format(open_text("{}"), "no weight_map");
  check_format(open_text("{\"weight_map\":{}}"), "weight_map is empty");
  check_format(open_text("{\"weight_map\":[]}"), "weight_map is an array");
  check_format(open_text("{\"weight_map\":{\"a\":1}}"), "'a' is a number");
  check_format(open_text("{\"weight_map\":{\"a\":{}}}"), "'a' is an object");
  check_format(open_text("{\"weight_map\":{\"a\":\"x\"},\"weight_map\":{}}"), "twice");
}
