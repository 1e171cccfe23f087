// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <mutex>
#include <optional>
#include <span>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/io/safetensors.h"
#include "lvggt/kernels/packed_matrix.h"
#include "lvggt/model/config.h"
#include "lvggt/model/storage_policy.h"
#include "lvggt/model/tensor_list.h"

namespace lvggt {

// Where the weights are and how strictly they are read.
struct LoadOptions {
  std::string weights =
      {};  // safetensors with the geometry tensors, and the decoder's unless `decoder` is given;
           // a file, a sharded model's index or the folder that holds it
  std::string decoder = {};  // safetensors with the decoder tensors; may be empty
  std::string state_decoder =
      {};  // safetensors with a second decoder, for what changes with time; may be empty
  std::string config =
      {};  // JSON configuration; empty: the metadata's "config", else what the shapes tell
  std::string overrides = {};  // safetensors whose tensors weight.NAME take the place of NAME and
                               // may change lang_dim; may be empty
  bool strict = false;  // tensors that the configuration does not name are an error, not a warning
  bool allow_nonfinite = false;  // accept NaN and infinity in weights
  bool points = true;            // load the point head, if it is there
  // How the packed weights are kept in memory; not given: as the file keeps each of them.
  std::optional<StoragePolicy> storage = {};
};

// What the names and shapes of the tensors tell of the configuration, and `base` for the rest. In
// particular: heads have the width of q_norm (64 without qk-norm), and the encoder and the camera
// head as many of them as the aggregator; taps are the published ones for 24 layers, else the ends
// of four equal parts of the layers. The decoder's sizes come from `decoder` when it is given.
ModelConfig infer_config(const Safetensors& geometry, const Safetensors* decoder,
                         const ModelConfig& base = {});

// The configuration of a decoder file beside a geometry model of that configuration: the decoder's
// part from its metadata's "config", else from its shapes. kMismatch when its metadata say that it
// reads the tokens of another encoder.
ModelConfig infer_decoder_config(const Safetensors& decoder, const ModelConfig& geometry);

// "lang_dim is 6, not 3; ...": how `found` differs from `expected`, without the names. Empty when
// it does not.
std::string config_difference(const ModelConfig& found, const ModelConfig& expected);

// The tensors of a model, possibly from several files, checked against its configuration before any
// is read.
class Checkpoint {
 public:
  // Opens the files, settles the configuration and compares every name and shape with it. One
  // kMismatch error reports all that is missing or misshapen, and which model the files look like
  // instead.
  explicit Checkpoint(const LoadOptions& options);

  // Of options.decoder alone, beside a geometry model of that configuration, which is not opened.
  Checkpoint(const LoadOptions& options, const ModelConfig& geometry);

  const ModelConfig& config() const { return config_; }

  // How the weight of that name is kept in memory: as the policy says, else as the file has it,
  // except for the decoder's UNets, which are float32 then: folding in their batch norms would
  // undo a file's rounding.
  Storage storage_of(const std::string& weight) const;
  // "16 weights as int8, 40 as f32": what the storages of all weights come to.
  std::string storage_summary() const;
  bool all_f32() const { return storage_counts_.size() == storage_counts_.count(Storage::kF32); }

  bool has_decoder() const { return has_decoder_; }
  bool has_point_head() const { return has_point_head_; }

  // One tensor, widened to float. Throws kFormat when a value is not finite, unless that is
  // allowed. May be called by several threads at once.
  template <int R>
  Tensor<float, R> read(const std::string& name) const {
    const Found found = find(name);
    if constexpr (R == 2) {
      if (found.entry->dtype == Dtype::kI8) return read_widened_int8(found);
    }
    Tensor<float, R> values = found.file->read<R>(found.entry->name);
    inspect(name, *found.file, {values.data(), static_cast<std::size_t>(values.size())});
    return values;
  }

  // The weight of a linear layer, packed in its storage. Integers of the file stay exactly as they
  // are when that is int8. Throws as read() does, and as read_quantized_linear().
  PackedMatrix read_linear(const std::string& name) const;

  // The same, seen as another shape of as many values: a token of [1, 2, 1, C] as [2, C].
  template <int R>
  Tensor<float, R> read_as(const std::string& name, Shape<R> shape) const {
    const Found found = find(name);
    Tensor<float, R> values(shape);
    const std::span<float> flat(values.data(), static_cast<std::size_t>(values.size()));
    found.file->read_into(found.entry->name, flat);
    inspect(name, *found.file, flat);
    return values;
  }

  // Sentences on what was odd but acceptable; complete once every tensor has been read.
  std::vector<std::string> warnings() const;

 private:
  struct Found {
    const Safetensors* file = nullptr;
    const TensorEntry* entry = nullptr;
  };
  struct Problems;
  Found look_up(const std::string& name) const;
  Found find(const std::string& name) const;
  void settle_config(const LoadOptions& options);
  void check_tensors(bool strict);
  void refuse_other_models() const;
  std::vector<TensorSpec> expected_tensors() const;
  void describe_storage(const std::vector<TensorSpec>& expected);
  Tensor<float, 2> read_widened_int8(const Found& found) const;
  void check_shapes(const std::vector<TensorSpec>& expected, Problems& problems) const;
  void check_extra(const std::vector<TensorSpec>& expected, bool strict, Problems& problems);
  void report(const Problems& problems) const;
  void inspect(const std::string& name, const Safetensors& file,
               std::span<const float> values) const;

  Safetensors geometry_;
  std::optional<Safetensors> decoder_;
  std::optional<Safetensors> overrides_;
  ModelConfig config_;
  std::optional<StoragePolicy> storage_;
  std::map<Storage, std::size_t> storage_counts_;  // weights of all layers
  bool has_decoder_ = false;
  bool has_point_head_ = false;
  bool skip_points_ = false;
  bool decoder_only_ = false;  // geometry_ is the file of a decoder
  bool allow_nonfinite_ = false;
  std::vector<std::string> warnings_;
  // Names of tensors found odd while reading; guarded because blocks are loaded in parallel.
  mutable std::mutex mutex_;
  mutable std::vector<std::string> all_zero_, denormal_, nonfinite_;
};

}  // namespace lvggt
