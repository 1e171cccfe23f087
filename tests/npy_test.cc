// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/npy.h"

#include <doctest/doctest.h>

#include <cstring>
#include <string>
#include <vector>

#include "lvggt/core/float16.h"
#include "tests/support/files.h"
#include "tests/support/safetensors_bytes.h"
#include "tests/support/temp_dir.h"

using namespace lvggt;
using std::string_literals::operator""s;

namespace {

std::string little_endian(std::uint64_t value, int num_bytes) {
  std::string bytes;
  for (int i = 0; i < num_bytes; ++i) bytes += static_cast<char>(value >> (8 * i) & 0xff);
  return bytes;
}

// A file of format `major`.0 with this header text.
std::string npy(const std::string& header, const std::string& data, int major = 1) {
  return "\x93NUMPY"s + static_cast<char>(major) + '\0' +
         little_endian(header.size(), major == 1 ? 2 : 4) + header + data;
}

std::string header(const std::string& descr, const std::string& shape,
                   const std::string& order = "False") {
  return "{'descr': '" + descr + "', 'fortran_order': " + order + ", 'shape': " + shape + ", }";
}

template <class T>
std::string bytes_of(std::initializer_list<T> values) {
  std::string bytes(values.size() * sizeof(T), '\0');
  std::memcpy(bytes.data(), values.begin(), bytes.size());
  return bytes;
}

test::Outcome open_npy(const std::string& bytes) {
  const test::TempDir dir;
  const std::string path = dir / "array.npy";
  test::write_bytes(path, bytes);
  test::Outcome outcome = test::outcome_of([&] { NpyFile file(path); });
  if (!outcome.accepted && !outcome.says(path))
    outcome.message = "the file is not named: " + outcome.message;
  return outcome;
}

void check_refused(const std::string& bytes, ErrorKind kind, const std::string& says) {
  const test::Outcome outcome = open_npy(bytes);
  INFO(outcome.message);
  CHECK_FALSE(outcome.accepted);
  CHECK(outcome.kind == kind);
  CHECK(outcome.says(says));
}

std::vector<float> floats_in(const std::string& bytes) {
  const test::TempDir dir;
  test::write_bytes(dir / "array.npy", bytes);
  const NpyFile file(dir / "array.npy");
  std::vector<float> values(static_cast<std::size_t>(file.size()));
  file.read_part(0, std::span(values));
  return values;
}

std::vector<std::int64_t> integers_in(const std::string& bytes) {
  const test::TempDir dir;
  test::write_bytes(dir / "array.npy", bytes);
  const NpyFile file(dir / "array.npy");
  std::vector<std::int64_t> values(static_cast<std::size_t>(file.size()));
  file.read_part(0, std::span(values));
  return values;
}

const std::string kFine = npy(header("<f4", "(2,)"), bytes_of<float>({1, 2}));

}  // namespace

TEST_CASE("npy: every number type is read as float and, if whole, as integer") {
  using Floats = std::vector<float>;
  using Integers = std::vector<std::int64_t>;
  const Floats floats{3, -2};
  const Integers integers{3, -2};
  const auto check = [&](const std::string& descr, const std::string& data) {
    INFO(descr);
    const std::string bytes = npy(header(descr, "(2,)"), data);
    CHECK(floats_in(bytes) == floats);
    CHECK(integers_in(bytes) == integers);
  };
  check("<f4", bytes_of<float>({3, -2}));
  check("<f8", bytes_of<double>({3, -2}));
  check("<f2", bytes_of<std::uint16_t>({to_float16(3).bits, to_float16(-2).bits}));
  check("|i1", bytes_of<std::int8_t>({3, -2}));
  check("<i2", bytes_of<std::int16_t>({3, -2}));
  check("<i4", bytes_of<std::int32_t>({3, -2}));
  check("<i8", bytes_of<std::int64_t>({3, -2}));
  check("=i8", bytes_of<std::int64_t>({3, -2}));
  const auto check_unsigned = [&](const std::string& descr, const std::string& data) {
    CHECK(integers_in(npy(header(descr, "(2,)"), data)) == Integers{200, 1});
    CHECK(floats_in(npy(header(descr, "(2,)"), data)) == Floats{200, 1});
  };
  check_unsigned("|u1", bytes_of<std::uint8_t>({200, 1}));
  check_unsigned("<u2", bytes_of<std::uint16_t>({200, 1}));
  check_unsigned("<u4", bytes_of<std::uint32_t>({200, 1}));
  check_unsigned("<u8", bytes_of<std::uint64_t>({200, 1}));
  CHECK(integers_in(npy(header("|b1", "(2,)"), bytes_of<std::uint8_t>({1, 0}))) == Integers{1, 0});
}

TEST_CASE("npy: versions 1, 2 and 3, keys in any order, double quotes and no padding are read") {
  for (const int major : {1, 2, 3})
    CHECK(floats_in(npy(header("<f4", "(2,)"), bytes_of<float>({1, 2}), major)) ==
          std::vector<float>{1, 2});
  const std::string turned =
      "{\"shape\": (1, 2), \"fortran_order\": False, \"descr\": \"<f4\"}   \n";
  CHECK(floats_in(npy(turned, bytes_of<float>({1, 2}))) == std::vector<float>{1, 2});
  // Python 2 wrote long integers with an L.
  CHECK(floats_in(npy(header("<f4", "(2L,)"), bytes_of<float>({1, 2}))).size() == 2);
}

