// SPDX-License-Identifier: Apache-2.0
#include "lvggt/data/token_cache.h"

#include <filesystem>
#include <span>

#include "lvggt/core/error.h"
#include "lvggt/core/parallel.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/checked.h"
#include "lvggt/io/hash.h"
#include "lvggt/io/safetensors.h"
#include "lvggt/io/value_summary.h"
#include "lvggt/model/tensor_list.h"

namespace lvggt {

namespace {

constexpr const char* kStreamKey = "stream_sha256";

std::string tap_name(std::size_t i) { return "tap." + std::to_string(i); }

std::string token_file(const std::string& folder, const std::string& name) {
  return folder + "/" + name + ".safetensors";
}

// Opens a frame's file and checks everything but the values.
Safetensors open_tokens(const std::string& folder, const TokenFrame& frame,
                        const TokenManifest& manifest) {
  const std::string path = token_file(folder, frame.name);
  Safetensors file = Safetensors::open(path);
  const auto stream = file.metadata().find(kStreamKey);
  LVGGT_CHECK(stream != file.metadata().end(), path, ": are no tokens that make_tokens wrote");
  LVGGT_CHECK(stream->second == frame.stream_sha256, path,
              ": these tokens come from another run than the manifest tells of: other weights, "
              "settings or pictures; make_tokens --force makes all again");
  const std::vector<std::int64_t> shape{size_product(manifest.h(), manifest.w()),
                                        manifest.channels()};
  for (std::size_t i = 0; i < 4; ++i) {
    const TensorEntry& entry = file.at(tap_name(i));
    LVGGT_CHECK(entry.shape == shape && entry.dtype == manifest.settings.storage, path, ": ",
                entry.name, " is ", dtype_name(entry.dtype), " ", shape_text(entry.shape),
                ", but the manifest says ", dtype_name(manifest.settings.storage), " ",
                shape_text(shape));
  }
  return file;
}

template <int R>
std::string sha256_values(const Tensor<float, R>& values) {
  return sha256(std::as_bytes(std::span(values.data(), static_cast<std::size_t>(values.size()))));
}

// Of the tensors of the encoder that are used, by name.
std::vector<TensorSpec> encoder_tensors(const ModelConfig& config) {
  std::vector<TensorSpec> specs;
  for (TensorSpec& spec : geometry_tensors(config))
    if (spec.name.starts_with("aggregator.") && !known_unused_tensor(spec.name))
      specs.push_back(std::move(spec));
  std::sort(specs.begin(), specs.end(),
            [](const TensorSpec& a, const TensorSpec& b) { return a.name < b.name; });
  return specs;
}

// Of names, shapes and values of the tensors.
std::string sha256_tensors(const Checkpoint& checkpoint, const std::vector<TensorSpec>& specs,
                           Context& ctx) {
  std::vector<std::string> sums(specs.size());
  parallel_chunks(
      static_cast<std::int64_t>(specs.size()),
      [&](std::int64_t chunk, int) {
        const auto i = static_cast<std::size_t>(chunk);
        // Matrices may be kept as integers and scales, which read<2>() widens.
        sums[i] = specs[i].shape.size() == 2
                      ? sha256_values(checkpoint.read<2>(specs[i].name))
                      : sha256_values(checkpoint.read_as(specs[i].name, Shape{specs[i].volume()}));
      },
      ctx);
  std::string text;
  for (std::size_t i = 0; i < specs.size(); ++i)
    text += specs[i].name + " " + shape_text(specs[i].shape) + " " + sums[i] + "\n";
  return sha256(std::as_bytes(std::span(text.data(), text.size())));
}

}  // namespace

std::string encoder_sha256(const Checkpoint& checkpoint, Context& ctx) {
  return sha256_tensors(checkpoint, encoder_tensors(checkpoint.config()), ctx);
}

std::string decoder_sha256(const Checkpoint& checkpoint, Context& ctx) {
  std::vector<TensorSpec> specs = decoder_tensors(checkpoint.config());
  std::sort(specs.begin(), specs.end(),
            [](const TensorSpec& a, const TensorSpec& b) { return a.name < b.name; });
  return sha256_tensors(checkpoint, specs, ctx);
}

std::string encoder_storage(const Checkpoint& checkpoint) {
  std::map<std::string_view, int> counts;
  for (const TensorSpec& spec : encoder_tensors(checkpoint.config()))
    if (spec.shape.size() >= 2 && spec.name.ends_with(".weight"))
      ++counts[storage_name(checkpoint.storage_of(spec.name))];
  if (counts.size() == 1) return std::string(counts.begin()->first);
  std::string text;
  for (const auto& [name, count] : counts)
    text += concat(text.empty() ? "" : ", ", count, " ", name);
  return text;
}

void write_tokens(const std::string& folder, const TokenFrame& frame,
                  const std::array<View<const float, 2>, 4>& taps, Dtype storage) {
  SafetensorsWriter out(token_file(folder, frame.name));
  out.set_metadata(kStreamKey, frame.stream_sha256);
  for (std::size_t i = 0; i < 4; ++i)
    out.declare(tap_name(i), storage, {taps[i].extent(0), taps[i].extent(1)});
  for (std::size_t i = 0; i < 4; ++i)
    for (std::int64_t row = 0; row < taps[i].extent(0); ++row)
      out.write(tap_name(i), std::span<const float>(&taps[i](row, 0),
                                                    static_cast<std::size_t>(taps[i].extent(1))));
  out.finish();
}

bool has_tokens(const std::string& folder, const TokenFrame& frame, const TokenManifest& manifest) {
  std::error_code ignored;
  if (!std::filesystem::exists(token_file(folder, frame.name), ignored)) return false;
  try {
    open_tokens(folder, frame, manifest);
  } catch (const Error&) {
    return false;  // cut short or of another run: it is written again
  }
  return true;
}

bool is_token_file(const std::string& path) {
  try {
    return Safetensors::open(path).metadata().count(kStreamKey) > 0;
  } catch (const Error&) {
    return false;
  }
}

TokenCache TokenCache::open(const std::string& folder) {
  TokenCache cache;
  cache.folder_ = folder;
  const std::string path = folder + "/" + kTokenManifest;
  std::error_code ignored;
  if (!std::filesystem::exists(path, ignored))
    fail(ErrorKind::kRead, path,
         ": there is no such file; make_tokens writes the tokens that "
         "training reads");
  cache.manifest_ = read_token_manifest(path);
  for (std::size_t i = 0; i < cache.manifest_.frames.size(); ++i)
    cache.by_name_[cache.manifest_.frames[i].name] = i;
  return cache;
}

const TokenFrame* TokenCache::find(const std::string& name) const {
  const auto found = by_name_.find(name);
  return found == by_name_.end() ? nullptr : &manifest_.frames[found->second];
}

void TokenCache::check(const std::string& name) const {
  const TokenFrame* frame = find(name);
  if (frame == nullptr)
    fail(ErrorKind::kMismatch, folder_, ": has no tokens of frame ", name,
         manifest_.complete ? "; they were made from other frames"
                            : "; make_tokens was interrupted before, --resume continues it");
  open_tokens(folder_, *frame, manifest_);
}

void TokenCache::read(const std::array<View<float, 2>, 4>& taps, const std::string& name) const {
  const TokenFrame* frame = find(name);
  if (frame == nullptr) return check(name);
  const Safetensors file = open_tokens(folder_, *frame, manifest_);
  for (std::size_t i = 0; i < 4; ++i) {
    LVGGT_CHECK(taps[i].dense(), "tokens: the room for ", tap_name(i), " has gaps");
    const std::span<float> values(taps[i].data(), static_cast<std::size_t>(taps[i].size()));
    file.read_into(tap_name(i), values);
    if (!summarize_values(values).finite())
      fail(ErrorKind::kNumeric, file.path(), ": ", tap_name(i),
           " holds values that are not finite");
  }
}

}  // namespace lvggt
