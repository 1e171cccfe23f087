// SPDX-License-Identifier: Apache-2.0
// Files that must be refused: structure of the file and of its header.
#include <doctest/doctest.h>

#include <cstdint>
#include <string>
#include <vector>

#include "tests/support/safetensors_bytes.h"

using lvggt::ErrorKind;
using lvggt::test::open_bytes;
using lvggt::test::open_header;
using lvggt::test::Outcome;
using lvggt::test::safetensors_bytes;

namespace {

constexpr const char* kOne = R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}})";

void check_fault(const Outcome& outcome, ErrorKind kind, const char* says) {
  CAPTURE(outcome.message);
  CHECK_FALSE(outcome.accepted);
  CHECK(outcome.kind == kind);
  CHECK(outcome.says("weights.safetensors"));
  CHECK(outcome.says(says));
}

void check_format(const Outcome& outcome, const char* says) {
  check_fault(outcome, ErrorKind::kFormat, says);
}

// A header with one tensor 'a' that has this dtype, shape and these data offsets.
Outcome open_entry(const std::string& dtype, const std::string& shape, const std::string& offsets,
                   std::size_t num_bytes = 4) {
  return open_header("{\"a\":{\"dtype\":\"" + dtype + "\",\"shape\":" + shape +
                         ",\"data_offsets\":" + offsets + "}}",
                     std::string(num_bytes, '\1'));
}

}  // namespace

TEST_CASE("A01: an empty file is refused") { check_format(open_bytes(""), "it is empty"); }

TEST_CASE("A02: a file of 1 to 7 bytes is refused") {
  for (std::size_t n = 1; n < 8; ++n)
    check_format(open_bytes(std::string(n, '\1')), "fewer than the 8");
}

TEST_CASE("A03: header length 0 is refused") {
  check_format(open_bytes(safetensors_bytes(0, "", "")), "header length at byte 0 is 0");
  check_format(open_bytes(safetensors_bytes(0, "{}", "")), "header length at byte 0 is 0");
}

TEST_CASE("A04: header length 100,000,001 is refused") {
  check_format(open_bytes(safetensors_bytes(100'000'001, "{}")), "100000001");
  lvggt::Limits limits;
  limits.header_bytes = 10;  // the same with a file long enough
  check_fault(open_bytes(safetensors_bytes(std::string("{}         ")), limits), ErrorKind::kLimit,
              "above the limit of 10");
  CHECK(lvggt::Limits{}.header_bytes == 100'000'000);
}

TEST_CASE("A05: header length 2^64-1, which wraps when 8 is added, is refused") {
  for (const std::uint64_t length :
       {~std::uint64_t{0}, ~std::uint64_t{0} - 7, std::uint64_t{1} << 63})
    check_format(open_bytes(safetensors_bytes(length, "{}")), "but only 2 bytes follow");
}

TEST_CASE("A06: header length one byte past the end is refused") {
  check_format(open_bytes(safetensors_bytes(3, "{}")), "is 3, but only 2 bytes follow");
}

TEST_CASE("A07: a header that is not UTF-8 is refused") {
  for (const char* bad : {"\xff", "\xc0\xaf", "\xed\xa0\x80", "\xf5\x80\x80\x80", "\xe2\x82"})
    check_format(open_header("{\"" + std::string(bad) +
                             "\":{\"dtype\":\"F32\",\"shape\":[0],"
                             "\"data_offsets\":[0,0]}}"),
                 "not valid JSON at byte");
}

TEST_CASE("A08: a header that is not JSON, or cut in the middle, is refused") {
  check_format(open_header("hello!"), "not valid JSON at byte");
  check_format(open_header(std::string("{}\0\0", 4)), "zero byte");
  const std::string whole = kOne;
  for (std::size_t n = 2; n < whole.size(); ++n)
    check_format(open_header(whole.substr(0, n), "1234"), "not valid JSON at byte");
}

