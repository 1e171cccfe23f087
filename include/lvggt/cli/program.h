// SPDX-License-Identifier: Apache-2.0
#pragma once

// What every program shares: strict options, one-sentence errors, exit statuses. For programs only:
// it needs CLI11, prints, and touches signals.

#include <CLI/CLI.hpp>
#include <algorithm>
#include <charconv>
#include <cmath>
#include <csignal>
#include <cstdint>
#include <cstdio>
#include <cstdlib>
#include <exception>
#include <functional>
#include <limits>
#include <map>
#include <new>
#include <string>
#include <string_view>
#include <type_traits>
#include <vector>

#include "lvggt/core/error.h"
#include "lvggt/core/simd.h"

namespace lvggt::cli {

// The whole of `text` as a number; nothing for trailing text, for what overflows, and for NaN or
// infinity.
template <class T>
bool parse_number(std::string_view text, T& value) {
  const auto [end, error] = std::from_chars(text.data(), text.data() + text.size(), value);
  if (error != std::errc() || end != text.data() + text.size()) return false;
  if constexpr (std::is_floating_point_v<T>) return std::isfinite(value);
  return true;
}

// Edits (insert, delete, replace one character) between two words.
inline std::size_t edit_distance(std::string_view a, std::string_view b) {
  std::vector<std::size_t> row(b.size() + 1);
  for (std::size_t j = 0; j <= b.size(); ++j) row[j] = j;
  for (std::size_t i = 1; i <= a.size(); ++i) {
    std::size_t diagonal = row[0];
    row[0] = i;
    for (std::size_t j = 1; j <= b.size(); ++j) {
      const std::size_t replaced = diagonal + (a[i - 1] == b[j - 1] ? 0 : 1);
      diagonal = row[j];
      row[j] = std::min({row[j] + 1, row[j - 1] + 1, replaced});
    }
  }
  return row.back();
}

// A number of bytes: digits, maybe a fraction, and maybe K, M, G or T (powers of 1024; "GB" and
// "GiB" too).
inline bool parse_bytes(std::string_view text, std::size_t& bytes) {
  const std::size_t digits = std::min(text.find_first_not_of("0123456789."), text.size());
  double value = 0;
  if (digits == 0 || !parse_number(text.substr(0, digits), value)) return false;
  std::string_view unit = text.substr(digits);
  if (!unit.empty()) {
    const std::size_t power = std::string_view("KMGT").find(static_cast<char>(unit[0] & ~0x20));
    if (power == std::string_view::npos) return false;
    unit.remove_prefix(1);
    if (!unit.empty() && unit != "B" && unit != "iB") return false;
    value *= std::exp2(10.0 * static_cast<double>(power + 1));
  }
  if (!(value >= 1) || value >= 0x1p63) return false;
  bytes = static_cast<std::size_t>(value);
  return true;
}

// Bytes for people: "1.4 GiB".
inline std::string bytes_text(std::size_t bytes) {
  constexpr const char* kUnits[] = {"bytes", "KiB", "MiB", "GiB", "TiB"};
  double value = static_cast<double>(bytes);
  std::size_t unit = 0;
  for (; value >= 1024 && unit < 4; ++unit) value /= 1024;
  char text[32];
  const auto end = std::to_chars(text, text + sizeof text, value, std::chars_format::fixed,
                                 unit == 0 || value >= 100 ? 0 : 1)
                       .ptr;
  return std::string(text, end) + " " + kUnits[unit];
}

// A command line program: an option parser that refuses what it does not understand, and a main
// that turns every error into one sentence on stderr and an exit status.
class Program {
 public:
  Program(const std::string& name, const std::string& description, const std::string& version)
      : name_(name), app_(description, name) {
    app_.set_version_flag("--version", name + " " + version);
    app_.set_help_flag("-h,--help", "Print this help and exit");
    app_.get_formatter()->column_width(34);
  }

  CLI::App& app() { return app_; }
  const std::string& name() const { return name_; }

  // An option that takes a number in [low, high]; anything else is refused by name.
  template <class T>
  CLI::Option* add_number(const std::string& option, T& value, const std::string& description,
                          T low, T high, const std::string& type_name = "N") {
    const std::string name = option.substr(option.rfind('-') == 0 ? 0 : option.find("--"));
    CLI::Option* added = app_.add_option_function<std::string>(
        option,
        [&value, name, low, high](const std::string& text) {
          T parsed{};
          if (!parse_number(text, parsed) || parsed < low || parsed > high)
            throw CLI::ValidationError(name, number_rule<T>(text, low, high));
          value = parsed;
        },
        description);
    return added->type_name(type_name)->default_str(concat(value));
  }

