// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/hash.h"

#include <openssl/evp.h>

#include <algorithm>
#include <array>
#include <memory>
#include <vector>

#include "lvggt/core/error.h"
#include "lvggt/io/input_file.h"

namespace lvggt {
namespace {

constexpr std::size_t kBlockBytes = std::size_t{1} << 20;
constexpr std::size_t kNumDigits = 64;

class Sha256 {
 public:
  Sha256() : context_(EVP_MD_CTX_new()) {
    check(context_ != nullptr && EVP_DigestInit_ex(context_.get(), EVP_sha256(), nullptr) == 1);
  }

  void update(std::span<const std::byte> bytes) {
    check(EVP_DigestUpdate(context_.get(), bytes.data(), bytes.size()) == 1);
  }

  std::string digits() {
    std::array<unsigned char, EVP_MAX_MD_SIZE> digest;
    unsigned num_bytes = 0;
    check(EVP_DigestFinal_ex(context_.get(), digest.data(), &num_bytes) == 1);
    static constexpr char kDigits[] = "0123456789abcdef";
    std::string text;
    for (unsigned i = 0; i < num_bytes; ++i) {
      text += kDigits[digest[i] >> 4];
      text += kDigits[digest[i] & 15];
    }
    return text;
  }

 private:
  static void check(bool done) {
    if (!done) fail(ErrorKind::kUnsupported, "this system's libcrypto does not offer SHA-256");
  }

  struct Free {
    void operator()(EVP_MD_CTX* context) const { EVP_MD_CTX_free(context); }
  };
  std::unique_ptr<EVP_MD_CTX, Free> context_;
};

}  // namespace

std::string sha256(std::span<const std::byte> bytes) {
  Sha256 hash;
  hash.update(bytes);
  return hash.digits();
}

std::string sha256_file(const std::string& path) {
  const InputFile file(path);
  std::vector<std::byte> block(kBlockBytes);
  Sha256 hash;
  for (std::int64_t offset = 0; offset < file.size();) {
    const std::size_t n = std::min(kBlockBytes, static_cast<std::size_t>(file.size() - offset));
    file.read_at(offset, block.data(), n);
    hash.update(std::span(block).first(n));
    offset += static_cast<std::int64_t>(n);
  }
  file.check_unchanged();
  return hash.digits();
}

void check_sha256(const std::string& path, const std::string& expected) {
  std::string wanted = expected;
  const auto lower = [](char c) {
    return c >= 'A' && c <= 'F' ? static_cast<char>(c - 'A' + 'a') : c;
  };
  std::transform(wanted.begin(), wanted.end(), wanted.begin(), lower);
  if (wanted.size() != kNumDigits ||
      wanted.find_first_not_of("0123456789abcdef") != std::string::npos)
    fail(ErrorKind::kUsage, "a SHA-256 sum has ", kNumDigits, " hexadecimal digits, '", expected,
         "' is none");
  const std::string found = sha256_file(path);
  LVGGT_CHECK(found == wanted, path, " has the SHA-256 sum ", found, ", but ", wanted,
              " is expected");
}

}  // namespace lvggt
