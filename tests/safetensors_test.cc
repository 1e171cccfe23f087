// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/safetensors.h"

#include <doctest/doctest.h>
#include <sys/stat.h>
#include <unistd.h>

#include <filesystem>
#include <fstream>
#include <limits>
#include <string>
#include <vector>

#include "tests/support/safetensors_bytes.h"

using lvggt::Dtype;
using lvggt::ErrorKind;
using lvggt::Safetensors;
using lvggt::SafetensorsWriter;
using lvggt::test::open_bytes;
using lvggt::test::open_header;
using lvggt::test::Outcome;
using lvggt::test::outcome_of;
using lvggt::test::safetensors_bytes;
using lvggt::test::TempDir;

namespace fs = std::filesystem;

namespace {

template <class T>
std::string bytes_of(std::initializer_list<T> values) {
  return {reinterpret_cast<const char*>(values.begin()), values.size() * sizeof(T)};
}

std::vector<float> read_all(const Safetensors& file, const std::string& name) {
  std::vector<float> values(static_cast<std::size_t>(file.at(name).size()));
  file.read_into(name, values);
  return values;
}

Safetensors open_kept(const TempDir& dir, const std::string& bytes) {
  lvggt::write_file(dir / "kept.safetensors", bytes);
  return Safetensors::open(dir / "kept.safetensors");
}

}  // namespace

TEST_CASE("SafetensorsWriter: what is written is read back in every floating-point type") {
  const TempDir dir;
  const std::vector<float> values{1, -2.5f, 3, 0.125f, 5, 6};
  SafetensorsWriter out(dir / "a.safetensors");
  out.set_metadata("key", "value \"x\"");
  out.add("kept", {2, 3}, values);
  out.declare("half", Dtype::kF16, {6});
  out.declare("brain", Dtype::kBF16, {3, 2});
  out.add_int64("ints", {2}, std::vector<std::int64_t>{-7, 1LL << 40});
  out.declare("double", Dtype::kF64, {6});
  out.declare("none", Dtype::kF32, {0, 3});
  out.write("half", values);
  out.write("brain", std::span(values).first(2));
  out.write("brain", std::span(values).subspan(2));
  out.write("double", values);
  out.write("none", std::span<const float>());
  CHECK_FALSE(fs::exists(dir / "a.safetensors"));
  out.finish();

  const auto in = Safetensors::open(dir / "a.safetensors");
  CHECK(in.metadata().at("key") == "value \"x\"");
  CHECK(in.entries().size() == 6);
  for (const char* name : {"kept", "half", "brain", "double"}) CHECK(read_all(in, name) == values);
  CHECK(in.read_int64("ints") == std::vector<std::int64_t>{-7, 1LL << 40});
  CHECK(in.read<2>("brain")(1, 1) == 0.125f);
  std::vector<float> part(2);
  in.read_part("half", 3, part);
  CHECK(part == std::vector<float>{0.125f, 5});
}

TEST_CASE("SafetensorsWriter: mistakes of the caller are errors and leave no file") {
  const TempDir dir;
  const std::vector<float> values(4);
  {
    SafetensorsWriter out(dir / "a");
    out.declare("x", Dtype::kF32, {4});
    out.declare("y", Dtype::kI64, {1});
    CHECK_THROWS_AS(out.declare("x", Dtype::kF32, {4}), lvggt::Error);
    CHECK_THROWS_AS(out.declare("n", Dtype::kF32, {-4}), lvggt::Error);
    CHECK_THROWS_AS(out.declare("a\nb", Dtype::kF32, {4}), lvggt::Error);
    CHECK_THROWS_AS(out.add("z", {3}, values), lvggt::Error);
    CHECK_THROWS_AS(out.write("y", values), lvggt::Error);
    CHECK_THROWS_AS(out.write("w", values), lvggt::Error);
    out.write("x", std::span(values).first(3));
    CHECK_THROWS_AS(out.finish(), lvggt::Error);
    CHECK_THROWS_AS(out.write("x", std::span(values).first(2)), lvggt::Error);
    CHECK_THROWS_AS(out.declare("late", Dtype::kF32, {4}), lvggt::Error);
    out.write("x", std::span(values).first(1));
    CHECK_THROWS_AS(out.write("y", values), lvggt::Error);
  }
  CHECK(fs::is_empty(dir.path()));
}

