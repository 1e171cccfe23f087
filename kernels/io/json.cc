// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/json.h"

#include <algorithm>
#include <nlohmann/json.hpp>
#include <unordered_set>

#include "kernels/io/json_events.h"
#include "kernels/io/printable.h"
#include "lvggt/core/error.h"
#include "lvggt/io/input_file.h"

namespace lvggt {

// Builds the value bottom up: the innermost open object or array is the last of open_.
class JsonBuilder : public JsonEvents {
 public:
  using JsonEvents::JsonEvents;

  Json take() && { return std::move(root_); }

 private:
  struct Open {
    Json value;
    std::string key;                       // of the member being read
    std::unordered_set<std::string> keys;  // of an object, so far
  };

  void on_object() override { open_.push_back({Json(Json::Object()), {}, {}}); }
  void on_array() override { open_.push_back({Json(Json::Array()), {}, {}}); }
  void on_end() override {
    Json value = std::move(open_.back().value);
    open_.pop_back();
    place(std::move(value));
  }
  void on_key(std::string&& key) override {
    Open& object = open_.back();
    if (!object.keys.insert(key).second)
      fail(ErrorKind::kFormat, source(), ": the key ", in_quotes(key),
           " is there twice in one object");
    object.key = std::move(key);
  }
  void on_string(std::string&& text) override { place(Json(std::move(text))); }
  void on_integer(std::int64_t value) override { place(Json(value)); }
  void on_negative(std::int64_t value) override { place(Json(value)); }
  void on_real(double value, std::string_view) override { place(Json(value)); }
  void on_bool(bool value) override { place(Json(value)); }
  void on_null() override { place(Json()); }
  void on_other(std::string_view) override {}

  void place(Json value) {
    if (open_.empty()) {
      root_ = std::move(value);
    } else if (auto* array = std::get_if<Json::Array>(&open_.back().value.value_)) {
      array->push_back(std::move(value));
    } else {
      std::get<Json::Object>(open_.back().value.value_)
          .emplace_back(std::move(open_.back().key), std::move(value));
    }
  }

  Json root_;
  std::vector<Open> open_;
};

namespace {

[[noreturn]] void fail_kind(std::string_view place, const Json& value, std::string_view expected) {
  fail(ErrorKind::kFormat, place, " is ", value.kind_name(), ", but ", expected, " is expected");
}

}  // namespace

Json Json::parse(std::string_view text, const std::string& source, const Limits& limits) {
  JsonBuilder builder(source, limits.json_depth);
  parse_json_events(text, builder, "the text");
  return std::move(builder).take();
}

Json Json::read(const std::string& path, const Limits& limits) {
  const std::string text = read_text_file(path, limits.json_bytes);
  if (text.empty()) fail(ErrorKind::kFormat, path, " is empty, but JSON text is expected");
  return parse(text, path, limits);
}

std::string_view Json::kind_name() const {
  if (is_null()) return "null";
  if (is_bool()) return "true or false";
  if (is_integer()) return "a whole number";
  if (is_number()) return "a number";
  if (is_string()) return "a string";
  return is_array() ? "an array" : "an object";
}

bool Json::as_bool(std::string_view place) const {
  if (!is_bool()) fail_kind(place, *this, "true or false");
  return std::get<bool>(value_);
}

std::int64_t Json::as_int64(std::string_view place) const {
  if (!is_integer()) fail_kind(place, *this, "a whole number");
  return std::get<std::int64_t>(value_);
}

double Json::as_double(std::string_view place) const {
  if (!is_number()) fail_kind(place, *this, "a number");
  return is_integer() ? static_cast<double>(std::get<std::int64_t>(value_))
                      : std::get<double>(value_);
}

const std::string& Json::as_string(std::string_view place) const {
  if (!is_string()) fail_kind(place, *this, "a string");
  return std::get<std::string>(value_);
}

const Json::Array& Json::as_array(std::string_view place) const {
  if (!is_array()) fail_kind(place, *this, "an array");
  return std::get<Array>(value_);
}

const Json::Object& Json::as_object(std::string_view place) const {
  if (!is_object()) fail_kind(place, *this, "an object");
  return std::get<Object>(value_);
}

const Json* Json::find(std::string_view key) const {
  const auto* object = std::get_if<Object>(&value_);
  if (object == nullptr) return nullptr;
  const auto it = std::find_if(object->begin(), object->end(),
                               [&](const Member& member) { return member.first == key; });
  return it == object->end() ? nullptr : &it->second;
}

std::string json_quote(std::string_view text) {
  return nlohmann::json(text).dump(-1, ' ', false, nlohmann::json::error_handler_t::replace);
}

}  // namespace lvggt
