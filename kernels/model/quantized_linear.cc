// SPDX-License-Identifier: Apache-2.0
#include "lvggt/model/quantized_linear.h"

#include <algorithm>
#include <array>
#include <cmath>
#include <cstdlib>
#include <limits>

#include "lvggt/core/error.h"
#include "lvggt/kernels/packed_matrix.h"

namespace lvggt {
namespace {

constexpr std::string_view kScaleSuffix = ".scale";

std::string metadata_fault(const Safetensors& file) {
  const auto found = file.metadata().find(std::string(kQuantizationKey));
  if (found == file.metadata().end())
    return concat("the file's metadata have no \"", kQuantizationKey, "\"");
  if (found->second != kInt8Scheme)
    return concat("the file's \"", kQuantizationKey, "\" is \"", found->second, "\", not \"",
                  kInt8Scheme, "\"");
  return {};
}

// The integers of one channel against the rules.
void check_channel(const Safetensors& file, const TensorEntry& entry, std::int64_t n,
                   View<const std::int8_t, 1> integers, float scale) {
  if (!(scale > 0 && scale <= std::numeric_limits<float>::max()))
    fail(ErrorKind::kFormat, file.path(), ": tensor ", scale_name(entry.name), " holds ", scale,
         " for output channel ", n, ", where a positive number is expected");
  int largest = 0;
  for (std::int64_t k = 0; k < integers.extent(0); ++k)
    largest = std::max(largest, std::abs(int{integers[k]}));
  if (largest > kInt8WeightMax)
    fail(ErrorKind::kFormat, file.path(), ": tensor ", entry.name, " has an integer of magnitude ",
         largest, " in output channel ", n, ", but its scheme keeps within ", kInt8WeightMax);
  if (largest != 0 && largest != kInt8WeightMax)
    fail(ErrorKind::kFormat, file.path(), ": tensor ", entry.name, ", output channel ", n,
         ": the largest magnitude is ", largest, ", but the scheme scales it to ", kInt8WeightMax,
         "; integers and scales do not belong together");
}

}  // namespace

bool is_scale_of_int8(const Safetensors& file, std::string_view name) {
  if (!name.ends_with(kScaleSuffix)) return false;
  const TensorEntry* base = file.find(name.substr(0, name.size() - kScaleSuffix.size()));
  return base != nullptr && base->dtype == Dtype::kI8;
}

std::string quantized_linear_fault(const Safetensors& file, const TensorEntry& entry) {
  if (entry.dtype != Dtype::kI8)
    return concat(entry.name, " holds ", dtype_name(entry.dtype),
                  " values where I8 ones are expected");
  if (entry.shape.size() != 2)
    return concat(entry.name, " holds I8 values, but has the shape ", shape_text(entry.shape),
                  ": only the weights of linear layers, of two dimensions, can be int8, others are "
                  "F32, BF16 or F16");
  if (const std::string fault = metadata_fault(file); !fault.empty())
    return entry.name + " holds I8 values, but " + fault;
  const std::string name = scale_name(entry.name);
  const TensorEntry* scale = file.find(name);
  if (scale == nullptr) return concat(entry.name, " holds I8 values, but ", name, " is missing");
  const std::array<std::int64_t, 1> expected{entry.shape[0]};
  if (scale->dtype != Dtype::kF32 || scale->shape.size() != 1 || scale->shape[0] != expected[0])
    return concat(name, " is ", dtype_name(scale->dtype), " ", shape_text(scale->shape),
                  " where F32 ", shape_text(expected), " is expected for the I8 ",
                  shape_text(entry.shape), " of ", entry.name);
  return {};
}

QuantizedLinear read_quantized_linear(const Safetensors& file, const TensorEntry& entry) {
  const std::string fault = quantized_linear_fault(file, entry);
  LVGGT_CHECK(fault.empty(), file.path(), ": ", fault);
  QuantizedLinear result{Tensor<std::int8_t, 2>(Shape{entry.shape[0], entry.shape[1]}),
                         file.read<1>(scale_name(entry.name))};
  file.read_bytes(entry,
                  std::as_writable_bytes(std::span<std::int8_t>(
                      result.integers.data(), static_cast<std::size_t>(result.integers.size()))));
  for (std::int64_t n = 0; n < entry.shape[0]; ++n)
    check_channel(file, entry, n, std::as_const(result.integers)[n], result.scales(n));
  return result;
}

void dequantize(View<float, 2> weights, const QuantizedLinear& quantized) {
  const auto [N, K] = quantized.integers.shape();
  LVGGT_CHECK(weights.shape() == quantized.integers.shape(), "dequantize: weights are ",
              weights.shape(), " but integers are ", quantized.integers.shape());
  for (std::int64_t n = 0; n < N; ++n) {
    const float scale = quantized.scales(n);
    const std::int8_t* from = quantized.integers.data() + n * K;
    float* to = weights.data() + n * weights.stride(0);
    for (std::int64_t k = 0; k < K; ++k) to[k] = scale * static_cast<float>(from[k]);
  }
}

}  // namespace lvggt
