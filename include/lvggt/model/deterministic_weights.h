// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <span>
#include <string_view>

#include "lvggt/core/context.h"
#include "lvggt/core/tensor.h"

namespace lvggt {

// Weights and inputs that are a function of a tensor's name, its shape, a seed and the element's
// index, so that a model can be rebuilt anywhere without a file. Untrained, but scaled like a fresh
// initialisation.

// FNV-1a of the name's bytes, 64 bits.
std::uint64_t fnv1a64(std::string_view text);

// Random bits number `i` of the sequence of that name and seed: the splitmix64 finaliser over a
// counter.
std::uint64_t deterministic_bits(std::string_view name, std::uint64_t seed, std::uint64_t i);

// value = base + scale * v with v in [-1, 1).
struct DeterministicScale {
  double base = 0;
  double scale = 0;
};

// Which base and scale the tensor has, by its name in the published checkpoint and its shape;
// `index` matters only for the bias of the camera head's last layer. An Error of kind kMismatch for
// a name no rule covers.
DeterministicScale deterministic_scale(std::string_view name, std::span<const std::int64_t> shape,
                                       std::int64_t index = 0);

// All values of a parameter or buffer, row-major; out.size() is the product of the shape.
void deterministic_values(std::string_view name, std::span<const std::int64_t> shape,
                          std::uint64_t seed, std::span<float> out);

// The same on the threads of `ctx`: the same bits.
void deterministic_values(std::string_view name, std::span<const std::int64_t> shape,
                          std::uint64_t seed, std::span<float> out, Context& ctx);

// Values in [lo, hi), for inputs.
void deterministic_uniform(std::string_view name, std::uint64_t seed, double lo, double hi,
                           std::span<float> out);

// S frames of H x W pixels, RGB in [0, 1], every value k / 255: noise over random blocks of 16
// x 16.
Tensor<float, 4> deterministic_images(std::uint64_t seed, std::int64_t S, std::int64_t H,
                                      std::int64_t W);  // [S, H, W, 3]

}  // namespace lvggt