TEST_CASE("npy: parts are read in row-major order") {
  const test::TempDir dir;
  test::write_bytes(dir / "a.npy",
                    npy(header("<i2", "(2, 3)"), bytes_of<std::int16_t>({0, 1, 2, 3, 4, 5})));
  const NpyFile file(dir / "a.npy");
  CHECK(file.shape() == std::vector<std::int64_t>{2, 3});
  CHECK(file.dtype() == Dtype::kI16);
  std::vector<std::int64_t> part(3);
  file.read_part(2, std::span(part));
  CHECK(part == std::vector<std::int64_t>{2, 3, 4});
  CHECK_THROWS_AS(file.read_part(4, std::span(part)), Error);
  CHECK_THROWS_AS(file.read<3>(), Error);
  CHECK(file.read<2>()(1, 0) == 3);
}

TEST_CASE("npy: values that are no whole numbers are refused as integers, by element") {
  const auto refused = [](const std::string& bytes) {
    return test::outcome_of([&] { integers_in(bytes); });
  };
  const auto half = refused(npy(header("<f4", "(3,)"), bytes_of<float>({1, 0.5f, 2})));
  CHECK(half.kind == ErrorKind::kFormat);
  CHECK(half.says("element 1 is 0.5"));
  CHECK(refused(npy(header("<f8", "(1,)"), bytes_of<double>({std::nan("")}))).says("nan"));
  CHECK_FALSE(refused(npy(header("<f8", "(1,)"), bytes_of<double>({1e300}))).accepted);
  CHECK(refused(npy(header("<u8", "(1,)"), bytes_of<std::uint64_t>({~std::uint64_t{0}})))
            .says("2^63"));
}

TEST_CASE("B01: what does not start as a .npy file is refused") {
  check_refused("", ErrorKind::kFormat, "empty");
  check_refused("\x93NUM", ErrorKind::kFormat, "does not start");
  check_refused("PK\3\4" + std::string(100, 'x'), ErrorKind::kFormat, "zip");
  check_refused("\x80\x04" + std::string(100, 'x'), ErrorKind::kFormat, "pickle");
  std::string damaged = kFine;
  damaged[1] = 'X';
  check_refused(damaged, ErrorKind::kFormat, "does not start");
}

TEST_CASE("B02: an unknown format version is refused") {
  check_refused(npy(header("<f4", "(2,)"), bytes_of<float>({1, 2}), 4), ErrorKind::kUnsupported,
                "4.0");
  check_refused(npy(header("<f4", "(2,)"), bytes_of<float>({1, 2}), 0), ErrorKind::kUnsupported,
                "0.0");
}

TEST_CASE("B03: a header that reaches beyond the end of the file is refused") {
  for (std::size_t length = 8; length < kFine.size() - 8; ++length)
    check_refused(kFine.substr(0, length), ErrorKind::kFormat, "array.npy");
}