  // An option that takes a number of bytes like 500M or 4G.
  CLI::Option* add_bytes(const std::string& option, std::size_t& value,
                         const std::string& description) {
    return app_
        .add_option_function<std::string>(
            option,
            [&value, option](const std::string& text) {
              if (!parse_bytes(text, value))
                throw CLI::ValidationError(
                    option, "'" + text + "' is not a number of bytes like 500M or 4G");
            },
            description)
        ->type_name("BYTES");
  }

  // Parses the command line, runs the body, and returns the exit status.
  int run(int argc, const char* const* argv, const std::function<int()>& body) {
    // Output into a closed pipe becomes an error of the write instead of a silent death.
    std::signal(SIGPIPE, SIG_IGN);
    try {
      refuse_repeated(argc, argv);
      app_.parse(argc, argv);
    } catch (const CLI::Success& asked) {
      return app_.exit(asked);
    } catch (const CLI::ParseError& error) {
      return usage_error(error);
    } catch (const std::exception& error) {
      return report(error.what(), exit_code(ErrorKind::kUsage));
    }
    return guarded([&] {
      // For comparing instruction sets, and for finding out what another CPU would do.
      if (const char* target = std::getenv("LVGGT_SIMD")) use_simd_target(target);
      return body();
    });
  }

 private:
  template <class T>
  static std::string number_rule(const std::string& text, T low, T high) {
    const char* kind = std::is_integral_v<T> ? "a whole number" : "a number";
    if (high == std::numeric_limits<T>::max())
      return concat("'", text, "' is not ", kind, " of at least ", low);
    return concat("'", text, "' is not ", kind, " from ", low, " to ", high);
  }

  int guarded(const std::function<int()>& body) const {
    try {
      return body();
    } catch (const Error& error) {
      return report(error.what(), exit_code(error.kind()));
    } catch (const std::bad_alloc&) {
      return report("not enough memory", exit_code(ErrorKind::kMemory));
    } catch (const std::exception& error) {
      return report(error.what(), 1);
    }
  }

  int report(const std::string& sentence, int status) const {
    std::fprintf(stderr, "%s: error: %s\n", name_.c_str(), sentence.c_str());
    return status;
  }

  // CLI11 lets a flag be repeated and takes the last; a person who gives an option twice is
  // mistaken.
  void refuse_repeated(int argc, const char* const* argv) const {
    std::map<const CLI::Option*, int> times;
    for (int i = 1; i < argc; ++i) {
      const std::string_view argument = argv[i];
      if (argument == "--") break;
      if (argument.size() < 2 || argument[0] != '-') continue;
      const std::string option(argument.substr(0, argument.find('=')));
      const CLI::Option* known = app_.get_option_no_throw(option);
      if (known != nullptr && known->get_expected_max() <= 1 && ++times[known] > 1)
        fail(ErrorKind::kUsage, option, " is given more than once");
    }
  }

  int usage_error(const CLI::ParseError& error) const {
    std::string sentence = error.what();
    for (const std::string& unknown : app_.remaining()) {
      if (unknown.size() < 2 || unknown[0] != '-') continue;
      sentence = "there is no option " + unknown;
      if (const std::string near = nearest_option(unknown); !near.empty())
        sentence += " (did you mean " + near + "?)";
      break;
    }
    report(sentence, 0);
    std::fprintf(stderr, "%s --help lists the options.\n", name_.c_str());
    return exit_code(ErrorKind::kUsage);
  }

  // The option most like `unknown`, if it is like it at all.
  std::string nearest_option(const std::string& unknown) const {
    const std::string word = unknown.substr(0, unknown.find('='));
    std::string nearest;
    std::size_t best = 1 + word.size() / 3;
    for (const CLI::Option* option : app_.get_options()) {
      for (const std::string& name : option->get_lnames()) {
        const std::size_t distance = edit_distance(word, "--" + name);
        if (distance <= best && (nearest.empty() || distance < best)) {
          best = distance;
          nearest = "--" + name;
        }
      }
    }
    return nearest;
  }

  std::string name_;
  CLI::App app_;
};

}  // namespace lvggt::cli
