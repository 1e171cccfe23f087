// SPDX-License-Identifier: Apache-2.0
#include "weights/quantize.h"

#include <algorithm>
#include <cmath>
#include <map>
#include <span>

#include "lvggt/core/error.h"
#include "lvggt/io/checked.h"
#include "lvggt/io/value_summary.h"
#include "lvggt/kernels/packed_matrix.h"
#include "lvggt/model/quantized_linear.h"

namespace lvggt {
namespace {

constexpr std::size_t kOthers = kLayerKinds.size();

bool starts_with_any(std::string_view name, const std::vector<std::string>& prefixes) {
  return std::any_of(prefixes.begin(), prefixes.end(),
                     [&](const std::string& prefix) { return name.starts_with(prefix); });
}

// The kind of a tensor's layer, kOthers for what is no weight of one.
std::size_t kind_of(const TensorEntry& tensor) {
  static const std::vector<std::string> kModules{
      "aggregator.",  "camera_head.", "depth_head.",  "point_head.",       "lang_encoder.",
      "lang_decoder", "rgb_encoder.", "rgb_decoder.", "feature_extractor."};
  if (tensor.shape.size() < 2 || !tensor.name.ends_with(".weight") ||
      !dtype_is_float(tensor.dtype) || !starts_with_any(tensor.name, kModules))
    return kOthers;
  return layer_kind(tensor.name);
}

// The type that the tensor gets in the output.
Dtype output_dtype(const TensorEntry& tensor, const StoragePolicy& policy) {
  const std::size_t kind = kind_of(tensor);
  if (kind == kOthers) return tensor.dtype;
  const bool wide = tensor.dtype == Dtype::kF32 || tensor.dtype == Dtype::kF64;
  switch (policy.kinds[kind]) {
    case Storage::kF32:
      return tensor.dtype;
    case Storage::kBf16:
      return wide ? Dtype::kBF16 : tensor.dtype;
    case Storage::kF16:
      return wide ? Dtype::kF16 : tensor.dtype;
    case Storage::kI8:
      break;
  }
  if (tensor.shape.size() != 2)
    fail(ErrorKind::kUnsupported, "tensor '", tensor.name, "', ", dtype_name(tensor.dtype), " ",
         shape_text(tensor.shape),
         ", cannot become int8: only linear layers, of two dimensions, can");
  return Dtype::kI8;
}

std::int64_t bytes_of(Dtype dtype, std::int64_t num_values) {
  return checked_mul(num_values, dtype_size(dtype)).value();
}

std::int64_t output_bytes(const TensorEntry& tensor, Dtype dtype) {
  const std::int64_t values = bytes_of(dtype, tensor.size());
  return dtype == Dtype::kI8 && tensor.dtype != Dtype::kI8
             ? checked_add(values, bytes_of(Dtype::kF32, tensor.shape[0])).value()
             : values;
}

std::vector<std::size_t> kept_tensors(const WeightSource& source, const QuantizeOptions& options) {
  const auto metadata = source.metadata();
  const auto scheme = metadata.find(std::string(kQuantizationKey));
  LVGGT_CHECK(scheme == metadata.end(), source.files().front(),
              ": is quantised already (its metadata have \"", kQuantizationKey, "\" = \"",
              scheme == metadata.end() ? "" : scheme->second,
              "\"); quantise the weights that it was made from");
  std::vector<std::size_t> kept;
  for (std::size_t i = 0; i < source.tensors().size(); ++i)
    if (!starts_with_any(source.tensors()[i].name, options.drop)) kept.push_back(i);
  return kept;
}

// "dino.qkv=int8 dino.proj=int8 ...", of the kinds in the result.
std::string policy_text(const QuantizeResult& result, const StoragePolicy& policy) {
  std::string text;
  for (const QuantizedKind& row : result.kinds)
    for (std::size_t i = 0; i < kLayerKinds.size(); ++i)
      if (row.kind == kLayerKinds[i])
        text += concat(text.empty() ? "" : " ", row.kind, "=", storage_name(policy.kinds[i]));
  return text;
}

// Writes tensors and sums up what rounding does to each kind.
class Rounding {
 public:
  Rounding(WeightSource& source, SafetensorsWriter& out) : source_(source), out_(out) {}

  void write(std::size_t i, Dtype dtype) {
    const TensorEntry& tensor = source_.tensors()[i];
    stored_.resize(static_cast<std::size_t>(tensor.num_bytes));
    source_.read(i, stored_);
    if (!dtype_is_float(tensor.dtype))
      return out_.write(tensor.name, std::span<const std::byte>(stored_));
    values_.resize(static_cast<std::size_t>(tensor.size()));
    to_float32(tensor.dtype, stored_, values_);
    check_finite(tensor, dtype, values_, "");
    if (dtype == tensor.dtype) return out_.write(tensor.name, std::span<const std::byte>(stored_));
    Sums& sums = sums_[kind_of(tensor)];
    if (dtype == Dtype::kI8) return write_int8(tensor, sums);
    stored_.resize(static_cast<std::size_t>(bytes_of(dtype, tensor.size())));
    from_float32(dtype, values_, stored_);
    rounded_.resize(values_.size());
    to_float32(dtype, stored_, rounded_);
    check_finite(tensor, dtype, rounded_, " once converted");
    for (std::size_t v = 0; v < values_.size(); ++v) sums.add(values_[v], rounded_[v]);
    out_.write(tensor.name, std::span<const std::byte>(stored_));
  }

