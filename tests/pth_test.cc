// SPDX-License-Identifier: Apache-2.0
#include "weights/pth.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cstring>
#include <filesystem>
#include <map>
#include <string>
#include <vector>

#include "lvggt/core/float16.h"
#include "tests/support/paths.h"
#include "tests/support/pth_bytes.h"
#include "tests/support/safetensors_bytes.h"

using lvggt::Dtype;
using lvggt::ErrorKind;
using lvggt::PthFile;
using lvggt::test::Outcome;
using lvggt::test::outcome_of;
using lvggt::test::PickleWriter;
using lvggt::test::TempDir;
using lvggt::test::write_pth;
using lvggt::test::write_zip;

namespace {

const std::string kGolden = lvggt::test::test_data("golden/");

const lvggt::PthTensor& tensor_named(const PthFile& file, const std::string& name) {
  for (const auto& tensor : file.tensors())
    if (tensor.name == name) return tensor;
  throw std::runtime_error("no tensor " + name);
}

template <class T>
std::vector<T> values_of(PthFile& file, const std::string& name) {
  const auto& tensor = tensor_named(file, name);
  std::vector<T> values(static_cast<std::size_t>(tensor.num_bytes) / sizeof(T));
  file.read(tensor, std::as_writable_bytes(std::span(values)));
  return values;
}

// What opening a checkpoint with this pickle ends in; storage 0 has 16 bytes.
Outcome open_pickle(const std::string& pickle) {
  const TempDir dir;
  write_pth(dir / "a.pth", pickle, {{"0", std::string(16, '\1')}});
  return outcome_of([&] { PthFile(dir / "a.pth"); });
}

void check_fault(const Outcome& outcome, ErrorKind kind, const char* says) {
  CAPTURE(outcome.message);
  CHECK_FALSE(outcome.accepted);
  CHECK(outcome.kind == kind);
  CHECK(outcome.says("a.pth"));
  CHECK(outcome.says(says));
}

// {'w': tensor}
std::string one_tensor(std::int64_t offset, const std::vector<std::int64_t>& shape,
                       const std::vector<std::int64_t>& strides, std::int64_t storage_size = 4) {
  return PickleWriter()
      .op('}')
      .text("w")
      .tensor("FloatStorage", "0", storage_size, offset, shape, strides)
      .op('s')
      .done();
}

}  // namespace

TEST_CASE(
    "PthFile: genuine checkpoints of protocol 2 and 4 give every tensor, dense and in order") {
  for (const char* name : {"checkpoint_plain.pth", "checkpoint_protocol4.pth"}) {
    CAPTURE(name);
    PthFile file(kGolden + name);
    CHECK(file.notes().empty());
    REQUIRE(file.tensors().size() == 11);
    CHECK(file.tensors()[0].name == "a.weight");
    CHECK(file.tensors()[0].shape == std::vector<std::int64_t>{3, 4});
    std::vector<float> quarters(12);
    for (std::size_t i = 0; i < 12; ++i) quarters[i] = static_cast<float>(i) / 4;
    CHECK(values_of<float>(file, "a.weight") == quarters);
    CHECK(tensor_named(file, "a.bias").dtype == Dtype::kF16);
    CHECK(lvggt::to_float(values_of<lvggt::float16>(file, "a.bias")[2]) == 3.25f);
    CHECK(lvggt::to_float(values_of<lvggt::bfloat16>(file, "bf")[3]) == 1024.0f);
    CHECK(values_of<std::int64_t>(file, "count") == std::vector<std::int64_t>{7});
    CHECK(tensor_named(file, "count").shape.empty());
    CHECK(values_of<double>(file, "double") == std::vector<double>{0.1, 0.2});
    CHECK(values_of<std::uint8_t>(file, "mask") == std::vector<std::uint8_t>{1, 0, 1});
    CHECK(values_of<float>(file, "empty").empty());
    CHECK(values_of<float>(file, "param") == std::vector<float>{5, 6});
  }
}

