// SPDX-License-Identifier: Apache-2.0
#include "weights/convert.h"

#include <algorithm>

#include "lvggt/core/error.h"
#include "lvggt/io/checked.h"
#include "lvggt/io/value_summary.h"

namespace lvggt {
namespace {

bool is_dropped(const std::string& name, const std::vector<std::string>& prefixes) {
  return std::any_of(prefixes.begin(), prefixes.end(),
                     [&](const std::string& prefix) { return name.starts_with(prefix); });
}

Dtype output_dtype(const TensorEntry& tensor, const ConvertOptions& options) {
  return options.dtype && dtype_is_float(tensor.dtype) ? *options.dtype : tensor.dtype;
}

// Buffers of one tensor, kept from one to the next.
struct Buffers {
  std::vector<std::byte> stored;
  std::vector<float> values;
  std::vector<std::byte> converted;
};

void check_finite(const TensorEntry& tensor, const ValueSummary& summary, const char* when) {
  if (summary.finite()) return;
  fail(ErrorKind::kFormat, "tensor '", tensor.name, "' has ", summary.nan, " NaN and ",
       summary.infinite, " infinite values among ", summary.size, when,
       "; --allow-nonfinite accepts them");
}

// Appends one floating-point tensor to the output.
void write_floats(const TensorEntry& tensor, Dtype dtype, bool allow_nonfinite, Buffers& buffers,
                  SafetensorsWriter& out, std::vector<std::string>& warnings) {
  buffers.values.resize(static_cast<std::size_t>(tensor.size()));
  to_float32(tensor.dtype, buffers.stored, buffers.values);
  const ValueSummary summary = summarize_values(buffers.values);
  if (!allow_nonfinite) check_finite(tensor, summary, "");
  if (const std::string reason = suspicion(summary); !reason.empty())
    warnings.push_back("tensor '" + tensor.name + "': " + reason);
  if (dtype == tensor.dtype) {
    out.write(tensor.name, std::span<const std::byte>(buffers.stored));
    return;
  }
  const auto num_bytes = checked_mul(tensor.size(), dtype_size(dtype));
  buffers.converted.resize(static_cast<std::size_t>(num_bytes.value()));
  from_float32(dtype, buffers.values, buffers.converted);
  if (!allow_nonfinite) {
    to_float32(dtype, buffers.converted, buffers.values);
    check_finite(tensor, summarize_values(buffers.values), " once converted");
  }
  out.write(tensor.name, std::span<const std::byte>(buffers.converted));
}

void set_metadata(SafetensorsWriter& out, const WeightSource& source,
                  const ConvertOptions& options) {
  std::map<std::string, std::string> metadata = source.metadata();
  metadata.emplace("format", "pt");  // what Python's readers of safetensors look for
  if (!options.config.empty()) metadata["config"] = options.config;
  for (const auto& [key, value] : metadata) out.set_metadata(key, value);
}

}  // namespace

ConvertResult convert_weights(WeightSource& source, const std::string& output,
                              const ConvertOptions& options) {
  ConvertResult result;
  SafetensorsWriter out(output);
  set_metadata(out, source, options);
  for (const TensorEntry& tensor : source.tensors()) {
    if (is_dropped(tensor.name, options.drop)) {
      ++result.num_dropped;
      continue;
    }
    const Dtype dtype = output_dtype(tensor, options);
    out.declare(tensor.name, dtype, tensor.shape);
    ++result.num_tensors;
    result.num_values = checked_add(result.num_values, tensor.size()).value();
    result.num_bytes =
        checked_add(result.num_bytes, checked_mul(tensor.size(), dtype_size(dtype)).value())
            .value();
  }
  Buffers buffers;
  for (std::size_t i = 0; i < source.tensors().size(); ++i) {
    const TensorEntry& tensor = source.tensors()[i];
    if (is_dropped(tensor.name, options.drop)) continue;
    if (options.before_each) options.before_each();
    buffers.stored.resize(static_cast<std::size_t>(tensor.num_bytes));
    source.read(i, buffers.stored);
    if (dtype_is_float(tensor.dtype)) {
      write_floats(tensor, output_dtype(tensor, options), options.allow_nonfinite, buffers, out,
                   result.warnings);
    } else {
      out.write(tensor.name, std::span<const std::byte>(buffers.stored));
    }
  }
  out.finish();
  return result;
}

}  // namespace lvggt
