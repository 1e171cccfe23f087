// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <bit>
#include <cstdint>
#include <span>
#include <string>

namespace lvggt {

// How many values of a tensor are of a kind that healthy weights do not have many of.
struct ValueSummary {
  std::int64_t size = 0;
  std::int64_t nan = 0;
  std::int64_t infinite = 0;
  std::int64_t zero = 0;
  std::int64_t subnormal =
      0;  // below 2^-126: slow to compute with, and nothing that training produces

  bool finite() const { return nan == 0 && infinite == 0; }
};

// Works on the bits, in one pass without branches.
inline ValueSummary summarize_values(std::span<const float> values) {
  constexpr std::uint32_t kInfinity = 0x7f800000u;
  constexpr std::uint32_t kSmallestNormal = 0x00800000u;
  // 32-bit counters keep the loop in vectors; a block is short enough for them.
  constexpr std::size_t kBlock = std::size_t{1} << 20;
  ValueSummary summary;
  summary.size = static_cast<std::int64_t>(values.size());
  while (!values.empty()) {
    const auto block = values.first(values.size() < kBlock ? values.size() : kBlock);
    std::uint32_t nan = 0, infinite = 0, zero = 0, subnormal = 0;
    for (const float value : block) {
      const std::uint32_t magnitude = std::bit_cast<std::uint32_t>(value) & 0x7fffffffu;
      nan += magnitude > kInfinity ? 1u : 0u;
      infinite += magnitude == kInfinity ? 1u : 0u;
      zero += magnitude == 0 ? 1u : 0u;
      subnormal += magnitude < kSmallestNormal ? 1u : 0u;
    }
    summary.nan += nan;
    summary.infinite += infinite;
    summary.zero += zero;
    summary.subnormal += subnormal - zero;
    values = values.subspan(block.size());
  }
  return summary;
}

// Why a tensor with these values deserves a warning although it can be used, or empty: all zero, or
// at least half subnormal.
inline std::string suspicion(const ValueSummary& summary) {
  if (summary.size > 1 && summary.zero == summary.size) return "all values are zero";
  if (summary.subnormal > 0 && summary.subnormal >= summary.size / 2)
    return std::to_string(summary.subnormal) + " of " + std::to_string(summary.size) +
           " values are subnormal";
  return {};
}

}  // namespace lvggt
