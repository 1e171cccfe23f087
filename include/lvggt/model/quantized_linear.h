// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>

#include "lvggt/core/tensor.h"
#include "lvggt/io/safetensors.h"

namespace lvggt {

// How a safetensors file holds the weight NAME of a linear layer as int8:
//   NAME        I8   [N, K]  integers from -63 to 63, the largest magnitude of a row being 63
//   unless
//                            the row is zero
//   NAME.scale  F32  [N]     finite and positive; weight = scale * integer
// and its metadata say "quantization": kInt8Scheme.
inline constexpr std::string_view kQuantizationKey = "quantization";
inline constexpr std::string_view kInt8Scheme = "int8 per output channel, integers from -63 to 63";

inline std::string scale_name(std::string_view weight) { return std::string(weight) + ".scale"; }

// Whether `name` is the scale of a tensor of integers in that file.
bool is_scale_of_int8(const Safetensors& file, std::string_view name);

// What the header says that forbids to read the tensor of integers `entry` as such a weight of the
// shape [N, K], as a phrase that names both types or shapes; empty if nothing.
std::string quantized_linear_fault(const Safetensors& file, const TensorEntry& entry);

struct QuantizedLinear {
  Tensor<std::int8_t, 2> integers;  // [N, K]
  Tensor<float, 1> scales;          // [N]
};

// Reads it as it is stored. Throws kFormat, with the tensor and the channel, when values break the
// rules above, and kMismatch with the fault above.
QuantizedLinear read_quantized_linear(const Safetensors& file, const TensorEntry& entry);

// scale * integer.   weights: [N, K]
void dequantize(View<float, 2> weights, const QuantizedLinear& quantized);

}  // namespace lvggt
