// SPDX-License-Identifier: Apache-2.0
#include <algorithm>
#include <array>
#include <cctype>
#include <string>
#include <string_view>

#include "lvggt/io/input_file.h"

namespace lvggt {
namespace {

using std::string_view_literals::operator""sv;

struct Signature {
  std::string_view bytes;
  std::string_view meaning;
};

// Beginnings of files that people take for weights, videos or pictures by mistake.
constexpr auto kSignatures = std::to_array<Signature>({
    {"GGUF"sv, "a GGUF file, which is not supported"},
    {"PK\3\4"sv,
     "a zip archive, as PyTorch's .pth files are: make a safetensors file of it with "
     "weights_convert"},
    {"PK\5\6"sv, "an empty zip archive"},
    {"\x80\x02"sv, "a Python pickle, as old PyTorch files are"},
    {"\x80\x04"sv, "a Python pickle"},
    {"version https://git-lfs"sv,
     "a Git LFS pointer, not the file itself: fetch it with git lfs pull"},
    {"\x89HDF"sv, "an HDF5 file"},
    {"\x93NUMPY"sv, "a NumPy array"},
    {"\x1f\x8b"sv, "a gzip archive"},
    {"\x28\xb5\x2f\xfd"sv, "a zstd archive"},
    {"BZh"sv, "a bzip2 archive"},
    {"\xfd"
     "7zXZ"sv,
     "an xz archive"},
    {"7z\xbc\xaf"sv, "a 7z archive"},
    {"\x7f"
     "ELF"sv,
     "a program"},
    {"\x89PNG"sv, "a PNG picture"},
    {"\xff\xd8\xff"sv, "a JPEG picture"},
    {"%PDF"sv, "a PDF document"},
    {"RIFF"sv, "a RIFF file (AVI, WebP or WAV)"},
    {"\x1a\x45\xdf\xa3"sv, "a Matroska or WebM video"},
});

bool starts_with_ignoring_case(std::string_view text, std::string_view lower) {
  return text.size() >= lower.size() &&
         std::equal(lower.begin(), lower.end(), text.begin(), [](char a, char b) {
           return a == static_cast<char>(std::tolower(static_cast<unsigned char>(b)));
         });
}

bool is_text(std::string_view head) {
  return std::all_of(head.begin(), head.end(), [](char c) {
    const auto byte = static_cast<unsigned char>(c);
    return byte >= 0x20 ? byte != 0x7f : c == '\n' || c == '\r' || c == '\t';
  });
}

}  // namespace

std::string content_hint(std::string_view head) {
  for (const Signature& signature : kSignatures)
    if (head.starts_with(signature.bytes)) return "it looks like " + std::string(signature.meaning);
  if (head.size() >= 12 && head.substr(4, 4) == "ftyp")
    return "it looks like an MP4 or QuickTime video";
  if (head.size() >= 262 && head.substr(257, 5) == "ustar") return "it looks like a tar archive";
  // A safetensors length field in the wrong byte order: zeros first, then the header's brace.
  if (head.size() >= 9 && head.starts_with("\0\0\0"sv) && head[8] == '{')
    return "it looks like safetensors with a big-endian header length";
  std::string_view text = head;
  while (!text.empty() && std::isspace(static_cast<unsigned char>(text.front())))
    text.remove_prefix(1);
  if (starts_with_ignoring_case(text, "<!doctype html") || starts_with_ignoring_case(text, "<html"))
    return "it looks like an HTML page, perhaps the answer to a failed download";
  if (text.starts_with("<?xml"))
    return "it looks like XML, perhaps the answer to a failed download";
  if (text.starts_with("{")) return "it looks like JSON text";
  if (!text.empty() && is_text(head))
    return "it looks like plain text, perhaps the answer to a failed download";
  if (!head.empty() && std::all_of(head.begin(), head.end(), [](char c) { return c == '\0'; }))
    return "it holds only zeros, as an interrupted download may leave";
  return {};
}

}  // namespace lvggt
