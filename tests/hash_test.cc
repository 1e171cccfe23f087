// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/hash.h"

#include <doctest/doctest.h>

#include <algorithm>
#include <cctype>
#include <limits>
#include <string>
#include <vector>

#include "lvggt/core/error.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/value_summary.h"
#include "tests/support/temp_dir.h"

namespace {

// The test vectors of FIPS 180-2.
constexpr const char* kEmpty = "e3b0c44298fc1c149afbf4c8996fb92427ae41e4649b934ca495991b7852b855";
constexpr const char* kAbc = "ba7816bf8f01cfea414140de5dae2223b00361a396177a9cb410ff61f20015ad";
constexpr const char* kMillionA =
    "cdc76e5c9914fb9281a1c7e284d73e67f1809a48a497200e046d39ccc7112cd0";

}  // namespace

TEST_CASE("sha256: agrees with the published test vectors, from memory and from files") {
  CHECK(lvggt::sha256({}) == kEmpty);
  const std::string abc = "abc";
  CHECK(lvggt::sha256(std::as_bytes(std::span(abc))) == kAbc);
  const lvggt::test::TempDir dir;
  lvggt::write_file(dir / "a", std::string(1'000'000, 'a'));
  CHECK(lvggt::sha256_file(dir / "a") == kMillionA);
}

TEST_CASE("A60: a file whose SHA-256 is not the given one is refused") {
  const lvggt::test::TempDir dir;
  lvggt::write_file(dir / "abc", "abc");
  lvggt::check_sha256(dir / "abc", kAbc);
  std::string upper = kAbc;
  std::transform(upper.begin(), upper.end(), upper.begin(),
                 [](unsigned char c) { return std::toupper(c); });
  lvggt::check_sha256(dir / "abc", upper);
  try {
    lvggt::check_sha256(dir / "abc", kEmpty);
    FAIL("accepted");
  } catch (const lvggt::Error& error) {
    CHECK(error.kind() == lvggt::ErrorKind::kMismatch);
    const std::string message = error.what();
    CHECK(message.find(kAbc) != std::string::npos);
    CHECK(message.find(kEmpty) != std::string::npos);
  }
  for (const std::string& sum : {std::string(), std::string(63, 'a'), std::string(64, 'g')})
    CHECK_THROWS_AS(lvggt::check_sha256(dir / "abc", sum), lvggt::Error);
}

TEST_CASE("summarize_values: counts NaN, infinity, zero and subnormal values") {
  constexpr float kInf = std::numeric_limits<float>::infinity();
  constexpr float kNan = std::numeric_limits<float>::quiet_NaN();
  const std::vector<float> values{0.0f, -0.0f, 1.0f,   kInf,    -kInf,
                                  kNan, -kNan, 1e-40f, -1e-45f, 0x1p-126f};
  const lvggt::ValueSummary summary = lvggt::summarize_values(values);
  CHECK(summary.size == 10);
  CHECK(summary.zero == 2);
  CHECK(summary.infinite == 2);
  CHECK(summary.nan == 2);
  CHECK(summary.subnormal == 2);
  CHECK_FALSE(summary.finite());
}

TEST_CASE("A57: tensors of zeros or of subnormal values are suspicious") {
  const auto said = [](const std::vector<float>& values) {
    return lvggt::suspicion(lvggt::summarize_values(values));
  };
  CHECK(said({0, 0, 0}) == "all values are zero");
  CHECK(said({1e-40f, 1e-41f, 1, 1}) == "2 of 4 values are subnormal");
  CHECK(said({1e-40f, 1, 1, 1}).empty());
  CHECK(said({0}).empty());
  CHECK(said({}).empty());
}
