// SPDX-License-Identifier: Apache-2.0
#include "weights/pickle.h"

#include <bit>
#include <cstring>
#include <optional>

#include "lvggt/core/error.h"
#include "weights/pickle_machine.h"

namespace lvggt {
namespace {

// Instructions of protocols 2 to 5 that build plain values (CPython's Lib/pickletools.py describes
// them).
enum Op : std::uint8_t {
  kMark = '(',
  kStop = '.',
  kPop = '0',
  kBinInt = 'J',
  kBinInt1 = 'K',
  kBinInt2 = 'M',
  kNone = 'N',
  kBinPersId = 'Q',
  kReduce = 'R',
  kBinUnicode = 'X',
  kAppend = 'a',
  kBuild = 'b',
  kGlobal = 'c',
  kAppends = 'e',
  kBinGet = 'h',
  kLongBinGet = 'j',
  kBinPut = 'q',
  kLongBinPut = 'r',
  kSetItem = 's',
  kTuple = 't',
  kSetItems = 'u',
  kEmptyDict = '}',
  kEmptyList = ']',
  kEmptyTuple = ')',
  kBinFloat = 'G',
  kProto = 0x80,
  kTuple1 = 0x85,
  kTuple2 = 0x86,
  kTuple3 = 0x87,
  kNewTrue = 0x88,
  kNewFalse = 0x89,
  kLong1 = 0x8a,
  kShortBinUnicode = 0x8c,
  kBinUnicode8 = 0x8d,
  kStackGlobal = 0x93,
  kMemoize = 0x94,
  kFrame = 0x95,
};

constexpr int kNewestProtocol = 5;

// Reads operands from the pickle's bytes.
class Operands {
 public:
  Operands(std::string_view bytes, const std::string& source) : bytes_(bytes), source_(source) {}

  std::size_t position() const { return position_; }

  template <class T>
  T number() {
    T value;
    std::memcpy(&value, take(sizeof(T)).data(), sizeof(T));
    return value;
  }

  std::string_view take(std::uint64_t num_bytes) {
    if (num_bytes > bytes_.size() - position_)
      fail(ErrorKind::kFormat, source_, " ends in the middle of an instruction at byte ",
           position_);
    const auto part = bytes_.substr(position_, static_cast<std::size_t>(num_bytes));
    position_ += part.size();
    return part;
  }

  // Up to the next line feed, which is consumed.
  std::string_view line() {
    const std::size_t end = bytes_.find('\n', position_);
    if (end == std::string_view::npos)
      fail(ErrorKind::kFormat, source_, " ends in the middle of a name at byte ", position_);
    const auto text = bytes_.substr(position_, end - position_);
    position_ = end + 1;
    return text;
  }

  double big_endian_double() {
    auto bits = number<std::uint64_t>();
    bits = __builtin_bswap64(bits);
    return std::bit_cast<double>(bits);
  }

  // Two's complement, little-endian, any length; empty when it does not fit 64 bits.
  std::optional<std::int64_t> long_integer() {
    const auto digits = take(number<std::uint8_t>());
    if (digits.size() > sizeof(std::int64_t)) return std::nullopt;
    const bool negative =
        !digits.empty() && (static_cast<unsigned char>(digits.back()) & 0x80) != 0;
    std::uint64_t value = negative ? ~std::uint64_t{0} : 0;
    std::memcpy(&value, digits.data(), digits.size());
    return static_cast<std::int64_t>(value);
  }