  double relative_error(std::size_t kind) const {
    const auto found = sums_.find(kind);
    if (found == sums_.end() || found->second.values == 0) return 0;
    return std::sqrt(found->second.errors / found->second.values);
  }

 private:
  struct Sums {
    double errors = 0, values = 0;
    void add(float value, float rounded) {
      const double error = double{rounded} - value;
      errors += error * error;
      values += double{value} * value;
    }
  };

  static void check_finite(const TensorEntry& tensor, Dtype dtype, std::span<const float> values,
                           const char* when) {
    const ValueSummary summary = summarize_values(values);
    if (summary.finite()) return;
    fail(ErrorKind::kFormat, "tensor '", tensor.name, "', ", dtype_name(tensor.dtype), " ",
         shape_text(tensor.shape), " to be written as ", dtype_name(dtype), ", has ", summary.nan,
         " NaN and ", summary.infinite, " infinite values among ", summary.size, when);
  }

  void write_int8(const TensorEntry& tensor, Sums& sums) {
    const std::int64_t N = tensor.shape[0], K = tensor.shape[1];
    integers_.resize(values_.size());
    scales_.resize(static_cast<std::size_t>(N));
    const float* row = values_.data();
    std::int8_t* to = integers_.data();
    for (float& scale : scales_) {
      scale = quantize_channel(to, row, K);
      for (std::int64_t k = 0; k < K; ++k) sums.add(row[k], scale * static_cast<float>(to[k]));
      if (scale == 0) scale = 1;  // of a channel of zeros; scales in files are positive
      row += K;
      to += K;
    }
    out_.write(tensor.name, std::as_bytes(std::span<const std::int8_t>(integers_)));
    out_.write(scale_name(tensor.name), std::span<const float>(scales_));
  }

  WeightSource& source_;
  SafetensorsWriter& out_;
  std::map<std::size_t, Sums> sums_;
  std::vector<std::byte> stored_;
  std::vector<float> values_, rounded_, scales_;
  std::vector<std::int8_t> integers_;
};

}  // namespace

QuantizeResult plan_quantization(const WeightSource& source, const QuantizeOptions& options) {
  QuantizeResult result;
  std::map<std::size_t, QuantizedKind> kinds;
  for (const std::size_t i : kept_tensors(source, options)) {
    const TensorEntry& tensor = source.tensors()[i];
    const std::size_t kind = kind_of(tensor);
    const Dtype dtype = output_dtype(tensor, options.policy);
    QuantizedKind& row = kinds[kind];
    row.kind = kind == kOthers ? "others" : std::string(kLayerKinds[kind]);
    if (row.dtypes.find(dtype_name(dtype)) == std::string::npos)
      row.dtypes += (row.dtypes.empty() ? "" : ", ") + std::string(dtype_name(dtype));
    ++row.num_tensors;
    const std::int64_t after = output_bytes(tensor, dtype);
    for (auto* before : {&row.bytes_before, &result.bytes_before})
      *before = checked_add(*before, tensor.num_bytes).value();
    for (auto* sum : {&row.bytes_after, &result.bytes_after})
      *sum = checked_add(*sum, after).value();
  }
  for (auto& [kind, row] : kinds) result.kinds.push_back(std::move(row));
  return result;
}

QuantizeResult quantize_weights(WeightSource& source, const std::string& output,
                                const QuantizeOptions& options) {
  QuantizeResult result = plan_quantization(source, options);
  const std::vector<std::size_t> kept = kept_tensors(source, options);
  SafetensorsWriter out(output);
  bool any_int8 = false;
  for (const std::size_t i : kept) {
    const TensorEntry& tensor = source.tensors()[i];
    const Dtype dtype = output_dtype(tensor, options.policy);
    out.declare(tensor.name, dtype, tensor.shape);
    if (dtype != Dtype::kI8 || tensor.dtype == Dtype::kI8) continue;
    any_int8 = true;
    out.declare(scale_name(tensor.name), Dtype::kF32, {tensor.shape[0]});
  }
  for (const auto& [key, value] : source.metadata()) out.set_metadata(key, value);
  if (any_int8) out.set_metadata(std::string(kQuantizationKey), std::string(kInt8Scheme));
  out.set_metadata("storage", policy_text(result, options.policy));

  Rounding rounding(source, out);
  for (std::size_t done = 0; done < kept.size(); ++done) {
    if (options.before_each) options.before_each(done, kept.size());
    rounding.write(kept[done], output_dtype(source.tensors()[kept[done]], options.policy));
  }
  out.finish();
  for (QuantizedKind& row : result.kinds)
    for (std::size_t kind = 0; kind < kLayerKinds.size(); ++kind)
      if (row.kind == kLayerKinds[kind]) row.relative_error = rounding.relative_error(kind);
  return result;
}

}  // namespace lvggt