TEST_CASE(
    "Safetensors: a wrong name, rank, size or kind of element is a mismatch that names the file") {
  const TempDir dir;
  const auto file = open_kept(
      dir, safetensors_bytes(R"({"i":{"dtype":"I32","shape":[1],"data_offsets":[0,4]}})", "1234"));
  std::vector<float> one(1), two(2);
  for (const Outcome& outcome :
       {outcome_of([&] { file.at("j"); }), outcome_of([&] { file.read<2>("i"); }),
        outcome_of([&] { file.read_into("i", one); }),
        outcome_of([&] { file.read_into("i", two); }),
        outcome_of([&] { file.read_part("i", 1, one); }),
        outcome_of([&] { file.read_part("i", -1, one); })}) {
    CAPTURE(outcome.message);
    CHECK_FALSE(outcome.accepted);
    CHECK(outcome.kind == ErrorKind::kMismatch);
    CHECK(outcome.says("kept.safetensors"));
  }
  CHECK(file.find("j") == nullptr);
}

TEST_CASE(
    "A38: a directory, pipe, device, unreadable file or symlink loop is refused without waiting") {
  const TempDir dir;
  fs::create_directory(dir / "folder");
  REQUIRE(mkfifo((dir / "fifo").c_str(), 0600) == 0);
  fs::create_symlink("loop", dir / "loop");
  std::vector<std::string> paths{dir / "folder", dir / "fifo", dir / "loop",       dir / "missing",
                                 "/dev/zero",    "/dev/full",  dir / "folder/a\nb"};
  if (geteuid() != 0) {
    lvggt::write_file(dir / "secret", "x");
    fs::permissions(dir / "secret", fs::perms::none);
    paths.push_back(dir / "secret");
  }
  for (const std::string& path : paths) {
    const Outcome outcome = outcome_of([&] { Safetensors::open(path); });
    CAPTURE(outcome.message);
    CHECK_FALSE(outcome.accepted);
    CHECK(outcome.kind == ErrorKind::kRead);
    CHECK(outcome.says(path));
  }
}

TEST_CASE("A39: the message says what the file looks like") {
  const std::string rest(600, '\1');
  const std::vector<std::pair<std::string, const char*>> cases{
      {safetensors_bytes(0x0200000000000000u, "{}"), "big-endian"},
      {"GGUF\3" + rest, "GGUF"},
      {"PK\3\4" + rest, "weights_convert"},
      {"<!DOCTYPE html><html><body>404</body></html>", "HTML"},
      {"\n <HTML>404</HTML>", "HTML"},
      {"404: Not Found", "plain text"},
      {"404", "plain text"},
      {"version https://git-lfs.github.com/spec/v1\noid sha256:1\n", "git lfs pull"},
      {"{\"weight_map\": {}}", "JSON"},
      {"\x80\x02}q" + rest, "pickle"},
      {std::string(4096, '\0'), "only zeros"}};
  for (const auto& [bytes, says] : cases) {
    const Outcome outcome = open_bytes(bytes);
    CAPTURE(outcome.message);
    CHECK_FALSE(outcome.accepted);
    CHECK(outcome.kind == ErrorKind::kFormat);
    CHECK(outcome.says(says));
  }
}

TEST_CASE("A40: a file that shrinks or grows after it was opened is noticed") {
  const std::string header = R"({"a":{"dtype":"F32","shape":[4],"data_offsets":[0,16]}})";
  for (const int change : {-16, -1, 1}) {
    const TempDir dir;
    const auto file = open_kept(dir, safetensors_bytes(header, std::string(16, '\1')));
    CHECK(read_all(file, "a").size() == 4);
    fs::resize_file(dir / "kept.safetensors",
                    static_cast<std::uintmax_t>(8 + static_cast<int>(header.size()) + 16 + change));
    const Outcome outcome = outcome_of([&] { read_all(file, "a"); });
    CAPTURE(outcome.message);
    CHECK(outcome.kind == ErrorKind::kRead);
    CHECK(outcome.says("changed by another program"));
  }
}

TEST_CASE("A41, A42, A43: an empty object and white space around the header are accepted") {
  for (const char* header : {"{}", "{}   ", "{}\n\t ", "  {}", "\r\n{ }"}) {
    const TempDir dir;
    CHECK(open_kept(dir, safetensors_bytes(header)).entries().empty());
  }
}

