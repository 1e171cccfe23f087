// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/json.h"

#include <doctest/doctest.h>

#include <string>

#include "lvggt/core/error.h"
#include "lvggt/io/atomic_file.h"
#include "tests/support/temp_dir.h"

using lvggt::ErrorKind;
using lvggt::Json;

namespace {

// Kind of the error that parsing ends in; the message must contain `expected`.
ErrorKind fault(const std::string& text, const std::string& expected) {
  try {
    Json::parse(text, "a.json");
  } catch (const lvggt::Error& error) {
    CAPTURE(text);
    const std::string message = error.what();
    CAPTURE(message);
    CHECK(message.starts_with("a.json: "));
    CHECK(message.find(expected) != std::string::npos);
    return error.kind();
  }
  FAIL("accepted: ", text);
  return ErrorKind::kUsage;
}

}  // namespace

TEST_CASE("Json: values keep their kind and order") {
  const Json json = Json::parse(
      "{\"b\": [1, -2, 2.5, 1e3],\r\n \"a\": {\"s\": \"\\u00e9\", \"t\": true, \"n\": null}}", "x");
  REQUIRE(json.is_object());
  CHECK(json.as_object("x")[0].first == "b");
  const auto& array = json.find("b")->as_array("b");
  REQUIRE(array.size() == 4);
  CHECK(array[0].as_int64("b[0]") == 1);
  CHECK(array[1].as_int64("b[1]") == -2);
  CHECK(array[2].as_double("b[2]") == 2.5);
  CHECK_FALSE(array[3].is_integer());
  CHECK(array[3].as_double("b[3]") == 1000);
  CHECK(json.find("a")->find("s")->as_string("s") == "\xc3\xa9");
  CHECK(json.find("a")->find("t")->as_bool("t"));
  CHECK(json.find("a")->find("n")->is_null());
  CHECK(json.find("c") == nullptr);
}

TEST_CASE("Json: an accessor names the place and both kinds") {
  const Json json = Json::parse("{\"a\": \"3\"}", "x");
  CHECK_THROWS_WITH(json.find("a")->as_int64("x: a"),
                    "x: a is a string, but a whole number is expected");
}

TEST_CASE("B24: configuration text with a duplicate, a comment or a byte order mark is refused") {
  CHECK(fault("{\"a\":1,\"a\":2}", "'a' is there twice") == ErrorKind::kFormat);
  CHECK(fault("{\"a\":1,\"\\u0061\":2}", "'a' is there twice") == ErrorKind::kFormat);
  CHECK(fault("{\"a\":1 /* one */}", "not valid JSON at byte") == ErrorKind::kFormat);
  CHECK(fault("{} // end", "not valid JSON at byte") == ErrorKind::kFormat);
  CHECK(fault("\xef\xbb\xbf{}", "byte order mark") == ErrorKind::kFormat);
}

TEST_CASE("Json: text that breaks the grammar is refused with its place") {
  for (const char* text :
       {"", "{", "{\"a\":}", "[1,]", "{} {}", "nul", "NaN", "[Infinity]", "1e400", "01", "'a'",
        "\"\\ud800\"", "\"\xff\"", "\"\xc0\xaf\"", "\"\xed\xa0\x80\"", "\"a\nb\""})
    CHECK(fault(text, "not valid JSON at byte") == ErrorKind::kFormat);
  CHECK(fault(std::string("{}\0{}", 5), "zero byte at byte 2") == ErrorKind::kFormat);
}

TEST_CASE("Json: nesting is limited to 64") {
  const auto nested = [](std::size_t depth) {
    return std::string(depth, '[') + std::string(depth, ']');
  };
  CHECK(Json::parse(nested(64), "x").is_array());
  CHECK(fault(nested(65), "64 deep") == ErrorKind::kLimit);
  CHECK(fault(std::string(1'000'000, '['), "64 deep") == ErrorKind::kLimit);
}

TEST_CASE("Json: a long piece of bad text is cut in the message") {
  try {
    Json::parse("[" + std::string(100'000, 'x'), "a");
  } catch (const lvggt::Error& error) {
    CHECK(std::string(error.what()).size() < 400);
  }
  CHECK_THROWS_AS(Json::parse("[\"" + std::string(100'000, 'x'), "a"), lvggt::Error);
}

TEST_CASE("Json: files are read whole, empty and too long ones refused") {
  const lvggt::test::TempDir dir;
  lvggt::write_file(dir / "a.json", "{\"k\": [1]}\n");
  CHECK(Json::read(dir / "a.json").find("k")->is_array());
  lvggt::Limits limits;
  limits.json_bytes = 4;
  CHECK_THROWS_AS(Json::read(dir / "a.json", limits), lvggt::Error);
  lvggt::write_file(dir / "empty", "");
  CHECK_THROWS_AS(Json::read(dir / "empty"), lvggt::Error);
  CHECK_THROWS_AS(Json::read(dir / "missing"), lvggt::Error);
  CHECK_THROWS_AS(Json::read(dir.path()), lvggt::Error);
}

TEST_CASE("json_quote: escapes what JSON needs escaped and replaces what is not UTF-8") {
  CHECK(lvggt::json_quote("a\"b\\c\n\x01") == "\"a\\\"b\\\\c\\n\\u0001\"");
  CHECK(lvggt::json_quote("\xff") == "\"\xef\xbf\xbd\"");
}