TEST_CASE("PthFile: transposed, sliced and shared views of one storage come out row-major") {
  PthFile file(kGolden + "checkpoint_plain.pth");
  const std::vector<float> base = values_of<float>(file, "shared");
  REQUIRE(base.size() == 24);
  CHECK(base[23] == 23);
  CHECK(tensor_named(file, "transposed").shape == std::vector<std::int64_t>{6, 4});
  const std::vector<float> transposed = values_of<float>(file, "transposed");
  for (std::size_t i = 0; i < 24; ++i)
    CHECK(transposed[i] == static_cast<float>(i % 4 * 6 + i / 4));
  CHECK(values_of<float>(file, "slice") == std::vector<float>{8, 9, 10, 14, 15, 16});
}

TEST_CASE("PthFile: a state dict under model_state_dict is found and 'module.' taken off") {
  PthFile file(kGolden + "checkpoint_nested.pth");
  REQUIRE(file.notes().size() == 2);
  CHECK(file.notes()[0].find("'model_state_dict'; the 7 other entries") != std::string::npos);
  CHECK(file.notes()[1].find("'module.'") != std::string::npos);
  CHECK(values_of<float>(file, "0.weight") == std::vector<float>{0, 1, 2, 3, 4, 5});
  CHECK(values_of<float>(file, "1.bias") == std::vector<float>{30, 31, 32});
  CHECK(values_of<std::int64_t>(file, "1.num_batches_tracked") == std::vector<std::int64_t>{0});
}

TEST_CASE("PthFile: a file of PyTorch before 1.6 is named as such") {
  const Outcome outcome = outcome_of([] { PthFile(kGolden + "checkpoint_legacy.pth"); });
  CHECK(outcome.kind == ErrorKind::kFormat);
  CHECK(outcome.says("old PyTorch"));
}

TEST_CASE("PthFile: a written pickle of a tensor is read") {
  CHECK(open_pickle(one_tensor(0, {2, 2}, {2, 1})).accepted);
  CHECK(open_pickle(one_tensor(3, {}, {})).accepted);
  CHECK(open_pickle(one_tensor(0, {0, 5}, {5, 1})).accepted);
}

TEST_CASE("B15: instructions outside of the allowed ones are refused by name") {
  const auto bare = [](std::string_view code) {
    return open_pickle(PickleWriter().raw(code).done());
  };
  for (const std::string& code :
       {std::string("i"
                    "os\nsystem\n"),
        std::string("(os\n"), std::string("\x81"), std::string("\x92"), std::string("\x82\x01"),
        std::string("S'x'\n"), std::string("I1\n"), std::string("Pid\n"), std::string("\x97"),
        std::string("\xff"), std::string("2"), std::string("1")})
    CHECK(bare(code).kind == ErrorKind::kUnsupported);
  check_fault(bare("\x81"), ErrorKind::kUnsupported, "the instruction 0x81 is refused");
  check_fault(open_pickle("\x80\x09."), ErrorKind::kUnsupported, "protocol 9");
}

TEST_CASE("B16: functions outside of the allowed ones are refused by name") {
  const auto global = [](const char* module, const char* name) {
    return open_pickle(PickleWriter().global(module, name).done());
  };
  check_fault(global("builtins", "eval"), ErrorKind::kUnsupported,
              "the function builtins.eval is refused");
  check_fault(global("torch", "load"), ErrorKind::kUnsupported, "torch.load");
  check_fault(global("torch", "ComplexFloatStorage"), ErrorKind::kUnsupported,
              "torch.ComplexFloatStorage");
  check_fault(global("argparse", "Namespace"), ErrorKind::kUnsupported, "argparse.Namespace");
  check_fault(global("torch._utils", "_rebuild_tensor_v2\r"), ErrorKind::kUnsupported,
              "_rebuild_tensor_v2?");
  check_fault(open_pickle(PickleWriter().text("os").text("system").op(0x93).done()),
              ErrorKind::kUnsupported, "os.system");
}