TEST_CASE("A44, A45: a dimension of 0 and a scalar are accepted") {
  const TempDir dir;
  const auto file = open_kept(
      dir, safetensors_bytes(R"({"none":{"dtype":"F32","shape":[3,0,2],"data_offsets":[0,0]},)"
                             R"("scalar":{"dtype":"F32","shape":[],"data_offsets":[0,4]},)"
                             R"("end":{"dtype":"F16","shape":[0],"data_offsets":[4,4]}})",
                             bytes_of({2.5f})));
  CHECK(file.read<3>("none").shape() == lvggt::Shape{3, 0, 2});
  CHECK(read_all(file, "none").empty());
  CHECK(read_all(file, "scalar") == std::vector<float>{2.5f});
  CHECK(file.at("scalar").size() == 1);
}

TEST_CASE(
    "A46, A47, A48, A49: any order, unaligned offsets, extra fields and non-ASCII names are "
    "accepted") {
  const TempDir dir;
  const auto file = open_kept(
      dir,
      safetensors_bytes(
          "{\"last\":{\"dtype\":\"F32\",\"shape\":[2],\"data_offsets\":[3,11],"
          "\"note\":[{\"deep\":[1,null]},2.5],\"also\":\"x\"},"
          "\"\u00fcber "
          "\u6df1\":{\"note\":{\"dtype\":3},\"shape\":[3],\"data_offsets\":[0,3],\"dtype\":\"U8\"},"
          "\"odd64\":{\"dtype\":\"F64\",\"shape\":[1],\"data_offsets\":[11,19]},"
          "\"odd16\":{\"dtype\":\"BF16\",\"shape\":[1],\"data_offsets\":[19,21]}}",
          bytes_of<std::uint8_t>({7, 8, 255}) + bytes_of({1.5f, -3.0f}) + bytes_of({0.1}) +
              bytes_of<std::uint16_t>({0x3fc0})));
  CHECK(read_all(file, "last") == std::vector<float>{1.5f, -3.0f});
  CHECK(file.read_int64("\u00fcber \u6df1") == std::vector<std::int64_t>{7, 8, 255});
  CHECK(read_all(file, "odd64") == std::vector<float>{0.1f});
  CHECK(read_all(file, "odd16") == std::vector<float>{1.5f});
}

TEST_CASE("A50: a header of exactly 100,000,000 bytes is accepted, and one byte more is not") {
  const TempDir dir;
  const std::string path = dir / "large.safetensors";
  std::string header = R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}})";
  header.resize(100'000'000, ' ');
  lvggt::write_file(path, safetensors_bytes(header, bytes_of({4.5f})));
  CHECK(read_all(Safetensors::open(path), "a") == std::vector<float>{4.5f});
  header += ' ';
  lvggt::write_file(path, safetensors_bytes(header, bytes_of({4.5f})));
  CHECK(outcome_of([&] { Safetensors::open(path); }).kind == ErrorKind::kLimit);
}

TEST_CASE("A55: element types may differ within a file, integers included") {
  const TempDir dir;
  const auto file = open_kept(
      dir,
      safetensors_bytes(R"({"f":{"dtype":"F16","shape":[2],"data_offsets":[0,4]},)"
                        R"("b":{"dtype":"BOOL","shape":[2],"data_offsets":[4,6]},)"
                        R"("i":{"dtype":"I16","shape":[1],"data_offsets":[6,8]},)"
                        R"("u":{"dtype":"U64","shape":[1],"data_offsets":[8,16]},)"
                        R"("v":{"dtype":"U64","shape":[1],"data_offsets":[16,24]}})",
                        bytes_of<std::uint16_t>({0x3c00, 0x0001}) + bytes_of<std::uint8_t>({1, 0}) +
                            bytes_of<std::int16_t>({-5}) + bytes_of<std::uint64_t>({9, ~0ull})));
  CHECK(read_all(file, "f") == std::vector<float>{1.0f, 0x1p-24f});
  CHECK(file.read_int64("b") == std::vector<std::int64_t>{1, 0});
  CHECK(file.read_int64("i") == std::vector<std::int64_t>{-5});
  CHECK(file.read_int64("u") == std::vector<std::int64_t>{9});
  CHECK(outcome_of([&] { file.read_int64("v"); }).kind == ErrorKind::kUnsupported);
  CHECK(outcome_of([&] { file.read_int64("f"); }).kind == ErrorKind::kMismatch);
}
