// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <sstream>
#include <stdexcept>
#include <string>
#include <string_view>

namespace lvggt {

// What kind of fault an Error reports. Programs turn it into their exit status with exit_code().
enum class ErrorKind {
  kUsage,        // an option or argument makes no sense
  kRead,         // an input is missing, unreadable or not a regular file
  kFormat,       // an input's bytes break the rules of its format
  kUnsupported,  // an input is valid, but of a kind lvggt does not handle
  kMismatch,     // two things that must fit (shapes, configuration and weights) do not
  kLimit,        // a documented limit would be exceeded
  kMemory,       // the work needs more memory than there is or than was allowed
  kNumeric,      // NaN or infinity where a number is needed
  kWrite,        // an output cannot be written
  kInterrupted,  // the user asked to stop
};

// Exit status of a program that ends with an error of this kind: 1 failed at run time, 2 wrong
// usage, 3 bad input, 4 memory or a limit, 130 interrupted. (0 is done, 5 a partial result.)
constexpr int exit_code(ErrorKind kind) {
  switch (kind) {
    case ErrorKind::kUsage:
      return 2;
    case ErrorKind::kRead:
    case ErrorKind::kFormat:
    case ErrorKind::kUnsupported:
    case ErrorKind::kMismatch:
      return 3;
    case ErrorKind::kLimit:
    case ErrorKind::kMemory:
      return 4;
    case ErrorKind::kInterrupted:
      return 130;
    case ErrorKind::kNumeric:
    case ErrorKind::kWrite:
      return 1;
  }
  return 1;
}

// The only exception type the library throws itself. what() is one sentence: what was wrong, in
// which file, tensor or option, what was expected and what was found.
class Error : public std::runtime_error {
 public:
  Error(ErrorKind kind, const std::string& message) : std::runtime_error(message), kind_(kind) {}
  ErrorKind kind() const { return kind_; }

 private:
  ErrorKind kind_;
};

// The arguments printed one after the other, as to a stream.
template <class... Args>
std::string concat(const Args&... args) {
  std::ostringstream out;
  out.imbue(std::locale::classic());
  (out << ... << args);
  return out.str();
}

template <class... Args>
[[noreturn]] void fail(ErrorKind kind, const Args&... args) {
  throw Error(kind, concat(args...));
}

}  // namespace lvggt

// Checks what a caller or a file must guarantee, in every build; the message names the operator and
// both values: LVGGT_CHECK(x.extent(1) == C, "layer_norm: x is ", x.shape(), " but gamma is ",
// gamma.shape()).
#define LVGGT_CHECK(condition, ...)                              \
  do {                                                           \
    if (!(condition)) [[unlikely]]                               \
      ::lvggt::fail(::lvggt::ErrorKind::kMismatch, __VA_ARGS__); \
  } while (false)

// Checks our own invariants, in debug builds only.
#ifdef NDEBUG
#define LVGGT_DCHECK(condition) static_cast<void>(0)
#else
#define LVGGT_DCHECK(condition) LVGGT_CHECK(condition, "invariant broken: " #condition)
#endif
