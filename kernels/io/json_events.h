// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <string>
#include <string_view>

namespace lvggt {

// Receives the events of a JSON text in order. A handler stops the parse by throwing.
class JsonEvents {
 public:
  // `source` names the text in messages.
  JsonEvents(std::string source, std::size_t max_depth)
      : source_(std::move(source)), max_depth_(max_depth) {}
  virtual ~JsonEvents() = default;
  JsonEvents(const JsonEvents&) = delete;
  JsonEvents& operator=(const JsonEvents&) = delete;

  const std::string& source() const { return source_; }
  std::size_t max_depth() const { return max_depth_; }

  virtual void on_object() = 0;
  virtual void on_array() = 0;
  virtual void on_end() = 0;  // of the innermost object or array
  virtual void on_key(std::string&& key) = 0;
  virtual void on_string(std::string&& text) = 0;
  virtual void on_integer(
      std::int64_t value) = 0;  // 0 .. 2^63-1, written without fraction or exponent

  // Every other value, unless one of the two below is overridden: `what` describes it for a
  // message.
  virtual void on_other(std::string_view what) = 0;
  virtual void on_real(double /*value*/, std::string_view what) { on_other(what); }
  virtual void on_negative(std::int64_t /*value*/) { on_other("a negative number"); }
  virtual void on_bool(bool value) { on_other(value ? "true" : "false"); }
  virtual void on_null() { on_other("null"); }

 private:
  std::string source_;
  std::size_t max_depth_;
};

// Parses exactly one JSON value (RFC 8259, UTF-8, no comments, no byte order mark) with white space
// around it. Errors: kFormat with the byte where the text breaks the grammar; kLimit beyond
// max_depth. `what` names the text within its source: "the header".
void parse_json_events(std::string_view text, JsonEvents& events, std::string_view what);

}  // namespace lvggt