TEST_CASE("B17: persistent ids that are not those of a storage are refused") {
  const auto id = [](const PickleWriter& writer) {
    return open_pickle(PickleWriter(writer).op('Q').done());
  };
  check_fault(id(PickleWriter().integer(1)), ErrorKind::kFormat, "persistent id");
  check_fault(id(PickleWriter().op(')')), ErrorKind::kFormat, "persistent id");
  check_fault(id(PickleWriter().text("storage")), ErrorKind::kFormat, "persistent id");
  const auto parts = [&](const char* word, std::int64_t size) {
    return id(PickleWriter()
                  .op('(')
                  .text(word)
                  .global("torch", "FloatStorage")
                  .text("0")
                  .text("cpu")
                  .integer(size)
                  .op('t'));
  };
  check_fault(parts("module", 4), ErrorKind::kFormat, "persistent id");
  check_fault(parts("storage", -4), ErrorKind::kFormat, "negative size");
  check_fault(open_pickle(one_tensor(0, {4}, {1}, 5)), ErrorKind::kFormat,
              "has 16 bytes, but 5 elements");
  check_fault(open_pickle(one_tensor(0, {4}, {1}, INT64_MAX)), ErrorKind::kFormat, "has 16 bytes");
  const std::string missing =
      PickleWriter().op('}').text("w").tensor("FloatStorage", "7", 4, 0, {4}, {1}).op('s').done();
  check_fault(open_pickle(missing), ErrorKind::kFormat, "data/7 is missing");
}

TEST_CASE("B18: views that reach past their storage, or multiply it, are refused") {
  check_fault(open_pickle(one_tensor(1, {4}, {1})), ErrorKind::kFormat, "reaches past");
  check_fault(open_pickle(one_tensor(0, {2, 2}, {3, 1})), ErrorKind::kFormat, "reaches past");
  check_fault(open_pickle(one_tensor(INT64_MAX, {4}, {1})), ErrorKind::kFormat, "reaches past");
  check_fault(open_pickle(one_tensor(0, {2, 2}, {INT64_MAX, INT64_MAX})), ErrorKind::kFormat,
              "reaches past");
  check_fault(open_pickle(one_tensor(-1, {4}, {1})), ErrorKind::kFormat, "negative");
  check_fault(open_pickle(one_tensor(3, {4}, {-1})), ErrorKind::kFormat, "negative");
  check_fault(open_pickle(one_tensor(0, {-4}, {1})), ErrorKind::kFormat, "negative");
  check_fault(open_pickle(one_tensor(0, {1LL << 40}, {0})), ErrorKind::kFormat, "repeats elements");
  check_fault(open_pickle(one_tensor(0, {1LL << 40, 1LL << 40}, {0, 0})), ErrorKind::kFormat,
              "too many elements");
  check_fault(open_pickle(one_tensor(0, {4}, {})), ErrorKind::kFormat,
              "1 dimensions but 0 strides");
  check_fault(
      open_pickle(one_tensor(0, std::vector<std::int64_t>(9, 1), std::vector<std::int64_t>(9, 1))),
      ErrorKind::kLimit, "more than 8 dimensions");
  PickleWriter many;
  many.op('}').op('(');
  for (int i = 0; i < 2000; ++i)
    many.text(std::to_string(i)).tensor("FloatStorage", "0", 1024, 0, {1024}, {1});
  const TempDir dir;
  write_pth(dir / "a.pth", many.op('u').done(), {{"0", std::string(4096, '\1')}});
  check_fault(outcome_of([&] { PthFile(dir / "a.pth"); }), ErrorKind::kLimit, "share storages");
}

TEST_CASE("B19: a memo index that was never set is refused") {
  check_fault(open_pickle(PickleWriter().op('h').byte(0).done()), ErrorKind::kFormat,
              "the memo has no value 0");
  check_fault(open_pickle(PickleWriter().op('j').u32(0xffffffffu).done()), ErrorKind::kFormat,
              "the memo has no value 4294967295");
  check_fault(open_pickle(PickleWriter().op('q').byte(0).done()), ErrorKind::kFormat,
              "the stack is empty");
}

