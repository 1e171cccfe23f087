// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <charconv>
#include <cmath>
#include <concepts>
#include <string>
#include <string_view>

#include "lvggt/core/error.h"
#include "lvggt/io/json.h"

namespace lvggt {

// Appends the shortest decimal text that reads back as the same bits; the same in every locale. NaN
// and infinity, which JSON has no text for, are refused with kNumeric.
template <class T>
requires std::integral<T> || std::floating_point<T>
void append_number(std::string& out, T value) {
  if constexpr (std::floating_point<T>)
    if (!std::isfinite(value)) fail(ErrorKind::kNumeric, "cannot write ", value, " as a number");
  char text[64];
  out.append(text, std::to_chars(text, text + sizeof text, value).ptr);
}

// Writes JSON piece by piece, indented by two blanks; arrays of numbers go on one line. Nothing is
// kept but the text not yet taken, so a document of any length can be streamed:
//   json.begin_object(); json.key("frames"); json.begin_array(); ... file.write(json.take());
class JsonWriter {
 public:
  void begin_object() { open('{'); }
  void end_object() { close('}'); }
  void begin_array() { open('['); }
  void end_array() { close(']'); }

  void key(std::string_view name) {
    separate();
    text_ += json_quote(name);
    text_ += ": ";
    after_key_ = true;
  }

  void value(std::string_view text) {
    separate();
    text_ += json_quote(text);
  }
  void value(const char* text) { value(std::string_view(text)); }
  void value(const std::string& text) { value(std::string_view(text)); }
  void value(bool flag) {
    separate();
    text_ += flag ? "true" : "false";
  }
  template <class T>
  requires(std::integral<T> || std::floating_point<T>) &&
      (!std::same_as<T, bool>)void value(T number) {
    separate();
    append_number(text_, number);
  }
  void null() {
    separate();
    text_ += "null";
  }

  template <class T>
  void field(std::string_view name, const T& x) {
    key(name);
    value(x);
  }

  // A row of numbers on one line.
  template <class Range>
  void numbers(const Range& range) {
    separate();
    text_ += '[';
    const char* comma = "";
    for (const auto& x : range) {
      text_ += comma;
      append_number(text_, x);
      comma = ", ";
    }
    text_ += ']';
  }

  // The text so far, which is then forgotten.
  std::string take() {
    std::string taken;
    taken.swap(text_);
    return taken;
  }

 private:
  void open(char bracket) {
    separate();
    text_ += bracket;
    ++depth_;
    first_ = true;
  }
  void close(char bracket) {
    --depth_;
    if (!first_) new_line();
    text_ += bracket;
    first_ = false;
    if (depth_ == 0) text_ += '\n';
  }
  void separate() {
    if (after_key_) {
      after_key_ = false;
      return;
    }
    if (depth_ == 0) return;
    if (!first_) text_ += ',';
    first_ = false;
    new_line();
  }
  void new_line() {
    text_ += '\n';
    text_.append(static_cast<std::size_t>(2 * depth_), ' ');
  }

  std::string text_;
  int depth_ = 0;
  bool first_ = true;
  bool after_key_ = false;
};

}  // namespace lvggt
