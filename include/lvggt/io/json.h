// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <utility>
#include <variant>
#include <vector>

#include "lvggt/io/limits.h"

namespace lvggt {

// A parsed JSON value. Parsing is strict: RFC 8259 in UTF-8, one value and nothing after it, no
// comments, no byte order mark, no key twice in one object, nesting within Limits::json_depth. CRLF
// line ends are white space.
//
// The as_...() functions check the kind; `place` names the value in their kFormat Error, as in
// as_int64("config.json: embed_dim").
class Json {
 public:
  using Array = std::vector<Json>;
  using Member = std::pair<std::string, Json>;
  using Object = std::vector<Member>;  // in the order of the text

  // `source` names the text in errors: kFormat with the position of the fault, kLimit for nesting.
  static Json parse(std::string_view text, const std::string& source, const Limits& limits = {});

  // The same for a file; kRead when it cannot be read, kLimit above Limits::json_bytes.
  static Json read(const std::string& path, const Limits& limits = {});

  Json() = default;
  explicit Json(bool value) : value_(value) {}
  explicit Json(std::int64_t value) : value_(value) {}
  explicit Json(double value) : value_(value) {}
  explicit Json(std::string value) : value_(std::move(value)) {}
  explicit Json(Array value) : value_(std::move(value)) {}
  explicit Json(Object value) : value_(std::move(value)) {}

  bool is_null() const { return std::holds_alternative<std::monostate>(value_); }
  bool is_bool() const { return std::holds_alternative<bool>(value_); }
  // Written without fraction or exponent, and within 64 bits.
  bool is_integer() const { return std::holds_alternative<std::int64_t>(value_); }
  bool is_number() const { return is_integer() || std::holds_alternative<double>(value_); }
  bool is_string() const { return std::holds_alternative<std::string>(value_); }
  bool is_array() const { return std::holds_alternative<Array>(value_); }
  bool is_object() const { return std::holds_alternative<Object>(value_); }

  // "a number", "an array", ...
  std::string_view kind_name() const;

  bool as_bool(std::string_view place) const;
  std::int64_t as_int64(std::string_view place) const;
  double as_double(std::string_view place) const;
  const std::string& as_string(std::string_view place) const;
  const Array& as_array(std::string_view place) const;
  const Object& as_object(std::string_view place) const;

  // The member of that name, or null; also null when this is not an object.
  const Json* find(std::string_view key) const;

 private:
  friend class JsonBuilder;
  std::variant<std::monostate, bool, std::int64_t, double, std::string, Array, Object> value_;
};

// A JSON string literal with its quotes. Bytes that are not UTF-8 become U+FFFD.
std::string json_quote(std::string_view text);

}  // namespace lvggt