TEST_CASE("B20: values nested 100,000 deep, or inside themselves, do no harm") {
  PickleWriter tuples;
  tuples.op(')');
  for (int i = 0; i < 100'000; ++i) tuples.op(0x85);
  check_fault(open_pickle(tuples.done()), ErrorKind::kUnsupported,
              "something else than a dictionary");
  PickleWriter dicts;
  for (int i = 0; i < 100'000; ++i) dicts.op('}').text("model");
  dicts.op('}');
  for (int i = 0; i < 100'000; ++i) dicts.op('s');
  check_fault(open_pickle(dicts.done()), ErrorKind::kUnsupported, "nests the weights");
  const std::string loop =
      PickleWriter().op('}').op('q').byte(0).text("model").op('h').byte(0).op('s').done();
  check_fault(open_pickle(loop), ErrorKind::kUnsupported, "nests the weights");
}

TEST_CASE("B21: a pickle that would run os.system is refused and runs nothing") {
  const TempDir dir;
  const std::string proof = dir / "executed";
  const std::string command = "touch " + proof;
  const std::string reduce =
      PickleWriter().global("os", "system").op('(').text(command).op('t').op('R').done();
  const std::string posix =
      PickleWriter().global("posix", "system").op('(').text(command).op('t').op('R').done();
  const std::string stack = PickleWriter()
                                .text("os")
                                .text("system")
                                .op(0x93)
                                .op('(')
                                .text(command)
                                .op('t')
                                .op('R')
                                .done();
  const std::string instance = PickleWriter().op('(').text(command).raw("ios\nsystem\n").done();
  for (const std::string& pickle : {reduce, posix, stack, instance}) {
    const Outcome outcome = open_pickle(pickle);
    CAPTURE(outcome.message);
    CHECK(outcome.kind == ErrorKind::kUnsupported);
    CHECK_FALSE(std::filesystem::exists(proof));
  }
}

TEST_CASE("PthFile: names that safetensors could not hold are refused") {
  for (const char* name : {"a\nb", "\x1b[2J", "../a"}) {
    const std::string pickle = PickleWriter()
                                   .op('}')
                                   .text(name)
                                   .tensor("FloatStorage", "0", 4, 0, {4}, {1})
                                   .op('s')
                                   .done();
    check_fault(open_pickle(pickle), ErrorKind::kFormat, "in the state dict contains");
  }
}

TEST_CASE("PthFile: broken pickles are refused") {
  CHECK(open_pickle("").kind == ErrorKind::kFormat);
  const std::string whole = one_tensor(0, {4}, {1});
  for (std::size_t n = 0; n < whole.size(); ++n)
    CHECK_FALSE(open_pickle(whole.substr(0, n)).accepted);
  for (const char* code :
       {"t",    "s",  "u",  "a",     "e",    "R",     "b",   "Q",   "0",   "\x85",
        "\x87", "(.", "NN", "]Na.x", "}NNs", "(NNuu", "NNR", "N)R", "]N.", "}]b"})
    CHECK_FALSE(open_pickle(PickleWriter().raw(code).done()).accepted);
  check_fault(open_pickle(PickleWriter().op('}').done()), ErrorKind::kFormat, "holds no tensors");
  check_fault(open_pickle(PickleWriter().op('N').done()), ErrorKind::kUnsupported,
              "something else");
  const std::string twice = PickleWriter()
                                .op('}')
                                .op('(')
                                .text("w")
                                .tensor("FloatStorage", "0", 4, 0, {4}, {1})
                                .text("w")
                                .tensor("FloatStorage", "0", 4, 0, {4}, {1})
                                .op('u')
                                .done();
  check_fault(open_pickle(twice), ErrorKind::kFormat, "'w' is there twice");
}
