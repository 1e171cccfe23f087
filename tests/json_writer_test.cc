// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/json_writer.h"

#include <doctest/doctest.h>

#include <array>
#include <bit>
#include <cstdint>
#include <cstdlib>
#include <locale>

#include "lvggt/io/json.h"

using namespace lvggt;

TEST_CASE("E07: numbers are written so that reading gives the same bits") {
  std::uint32_t bits = 1;
  for (int i = 0; i < 20000; ++i) {
    bits = bits * 1664525u + 1013904223u;
    const float value = std::bit_cast<float>(bits);
    if (!std::isfinite(value)) continue;
    std::string text;
    append_number(text, value);
    CHECK(std::bit_cast<std::uint32_t>(std::strtof(text.c_str(), nullptr)) == bits);
  }
  std::string text;
  append_number(text, 0.1);
  append_number(text, 1e300);
  append_number(text, std::int64_t{-9007199254740993});
  CHECK(text == "0.11e+300-9007199254740993");
}

TEST_CASE("append_number: NaN and infinity are refused") {
  std::string text;
  CHECK_THROWS_AS(append_number(text, std::nan("")), Error);
  CHECK_THROWS_AS(append_number(text, -INFINITY), Error);
  CHECK(text.empty());
}

TEST_CASE("JsonWriter: what it writes parses to what was meant") {
  JsonWriter json;
  json.begin_object();
  json.field("name", "a \"b\"\\\n\x01 \xff");
  json.field("flag", true);
  json.field("count", 3);
  json.key("nothing");
  json.null();
  json.key("rows");
  json.begin_array();
  json.numbers(std::array<double, 3>{1, 0.25, -3e-9});
  json.begin_object();
  json.end_object();
  std::string text = json.take();  // streaming: the rest goes on where this ended
  json.value(7);
  json.end_array();
  json.end_object();
  text += json.take();

  const Json parsed = Json::parse(text, "test");
  CHECK(parsed.find("name")->as_string("name") == "a \"b\"\\\n\x01 \xef\xbf\xbd");
  CHECK(parsed.find("flag")->as_bool("flag"));
  CHECK(parsed.find("count")->as_int64("count") == 3);
  CHECK(parsed.find("nothing")->is_null());
  const auto& rows = parsed.find("rows")->as_array("rows");
  REQUIRE(rows.size() == 3);
  CHECK(rows[0].as_array("row")[2].as_double("x") == -3e-9);
  CHECK(rows[1].as_object("row").empty());
  CHECK(rows[2].as_int64("x") == 7);
  CHECK(text.back() == '\n');
}

TEST_CASE("D05: a locale with comma decimals does not reach files or messages") {
  struct Comma : std::numpunct<char> {
    char do_decimal_point() const override { return ','; }
    char do_thousands_sep() const override { return '.'; }
    std::string do_grouping() const override { return "\3"; }
  };
  const std::locale before = std::locale::global(std::locale(std::locale(), new Comma));
  std::string text;
  append_number(text, 12345.5);
  const std::string message = concat(12345.5);
  std::locale::global(before);
  CHECK(text == "12345.5");
  CHECK(message == "12345.5");
}