TEST_CASE("B04: a header of 4 GiB is refused without reading it") {
  check_refused("\x93NUMPY\2\0\xff\xff\xff\xff"s + std::string(100, ' '), ErrorKind::kFormat,
                "beyond the end");
  check_refused(npy(header("<f4", "(2,)") + std::string(70'000, ' '), bytes_of<float>({1, 2}), 2),
                ErrorKind::kLimit, "limit");
}

TEST_CASE("B05: an array of Python objects is refused, with how to convert it") {
  check_refused(npy(header("|O", "(2,)"), std::string(16, '\0')), ErrorKind::kUnsupported,
                "numpy.save");
}

TEST_CASE("B06: records, text, dates, complex and big-endian numbers are refused by name") {
  check_refused(
      npy("{'descr': [('a', '<f4')], 'fortran_order': False, 'shape': (2,), }", "12345678"),
      ErrorKind::kUnsupported, "records");
  for (const char* descr : {"<U2", "|S4", "<M8[s]", "<m8", "<c8", "|V4", "<f16", "", "f"})
    check_refused(npy(header(descr, "(2,)"), std::string(8, '\0')), ErrorKind::kUnsupported,
                  "type '" + std::string(descr));
  check_refused(npy(header(">f4", "(2,)"), bytes_of<float>({1, 2})), ErrorKind::kUnsupported,
                "big-endian");
  CHECK(floats_in(npy(header(">u1", "(2,)"), "\1\2")) == std::vector<float>{1, 2});
}

TEST_CASE("B07: Fortran order is read as what it means, also in parts") {
  const test::TempDir dir;
  // Columns of [[0, 1, 2], [3, 4, 5]].
  test::write_bytes(dir / "a.npy",
                    npy(header("<f4", "(2, 3)", "True"), bytes_of<float>({0, 3, 1, 4, 2, 5})));
  const NpyFile file(dir / "a.npy");
  std::vector<float> part(4);
  file.read_part(1, std::span(part));
  CHECK(part == std::vector<float>{1, 2, 3, 4});
  const Tensor<float, 2> all = file.read<2>();
  CHECK(all(1, 2) == 5);
  CHECK(all(0, 1) == 1);
  // Three dimensions: element (i, j, k) of [2, 3, 2] stands at i + 2 j + 6 k.
  std::string data;
  for (int at = 0; at < 12; ++at) data += static_cast<char>(at);
  const auto values = integers_in(npy(header("|i1", "(2, 3, 2)", "True"), data));
  for (std::int64_t i = 0; i < 2; ++i)
    for (std::int64_t j = 0; j < 3; ++j)
      for (std::int64_t k = 0; k < 2; ++k)
        CHECK(values[static_cast<std::size_t>((i * 3 + j) * 2 + k)] == i + 2 * j + 6 * k);
}

TEST_CASE("B08: headers with code or other than the three keys, each once, are refused") {
  const std::string data = bytes_of<float>({1, 2});
  for (const char* text :
       {"",
        "{",
        "{}",
        "[]",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2,), ",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2,), }}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2,), } x",
        "{'descr': '<f4', 'fortran_order': False}",
        "{'descr': '<f4', 'shape': (2,)}",
        "{'fortran_order': False, 'shape': (2,)}",
        "{'descr': '<f4', 'descr': '<f4', 'fortran_order': False, 'shape': (2,)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2,), 'x': 1}",
        "{'descr': '<f4', 'fortran_order': 0, 'shape': (2,)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': [2]}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': 2}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': ((2,),)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (1+1,)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2.0,)}",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (True,)}",
        "{'descr': <f4, 'fortran_order': False, 'shape': (2,)}",
        "{'descr': __import__('os'), 'fortran_order': False, 'shape': (2,)}",
        "__import__('os').system('touch /tmp/never')",
        "{'descr': '<f4', 'fortran_order': False, 'shape': (2,) 'x'}"})
    check_refused(npy(text, data), ErrorKind::kFormat, "header");
  check_refused(npy(std::string(60'000, '['), data), ErrorKind::kFormat, "header");
}

TEST_CASE("B09: impossible shapes are refused; a scalar and an empty array are not") {
  const std::string data = bytes_of<float>({1});
  for (const char* shape : {"(-1,)", "(9223372036854775808,)", "(99999999999999999999,)",
                            "(4611686018427387904, 4)", "(9223372036854775807,)"})
    check_refused(npy(header("<f4", shape), data), ErrorKind::kFormat, "array.npy");
  check_refused(npy(header("<f4", "(1, 1, 1, 1, 1, 1, 1, 1, 1)"), data), ErrorKind::kLimit,
                "dimensions");
  CHECK(floats_in(npy(header("<f4", "()"), data)) == std::vector<float>{1});
  CHECK(floats_in(npy(header("<f4", "(0, 3)"), "")).empty());
  CHECK(floats_in(npy(header("<f4", "(3, 0)", "True"), "")).empty());
}

TEST_CASE("B10: fewer or more bytes than the shape are refused") {
  for (std::size_t cut = 1; cut <= 8; ++cut)
    check_refused(kFine.substr(0, kFine.size() - cut), ErrorKind::kFormat, "cut short");
  check_refused(kFine + "x", ErrorKind::kFormat, "9 bytes of data");
}

TEST_CASE("npy: what is written is read back and is laid out as numpy does") {
  const test::TempDir dir;
  Tensor<float, 3> values(Shape{2, 3, 4});
  for (std::int64_t i = 0; i < values.size(); ++i) values.data()[i] = 0.5f * static_cast<float>(i);
  write_npy(dir / "a.npy", values);
  const Tensor<float, 3> back = NpyFile(dir / "a.npy").read<3>();
  CHECK(std::memcmp(back.data(), values.data(), values.num_bytes()) == 0);
  const std::string bytes = test::read_bytes(dir / "a.npy");
  CHECK((bytes.size() - values.num_bytes()) % 64 == 0);
  CHECK(bytes[bytes.size() - values.num_bytes() - 1] == '\n');
  CHECK(bytes.find("{'descr': '<f4', 'fortran_order': False, 'shape': (2, 3, 4), }") == 10);

  Tensor<std::int8_t, 1> one(Shape{std::int64_t{3}});
  write_npy(dir / "b.npy", one);
  CHECK(test::read_bytes(dir / "b.npy")
            .find("{'descr': '|i1', 'fortran_order': False, 'shape': (3,), }") == 10);
  write_npy(dir / "c.npy", Dtype::kF64, {}, std::as_bytes(std::span("12345678", 8)));
  CHECK(NpyFile(dir / "c.npy").shape().empty());
  CHECK_THROWS_AS(write_npy(dir / "d.npy", Dtype::kBF16, {}, std::as_bytes(std::span("12", 2))),
                  Error);
  const std::vector<std::int64_t> wrong{5};
  CHECK_THROWS_AS(write_npy(dir / "d.npy", Dtype::kF32, wrong, {}), Error);
}