TEST_CASE("A09: a header that is an array, number, string or null is refused") {
  check_format(open_header("[]"), "is an array");
  check_format(open_header("42"), "is a number");
  check_format(open_header("\"a\""), "is a string");
  check_format(open_header("null"), "is null");
  check_format(open_header("true"), "is true");
  check_format(open_header(R"({"a":3})"), "the entry is a number");
  check_format(open_header(R"({"a":[]})"), "the entry is an array");
}

TEST_CASE("A10: a second value or garbage after the header's object is refused") {
  for (const char* header : {"{}{}", "{} x", "{}]", "{},"})
    check_format(open_header(header), "not valid JSON");
  check_format(open_header(std::string("{}\0{}", 5)), "zero byte");
}

TEST_CASE(
    "A11, A12, A13: one tensor name twice is refused, equal, different or through an escape") {
  const std::string a = R"("a":{"dtype":"F32","shape":[1],"data_offsets":[0,4]})";
  const std::string other = R"("a":{"dtype":"F32","shape":[1],"data_offsets":[4,8]})";
  const std::string escaped = R"("\u0061":{"dtype":"F32","shape":[1],"data_offsets":[4,8]})";
  check_format(open_header("{" + a + "," + a + "}", "1234"), "'a' is there twice");
  check_format(open_header("{" + a + "," + other + "}", "12345678"), "'a' is there twice");
  check_format(open_header("{" + a + "," + escaped + "}", "12345678"), "'a' is there twice");
}

TEST_CASE("A14: a field twice in one entry is refused") {
  check_format(
      open_header(R"({"a":{"dtype":"F32","dtype":"F32","shape":[1],"data_offsets":[0,4]}})",
                  "1234"),
      "dtype is there twice");
  check_format(
      open_header(R"({"a":{"dtype":"F32","shape":[1],"shape":[1],"data_offsets":[0,4]}})", "1234"),
      "shape is there twice");
  check_format(
      open_header(R"({"a":{"dtype":"F32","shape":[1],"data_offsets":[0,4],"data_offsets":[0,4]}})",
                  "1234"),
      "data_offsets is there twice");
}

TEST_CASE("A15: a missing field is refused") {
  check_format(open_header(R"({"a":{"shape":[1],"data_offsets":[0,4]}})", "1234"),
               "dtype is missing");
  check_format(open_header(R"({"a":{"dtype":"F32","data_offsets":[0,4]}})", "1234"),
               "shape is missing");
  check_format(open_header(R"({"a":{"dtype":"F32","shape":[1]}})", "1234"),
               "data_offsets is missing");
  check_format(open_header(R"({"a":{}})"), "is missing");
  check_format(open_header(R"({"a":{"dtype":3,"shape":[1],"data_offsets":[0,4]}})", "1234"),
               "not a string");
  check_format(open_header(R"({"a":{"dtype":"F32","shape":{},"data_offsets":[0,4]}})", "1234"),
               "the field shape is an object");
  check_format(open_header(R"({"a":{"dtype":"F32","shape":1,"data_offsets":[0,4]}})", "1234"),
               "the field shape is a number");
}

TEST_CASE("A16, A17: an unknown or unsupported element type is refused by its name") {
  for (const char* dtype : {"F31", "f32", "", "F8_E4M3", "F8_E5M2", "F4", "C64"})
    check_fault(open_entry(dtype, "[1]", "[0,4]"), ErrorKind::kUnsupported, dtype);
}

TEST_CASE("A18, A19, A20: a dimension that is not a whole number from 0 to 2^63-1 is refused") {
  for (const char* dimension : {"-1", "-0", "1.5", "1e3", "\"3\"", "true", "null", "{}", "[1]",
                                "18446744073709551616", "9223372036854775808", "1e400"}) {
    CAPTURE(dimension);
    const Outcome outcome = open_entry("F32", "[" + std::string(dimension) + "]", "[0,4]");
    CAPTURE(outcome.message);
    CHECK_FALSE(outcome.accepted);
    CHECK(outcome.kind == ErrorKind::kFormat);
  }
  check_format(open_entry("F32", "[9223372036854775807]", "[0,4]"), "too many elements");
}

