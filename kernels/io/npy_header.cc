// SPDX-License-Identifier: Apache-2.0
#include "kernels/io/npy_header.h"

#include <array>
#include <charconv>
#include <utility>

#include "kernels/io/printable.h"
#include "lvggt/core/error.h"

namespace lvggt::detail {

namespace {

// numpy's codes without the byte order.
constexpr std::array<std::pair<std::string_view, Dtype>, 12> kCodes{{{"f4", Dtype::kF32},
                                                                     {"f8", Dtype::kF64},
                                                                     {"f2", Dtype::kF16},
                                                                     {"i1", Dtype::kI8},
                                                                     {"u1", Dtype::kU8},
                                                                     {"i2", Dtype::kI16},
                                                                     {"u2", Dtype::kU16},
                                                                     {"i4", Dtype::kI32},
                                                                     {"u4", Dtype::kU32},
                                                                     {"i8", Dtype::kI64},
                                                                     {"u8", Dtype::kU64},
                                                                     {"b1", Dtype::kBool}}};

class HeaderParser {
 public:
  HeaderParser(std::string_view text, const std::string& path, const Limits& limits)
      : text_(text), path_(path), limits_(limits) {}

  NpyHeader run() {
    expect('{');
    bool first = true;
    while (!take('}')) {
      if (!first) {
        expect(',');
        if (take('}')) break;  // numpy writes a comma after the last entry
      }
      first = false;
      entry();
    }
    skip_space();
    if (at_ != text_.size()) damaged("has ", in_quotes(text_.substr(at_)), " after its end");
    if (!has_descr_) damaged("has no 'descr'");
    if (!has_order_) damaged("has no 'fortran_order'");
    if (!has_shape_) damaged("has no 'shape'");
    return std::move(header_);
  }

 private:
  template <class... Args>
  [[noreturn]] void damaged(const Args&... args) const {
    fail(ErrorKind::kFormat, path_, ": its .npy header ", args...);
  }

  void skip_space() {
    while (at_ < text_.size() && (text_[at_] == ' ' || text_[at_] == '\n')) ++at_;
  }
  bool take(char c) {
    skip_space();
    if (at_ == text_.size() || text_[at_] != c) return false;
    ++at_;
    return true;
  }
  void expect(char c) {
    if (take(c)) return;
    if (at_ == text_.size()) damaged("ends where '", c, "' is expected");
    damaged("has ", in_quotes(text_.substr(at_, 24)), " where '", c, "' is expected");
  }

  // A string without escapes; numpy needs none for what lvggt reads.
  std::string_view quoted() {
    skip_space();
    const char quote = at_ < text_.size() ? text_[at_] : '\0';
    if (quote != '\'' && quote != '"')
      damaged("has ", in_quotes(text_.substr(at_, 24)), " where a quoted word is expected");
    const std::size_t end = text_.find(quote, at_ + 1);
    if (end == std::string_view::npos) damaged("has a quoted word without an end");
    const std::string_view word = text_.substr(at_ + 1, end - at_ - 1);
    at_ = end + 1;
    return word;
  }

  void once(bool& seen, std::string_view key) {
    if (std::exchange(seen, true)) damaged("has the key ", in_quotes(key), " twice");
  }

  void entry() {
    const std::string_view key = quoted();
    expect(':');
    if (key == "descr") {
      once(has_descr_, key);
      descr();
    } else if (key == "fortran_order") {
      once(has_order_, key);
      header_.fortran_order = boolean();
    } else if (key == "shape") {
      once(has_shape_, key);
      shape();
    } else {
      damaged("has the unknown key ", in_quotes(key));
    }
  }

  bool boolean() {
    skip_space();
    for (const bool value : {true, false}) {
      const std::string_view word = value ? "True" : "False";
      if (text_.substr(at_).starts_with(word)) {
        at_ += word.size();
        return value;
      }
    }
    damaged("has ", in_quotes(text_.substr(at_, 24)), " where True or False is expected");
  }

  void shape() {
    expect('(');
    if (take(')')) return;  // a scalar
    bool comma = false;
    do {
      header_.shape.push_back(extent());
      if (header_.shape.size() > limits_.rank)
        fail(ErrorKind::kLimit, path_, ": has more than the limit of ", limits_.rank,
             " dimensions");
      comma = take(',');
      if (take(')')) {
        if (!comma && header_.shape.size() == 1) damaged("has a shape that is no tuple");
        return;
      }
    } while (comma);
    expect(')');
  }

  std::int64_t extent() {
    skip_space();
    std::int64_t value = 0;
    const char* begin = text_.data() + at_;
    const auto [end, error] = std::from_chars(begin, text_.data() + text_.size(), value);
    if (error != std::errc() || value < 0)
      damaged("has ", in_quotes(text_.substr(at_, 24)),
              " where an extent is expected, a whole number of at least 0 and below 2^63");
    at_ += static_cast<std::size_t>(end - begin);
    if (at_ < text_.size() && text_[at_] == 'L') ++at_;  // as Python 2 wrote long integers
    return value;
  }

  template <class... Args>
  [[noreturn]] void unsupported(const Args&... args) const {
    fail(ErrorKind::kUnsupported, path_, ": ", args...);
  }

  void descr() {
    skip_space();
    if (at_ < text_.size() && (text_[at_] == '[' || text_[at_] == '('))
      unsupported("holds records with named fields; save each field as an array of its own");
    const std::string_view descr = quoted();
    const std::size_t order = descr.find_first_of("<>|=") == 0 ? 1 : 0;
    const std::string_view code = descr.substr(order);
    if (code.starts_with('O'))
      unsupported(
          "holds Python objects (pickled), which lvggt never loads; save the array again with "
          "numpy.save(path, numpy.asarray(array, dtype='float32'))");
    for (const auto& [name, dtype] : kCodes) {
      if (code != name) continue;
      if (descr[0] == '>' && dtype_size(dtype) > 1)
        unsupported("its numbers are big-endian (", descr,
                    "); save the array again with numpy.save(path, array.astype('",
                    std::string(code), "'))");
      header_.dtype = dtype;
      return;
    }
    unsupported("holds elements of type ", in_quotes(descr),
                ", but only booleans, integers and floats of up to 64 bits are read");
  }

  std::string_view text_;
  const std::string& path_;
  const Limits& limits_;
  std::size_t at_ = 0;
  NpyHeader header_;
  bool has_descr_ = false, has_order_ = false, has_shape_ = false;
};

}  // namespace

NpyHeader parse_npy_header(std::string_view text, const std::string& path, const Limits& limits) {
  return HeaderParser(text, path, limits).run();
}

std::string npy_header_text(Dtype dtype, const std::vector<std::int64_t>& shape) {
  std::string text = "{'descr': '";
  bool known = false;
  for (const auto& [name, code_dtype] : kCodes) {
    if (code_dtype != dtype) continue;
    text += dtype_size(dtype) == 1 ? '|' : '<';
    text += name;
    known = true;
  }
  if (!known) fail(ErrorKind::kUnsupported, "numpy has no type for ", dtype_name(dtype));
  text += "', 'fortran_order': False, 'shape': (";
  for (const std::int64_t extent : shape) text += std::to_string(extent) + ", ";
  // One comma stays when there is one number, as Python writes a tuple of one.
  if (!shape.empty()) text.resize(text.size() - (shape.size() == 1 ? 1 : 2));
  return text + "), }";
}

}  // namespace lvggt::detail
