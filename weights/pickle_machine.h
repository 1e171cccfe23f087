// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <unordered_map>
#include <vector>

#include "lvggt/core/error.h"
#include "weights/pickle.h"

namespace lvggt {

// The stack, the memo and the values of a running pickle. Values refer to each other by index, so
// nothing here recurses, however deeply they nest or even when they contain themselves.
class PickleMachine {
 public:
  explicit PickleMachine(const std::string& source) : source_(source) {}

  // Byte of the current instruction, for messages.
  void set_position(std::size_t position) { position_ = position; }

  template <class... Args>
  [[noreturn]] void bad(const Args&... args) const {
    fail(ErrorKind::kFormat, source_, ", byte ", position_, ": ", args...);
  }
  [[noreturn]] void unsupported(std::string_view what) const {
    fail(ErrorKind::kUnsupported, source_, ", byte ", position_, ": ", what,
         " is refused; only tensors in plain containers are read, and nothing is ever executed");
  }

  void push_plain(PickleKind kind, std::int64_t integer);
  void push_string(std::string_view text);
  void push_sequence(PickleKind kind, std::vector<PickleId> items);
  void push_global(std::string_view module, std::string_view name);

  void mark() { marks_.push_back(stack_.size()); }
  std::vector<PickleId> pop(std::size_t count);
  std::vector<PickleId> pop_to_mark();
  void pop();

  void get(std::uint32_t index);
  void put(std::uint32_t index);
  void memoize() { put(static_cast<std::uint32_t>(memo_.size())); }

  void append(const std::vector<PickleId>& items);
  void set_items(const std::vector<PickleId>& items);

  void stack_global();
  void reduce();
  void build();
  void persistent_id();

  // The single value left on the stack is the result.
  Pickle finish() &&;

 private:
  enum Function : std::uint32_t { kOrderedDict, kRebuildTensor, kRebuildParameter };

  PickleId push(PickleValue value);
  PickleId top() const;
  std::size_t floor() const { return marks_.empty() ? 0 : marks_.back(); }
  const PickleValue& value(PickleId id) const { return pickle_.values[id]; }
  const std::string& string_at(PickleId id, std::string_view what) const;
  std::int64_t integer_at(PickleId id, std::string_view what) const;
  const std::vector<PickleId>& tuple_at(PickleId id, std::string_view what) const;
  std::vector<std::int64_t> integers_at(PickleId id, std::string_view what) const;
  void rebuild_tensor(const std::vector<PickleId>& arguments);

  const std::string& source_;
  std::size_t position_ = 0;
  Pickle pickle_;
  std::vector<PickleId> stack_;
  std::vector<std::size_t> marks_;  // sizes of the stack when they were set
  std::unordered_map<std::uint32_t, PickleId> memo_;
};

}  // namespace lvggt