TEST_CASE("A21, A22, A23: a size that overflows is refused wherever a 0 stands") {
  check_format(open_entry("F32", "[4294967296,4294967296]", "[0,4]"), "too many elements");
  check_format(open_entry("F32", "[2305843009213693952]", "[0,4]"), "too many elements");
  check_format(open_entry("F32", "[4294967296,4294967296,0]", "[0,0]", 0), "too many elements");
  check_format(open_entry("F32", "[0,4294967296,4294967296]", "[0,0]", 0), "too many elements");
}

TEST_CASE("A24: more than 8 dimensions are refused") {
  const auto ones = [](std::size_t rank) {
    std::string text = "[1";
    for (std::size_t i = 1; i < rank; ++i) text += ",1";
    return text + "]";
  };
  CHECK(open_entry("F32", ones(8), "[0,4]").accepted);
  check_fault(open_entry("F32", ones(9), "[0,4]"), ErrorKind::kLimit, "more than 8 dimensions");
  check_fault(open_entry("F32", ones(1'000'000), "[0,4]"), ErrorKind::kLimit,
              "more than 8 dimensions");
}

TEST_CASE("A25, A26: offsets that run backwards or do not fit the shape are refused") {
  check_format(open_entry("F32", "[1]", "[4,0]"), "before their begin");
  check_format(open_entry("F32", "[2]", "[0,4]"), "span 4 bytes, but shape [2] of F32 needs 8");
  check_format(open_entry("F16", "[1]", "[0,4]"), "span 4 bytes, but shape [1] of F16 needs 2");
  check_format(open_entry("F32", "[]", "[0,0]", 0), "needs 4");
  check_format(open_entry("F32", "[0]", "[0,4]"), "needs 0");
}

TEST_CASE("A27, A28, A29: a hole at the start or between tensors, and an overlap, are refused") {
  const auto two = [](const char* a, const char* b) {
    return open_header(
        "{\"a\":{\"dtype\":\"F32\",\"shape\":[1],\"data_offsets\":" + std::string(a) +
            "},\"b\":{\"dtype\":\"F32\",\"shape\":[1],\"data_offsets\":" + b + "}}",
        std::string(12, '\1'));
  };
  check_format(two("[4,8]", "[8,12]"),
               "bytes 0 to 4 of the data, before tensor 'a', belong to no tensor");
  check_format(two("[0,4]", "[8,12]"), "bytes 4 to 8 of the data, before tensor 'b'");
  check_format(two("[0,4]", "[2,6]"), "inside another tensor");
  check_format(two("[4,8]", "[0,4]"), "4 bytes after the last tensor");
  check_format(two("[0,4]", "[0,4]"), "inside another tensor");
}

TEST_CASE("A30: 100,000 tensors on one range are refused") {
  std::string header = "{";
  for (int i = 0; i < 100'000; ++i)
    header += (i == 0 ? "\"" : ",\"") + std::to_string(i) +
              R"(":{"dtype":"F32","shape":[1],"data_offsets":[0,4]})";
  check_format(open_header(header + "}", "1234"), "inside another tensor");
}

TEST_CASE("A31, A32: a byte too many or too few after the last tensor is refused") {
  CHECK(open_header(kOne, "1234").accepted);
  check_format(open_header(kOne, "12345"), "1 bytes after the last tensor");
  check_format(open_header(kOne, "123"), "incomplete download");
}

