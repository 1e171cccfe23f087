// SPDX-License-Identifier: Apache-2.0
#include "kernels/io/json_events.h"

#include <limits>
#include <nlohmann/json.hpp>
#include <string>

#include "kernels/io/printable.h"
#include "lvggt/core/error.h"

namespace lvggt {
namespace {

// Between nlohmann's event parser, which does not recurse, and JsonEvents.
class Adapter : public nlohmann::json_sax<nlohmann::json> {
 public:
  Adapter(JsonEvents& events, std::string_view what) : events_(events), what_(what) {}

  bool null() override { return events_.on_null(), true; }
  bool boolean(bool value) override { return events_.on_bool(value), true; }
  bool number_integer(number_integer_t value) override { return events_.on_negative(value), true; }
  bool number_unsigned(number_unsigned_t value) override {
    if (value > static_cast<number_unsigned_t>(std::numeric_limits<std::int64_t>::max())) {
      events_.on_real(static_cast<double>(value), in_quotes(std::to_string(value)));
    } else {
      events_.on_integer(static_cast<std::int64_t>(value));
    }
    return true;
  }
  bool number_float(number_float_t value, const string_t& text) override {
    return events_.on_real(value, in_quotes(text)), true;
  }
  bool string(string_t& value) override { return events_.on_string(std::move(value)), true; }
  bool binary(binary_t&) override { return false; }  // not in JSON text
  bool start_object(std::size_t) override { return descend(), events_.on_object(), true; }
  bool key(string_t& value) override { return events_.on_key(std::move(value)), true; }
  bool end_object() override { return ascend(); }
  bool start_array(std::size_t) override { return descend(), events_.on_array(), true; }
  bool end_array() override { return ascend(); }
  bool parse_error(std::size_t position, const std::string& /*token*/,
                   const nlohmann::detail::exception& error) override {
    // "[json.exception.parse_error.101] parse error at line 1, column 5: syntax error while parsing
    // ...": the part after the position is for people. It ends with what was read, which may be
    // long.
    std::string_view text = error.what();
    const std::size_t colon = text.find(": ");
    if (colon != std::string_view::npos) text.remove_prefix(colon + 2);
    fail(ErrorKind::kFormat, events_.source(), ": ", what_, " is not valid JSON at byte ", position,
         ": ", printable(text));
  }

 private:
  void descend() {
    if (++depth_ > events_.max_depth())
      fail(ErrorKind::kLimit, events_.source(), ": ", what_, " nests values more than ",
           events_.max_depth(), " deep");
  }
  bool ascend() {
    --depth_;
    events_.on_end();
    return true;
  }

  JsonEvents& events_;
  std::string_view what_;
  std::size_t depth_ = 0;
};

}  // namespace

void parse_json_events(std::string_view text, JsonEvents& events, std::string_view what) {
  if (text.starts_with("\xef\xbb\xbf"))
    fail(ErrorKind::kFormat, events.source(), ": ", what,
         " starts with a byte order mark, which JSON does not allow; save it as UTF-8 without one");
  // The parser would take a zero byte for the end of the text and ignore what follows.
  const std::size_t zero = text.find('\0');
  if (zero != std::string_view::npos)
    fail(ErrorKind::kFormat, events.source(), ": ", what, " has a zero byte at byte ", zero);
  Adapter adapter(events, what);
  if (!nlohmann::json::sax_parse(text.begin(), text.end(), &adapter))
    fail(ErrorKind::kFormat, events.source(), ": ", what, " is not valid JSON");
}

}  // namespace lvggt