 private:
  std::string_view bytes_;
  const std::string& source_;
  std::size_t position_ = 0;
};

std::string op_text(std::uint8_t op) {
  static constexpr char kDigits[] = "0123456789abcdef";
  std::string text = "0x";
  text += kDigits[op >> 4];
  text += kDigits[op & 15];
  if (op > 0x20 && op < 0x7f) text += std::string(" '") + static_cast<char>(op) + "'";
  return text;
}

// Instructions that push one plain value. False when `op` is none of them.
bool run_value(std::uint8_t op, Operands& in, PickleMachine& machine) {
  switch (op) {
    case kNone:
      machine.push_plain(PickleKind::kNone, 0);
      return true;
    case kNewTrue:
      machine.push_plain(PickleKind::kBool, 1);
      return true;
    case kNewFalse:
      machine.push_plain(PickleKind::kBool, 0);
      return true;
    case kBinInt:
      machine.push_plain(PickleKind::kInteger, in.number<std::int32_t>());
      return true;
    case kBinInt1:
      machine.push_plain(PickleKind::kInteger, in.number<std::uint8_t>());
      return true;
    case kBinInt2:
      machine.push_plain(PickleKind::kInteger, in.number<std::uint16_t>());
      return true;
    case kLong1: {
      const auto value = in.long_integer();
      if (!value) machine.bad("an integer needs more than 64 bits");
      machine.push_plain(PickleKind::kInteger, *value);
      return true;
    }
    case kBinFloat:
      in.big_endian_double();
      machine.push_plain(PickleKind::kReal, 0);
      return true;
    default:
      return false;
  }
}

// Instructions that push text, an empty container, or something from the memo. False when `op` is
// none of them.
bool run_container(std::uint8_t op, Operands& in, PickleMachine& machine) {
  switch (op) {
    case kBinUnicode:
      machine.push_string(in.take(in.number<std::uint32_t>()));
      return true;
    case kShortBinUnicode:
      machine.push_string(in.take(in.number<std::uint8_t>()));
      return true;
    case kBinUnicode8:
      machine.push_string(in.take(in.number<std::uint64_t>()));
      return true;
    case kEmptyDict:
      machine.push_sequence(PickleKind::kDict, {});
      return true;
    case kEmptyList:
      machine.push_sequence(PickleKind::kList, {});
      return true;
    case kEmptyTuple:
      machine.push_sequence(PickleKind::kTuple, {});
      return true;
    case kBinGet:
      machine.get(in.number<std::uint8_t>());
      return true;
    case kLongBinGet:
      machine.get(in.number<std::uint32_t>());
      return true;
    case kBinPut:
      machine.put(in.number<std::uint8_t>());
      return true;
    case kLongBinPut:
      machine.put(in.number<std::uint32_t>());
      return true;
    case kMemoize:
      machine.memoize();
      return true;
    default:
      return false;
  }
}

// Instructions that combine values. False when `op` is none of them.
bool run_combination(std::uint8_t op, Operands& in, PickleMachine& machine) {
  switch (op) {
    case kMark:
      machine.mark();
      return true;
    case kPop:
      machine.pop();
      return true;
    case kTuple:
      machine.push_sequence(PickleKind::kTuple, machine.pop_to_mark());
      return true;
    case kTuple1:
      machine.push_sequence(PickleKind::kTuple, machine.pop(1));
      return true;
    case kTuple2:
      machine.push_sequence(PickleKind::kTuple, machine.pop(2));
      return true;
    case kTuple3:
      machine.push_sequence(PickleKind::kTuple, machine.pop(3));
      return true;
    case kAppend:
      machine.append(machine.pop(1));
      return true;
    case kAppends:
      machine.append(machine.pop_to_mark());
      return true;
    case kSetItem:
      machine.set_items(machine.pop(2));
      return true;
    case kSetItems:
      machine.set_items(machine.pop_to_mark());
      return true;
    case kGlobal: {
      const std::string_view module = in.line();
      machine.push_global(module, in.line());
      return true;
    }
    case kStackGlobal:
      machine.stack_global();
      return true;
    case kReduce:
      machine.reduce();
      return true;
    case kBuild:
      machine.build();
      return true;
    case kBinPersId:
      machine.persistent_id();
      return true;
    default:
      return false;
  }
}

}  // namespace

Pickle read_pickle(std::string_view bytes, const std::string& source) {
  Operands in(bytes, source);
  PickleMachine machine(source);
  for (;;) {
    machine.set_position(in.position());
    const auto op = in.number<std::uint8_t>();
    if (op == kStop) return std::move(machine).finish();
    if (op == kProto) {
      const int protocol = in.number<std::uint8_t>();
      if (protocol < 2 || protocol > kNewestProtocol)
        machine.unsupported(concat("pickle protocol ", protocol));
    } else if (op == kFrame) {
      in.number<std::uint64_t>();  // only says how much follows
    } else if (!run_value(op, in, machine) && !run_container(op, in, machine) &&
               !run_combination(op, in, machine)) {
      machine.unsupported("the instruction " + op_text(op));
    }
  }
}

}  // namespace lvggt