TEST_CASE("A33: a real file cut at any 64th of its length is refused") {
  const lvggt::test::TempDir dir;
  lvggt::SafetensorsWriter out(dir / "real");
  out.set_metadata("key", "value");
  for (int i = 0; i < 20; ++i)
    out.add("layer." + std::to_string(i) + ".weight", {5, 7}, std::vector<float>(35, 0.5f));
  out.finish();
  const std::string whole = lvggt::read_text_file(dir / "real");
  CHECK(open_bytes(whole).accepted);
  for (std::size_t i = 0; i < 64; ++i) {
    const Outcome outcome = open_bytes(std::string_view(whole).substr(0, whole.size() * i / 64));
    CAPTURE(outcome.message);
    CHECK_FALSE(outcome.accepted);
    CHECK(outcome.kind == ErrorKind::kFormat);
  }
}

TEST_CASE("A34: data offsets that are not two whole numbers are refused") {
  for (const char* offsets :
       {"[-4,0]", "[0,4.0]", "[0,4e0]", "[0,9007199254740996]", "[0,18446744073709551620]",
        "[0,4,8]", "[4]", "[]", "[null,4]", "[\"0\",4]", "{}", "4", "\"0,4\""}) {
    CAPTURE(offsets);
    const Outcome outcome = open_entry("F32", "[1]", offsets);
    CAPTURE(outcome.message);
    CHECK_FALSE(outcome.accepted);
    CHECK(outcome.kind == ErrorKind::kFormat);
  }
}

TEST_CASE("A35: metadata that is not an object of strings is refused") {
  check_format(open_header(R"({"__metadata__":{"a":1}})"), "'a' is a number, not a string");
  check_format(open_header(R"({"__metadata__":{"a":{}}})"), "'a' is an object, not a string");
  check_format(open_header(R"({"__metadata__":[]})"), "__metadata__ is an array");
  check_format(open_header(R"({"__metadata__":null})"), "__metadata__ is null");
  check_format(
      open_header(R"({"__metadata__":{"dtype":"F32","shape":[1],"data_offsets":[0,4]}})", "1234"),
      "'shape' is an array, not a string");
  check_format(open_header(R"({"__metadata__":{},"__metadata__":{}})"), "twice");
  check_format(open_header(R"({"__metadata__":{"a":"1","a":"1"}})"), "twice");
}

TEST_CASE("A36: values nested 1,000,000 deep are refused") {
  check_fault(open_header("{\"a\":{\"x\":" + std::string(1'000'000, '[')), ErrorKind::kLimit,
              "64 deep");
  std::string objects;
  for (int i = 0; i < 1'000'000; ++i) objects += "{\"a\":";
  check_fault(open_header("{\"a\":{\"x\":" + objects), ErrorKind::kLimit, "64 deep");
  check_format(open_header(std::string(1'000'000, '[')), "is an array");
}

TEST_CASE("A37: 1,000,001 tensors, and names that are too long or unfit, are refused") {
  std::string header = "{";
  for (int i = 0; i < 1'000'001; ++i)
    header += (i == 0 ? "\"" : ",\"") + std::to_string(i) +
              R"(":{"dtype":"U8","shape":[0],"data_offsets":[0,0]})";
  check_fault(open_header(header + "}"), ErrorKind::kLimit, "more than 1000000 tensors");

  const auto named = [](const std::string& name) {
    return open_header("{\"" + name + R"(":{"dtype":"U8","shape":[0],"data_offsets":[0,0]}})");
  };
  CHECK(named(std::string(1024, 'n')).accepted);
  check_fault(named(std::string(1025, 'n')), ErrorKind::kLimit, "more than the limit of 1024");
  check_fault(named(std::string(1 << 20, 'n')), ErrorKind::kLimit, "more than the limit of 1024");
  for (const char* name : {"a\\u0000b", "a\\nb", "a\\u001bb", "\\u007f"})
    check_format(named(name), "contains a control character");
  for (const char* name : {"../a", "a/../b", "..", "a/..", "..\\\\a"})
    check_format(named(name), "'..'");
  CHECK(named("a..b").accepted);
}
