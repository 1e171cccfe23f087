// SPDX-License-Identifier: Apache-2.0
#include "weights/sensitivity.h"

#include <algorithm>
#include <cmath>
#include <utility>

#include "lvggt/model/deterministic_weights.h"

namespace lvggt {
namespace {

// All frames' outputs, in the order of kSensitivityOutputs.
using Outputs = std::array<std::vector<float>, kSensitivityOutputs.size()>;

Outputs run(const LangVggt& model, View<const float, 4> images, Storage cache, Context& ctx) {
  StreamOptions options;
  options.cache_storage = cache;
  options.max_past_frames = images.extent(0);
  options.allow_degenerate_camera = true;
  Stream stream(model, ctx, options);
  Outputs outputs;
  for (std::int64_t i = 0; i < images.extent(0); ++i) {
    const Frame frame = stream.push(images[i]);
    const auto append = [](std::vector<float>& to, auto view) {
      if (view) to.insert(to.end(), view.data(), view.data() + view.size());
    };
    append(outputs[0], frame.pose_encoding);
    append(outputs[1], frame.depth);
    append(outputs[2], frame.language);
    append(outputs[3], frame.rgb);
  }
  return outputs;
}

double relative_l2(const std::vector<float>& ours, const std::vector<float>& exact) {
  if (exact.empty()) return -1;
  double error = 0, norm = 0;
  for (std::size_t i = 0; i < exact.size(); ++i) {
    error += std::pow(double{ours[i]} - exact[i], 2);
    norm += std::pow(double{exact[i]}, 2);
  }
  return norm > 0 ? std::sqrt(error / norm) : 0;
}

// The linear layers of one module's blocks.
void reload_blocks(std::vector<Block>& blocks, const Checkpoint& c, const std::string& prefix,
                   std::size_t layer, Context& ctx) {
  constexpr std::array<const char*, 4> kNames{".attn.qkv", ".attn.proj", ".mlp.fc1", ".mlp.fc2"};
  parallel_chunks(
      std::ssize(blocks),
      [&](std::int64_t i, int) {
        Block& block = blocks[static_cast<std::size_t>(i)];
        const std::array<PackedMatrix*, 4> weights{&block.attn.qkv.weight, &block.attn.proj.weight,
                                                   &block.mlp.fc1.weight, &block.mlp.fc2.weight};
        *weights[layer] =
            c.read_linear(prefix + "." + std::to_string(i) + kNames[layer] + ".weight");
      },
      ctx);
}

// Packs the layers of one kind again, in the storage that the checkpoint's policy says.
void reload_kind(LangVggt& model, const Checkpoint& c, std::size_t kind, Context& ctx) {
  Aggregator& aggregator = model.geometry().aggregator;
  CameraHead& camera = model.geometry().camera_head;
  const std::array<std::pair<std::vector<Block>*, const char*>, 4> modules{
      std::pair{&aggregator.patch_embed.blocks, "aggregator.patch_embed.blocks"},
      std::pair{&aggregator.frame_blocks, "aggregator.frame_blocks"},
      std::pair{&aggregator.global_blocks, "aggregator.global_blocks"},
      std::pair{&camera.trunk, "camera_head.trunk"}};
  if (kind < 4 * modules.size()) {
    const auto& [blocks, prefix] = modules[kind / 4];
    return reload_blocks(*blocks, c, prefix, kind % 4, ctx);
  }
  const std::string_view name = kLayerKinds[kind];
  if (name == "camera.pose") {
    camera.embed_pose = load_linear(c, "camera_head.embed_pose");
    camera.pose_ln_modulation = load_linear(c, "camera_head.poseLN_modulation.1");
    camera.pose_branch = {load_linear(c, "camera_head.pose_branch.fc1"),
                          load_linear(c, "camera_head.pose_branch.fc2")};
  } else if (name == "patch_embed") {
    aggregator.patch_embed.patch_embed.proj =
        load_conv2d(c, "aggregator.patch_embed.patch_embed.proj", c.config().patch_size, 0);
  } else if (name == "depth") {
    model.geometry().depth_head = load_dpt_head(c, "depth_head", true);
  } else {
    model.decoder() = load_semantic_bridging_decoder(c);
  }
}

// Kinds that the outputs depend on, of those that are asked for.
std::vector<std::size_t> chosen_kinds(const SensitivityOptions& options, bool has_decoder) {
  for (const std::string& kind : options.kinds)
    if (std::find(kLayerKinds.begin(), kLayerKinds.end(), kind) == kLayerKinds.end())
      fail(ErrorKind::kUsage, "'", kind, "' is none of the kinds of layers");
  std::vector<std::size_t> kinds;
  for (std::size_t kind = 0; kind < kLayerKinds.size(); ++kind) {
    const std::string_view name = kLayerKinds[kind];
    const bool runs = name != "points" && (has_decoder || !name.starts_with("decoder."));
    const bool asked =
        options.kinds.empty() ||
        std::find(options.kinds.begin(), options.kinds.end(), name) != options.kinds.end();
    if (runs && asked) kinds.push_back(kind);
  }
  return kinds;
}

// Bytes of the weights of one kind, or of all for kLayerKinds.size().
std::size_t weight_bytes(const Checkpoint& c, std::size_t kind) {
  std::vector<TensorSpec> specs = geometry_tensors(c.config());
  if (c.has_decoder())
    for (TensorSpec& spec : decoder_tensors(c.config())) specs.push_back(std::move(spec));
  std::size_t bytes = 0;
  for (const TensorSpec& spec : specs) {
    if (spec.shape.size() < 2 || !spec.name.ends_with(".weight") ||
        spec.name.starts_with("point_head."))
      continue;
    if (kind == kLayerKinds.size() || layer_kind(spec.name) == kind)
      bytes += static_cast<std::size_t>(spec.volume()) * storage_bytes(c.storage_of(spec.name));
  }
  return bytes;
}

// One measurement: kinds == {} is for all weights by the policy of the storage.
struct Case {
  std::vector<std::size_t> kinds;
  Storage weights = Storage::kF32, cache = Storage::kF32;
};

std::vector<Case> cases_of(const SensitivityOptions& options, bool has_decoder) {
  std::vector<Case> cases;
  for (const std::size_t kind : chosen_kinds(options, has_decoder))
    for (const Storage storage : options.storages)
      if (storage != Storage::kI8 || kind < kNumLinearKinds) cases.push_back({{kind}, storage, {}});
  if (!options.kinds.empty()) return cases;
  for (const Storage storage : options.storages) {
    if (storage != Storage::kF16) cases.push_back({{}, Storage::kF32, storage});
    cases.push_back({{}, storage, storage == Storage::kF16 ? Storage::kF32 : storage});
  }
  return cases;
}

}  // namespace

std::vector<Sensitivity> measure_sensitivity(const LoadOptions& load,
                                             const SensitivityOptions& options, Context& ctx) {
  LoadOptions exact = load;
  exact.storage = StoragePolicy{};
  exact.points = false;
  LangVggt model = LangVggt::load(exact, ctx);
  const Checkpoint checkpoint(exact);
  const Tensor<float, 4> images =
      deterministic_images(options.seed, options.frames, options.H, options.W);
  const std::vector<Case> cases = cases_of(options, model.has_decoder());
  std::vector<std::size_t> all;
  for (std::size_t kind = 0; kind < kLayerKinds.size(); ++kind) all.push_back(kind);

  const Outputs expected = run(model, images, Storage::kF32, ctx);
  std::vector<Sensitivity> results;
  for (const Case& one : cases) {
    if (options.before_each) options.before_each(results.size(), cases.size());
    const bool whole = one.kinds.empty();
    StoragePolicy policy;
    if (whole) policy = StoragePolicy::of(one.weights);
    for (const std::size_t kind : one.kinds) policy.kinds[kind] = one.weights;
    LoadOptions narrow = exact;
    narrow.storage = policy;
    const Checkpoint narrowed(narrow);
    std::vector<std::size_t> changed;
    for (const std::size_t kind : chosen_kinds({}, model.has_decoder()))
      if (policy.kinds[kind] != Storage::kF32) changed.push_back(kind);
    for (const std::size_t kind : changed) reload_kind(model, narrowed, kind, ctx);
    const Outputs outputs = run(model, images, one.cache, ctx);
    for (const std::size_t kind : changed) reload_kind(model, checkpoint, kind, ctx);

    Sensitivity result{whole ? "all" : std::string(kLayerKinds[one.kinds[0]]),
                       one.weights,
                       one.cache,
                       weight_bytes(narrowed, whole ? all.size() : one.kinds[0]),
                       {}};
    for (std::size_t i = 0; i < outputs.size(); ++i)
      result.relative_l2[i] = relative_l2(outputs[i], expected[i]);
    results.push_back(std::move(result));
  }
  return results;
}

}  // namespace lvggt
