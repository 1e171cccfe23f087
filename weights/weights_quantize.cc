// SPDX-License-Identifier: Apache-2.0
// Writes weights in narrower types: half the size, a quarter, or a mixture by kind of layer.
#include <cstdio>
#include <string>
#include <vector>

#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/program.h"
#include "lvggt/cli/progress.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/hash.h"
#include "weights/quantize.h"

namespace {

constexpr const char* kDescription =
    "Writes weights in narrower types, so that files and memory shrink to a half or a quarter. IN "
    "is anything\n"
    "weights_convert takes; OUT is one safetensors file that every program loads as it is.\n\n"
    "bf16 and f16 halve every weight of a layer; the computation stays float32. int8 keeps the "
    "linear layers\n"
    "of the transformer blocks as integers of 7 bits with one scale for each output channel (so "
    "that integer\n"
    "products are exact and fast), and other layers as bf16. Norms, tokens and biases stay as they "
    "are.";

constexpr const char* kFooter =
    "Kinds for --kind, from the most values to the fewest, are MODULE.LAYER:\n"
    "  dino, frame, global, camera  with  .qkv .proj .fc1 .fc2    the transformer blocks\n"
    "  camera.pose                  the camera head's other linear layers\n"
    "  patch_embed, depth, points, decoder.dpt, decoder.unet      convolutions: f32, bf16, f16\n"
    "A module alone (dino) means all its layers, a layer alone (fc2) that of all modules. What "
    "each costs in\n"
    "accuracy is measured by weights_sensitivity.\n\n"
    "Examples:\n"
    "  weights_quantize streamvggt.safetensors streamvggt_int8.safetensors\n"
    "  weights_quantize --storage bf16 --drop track_head. checkpoints.pth half.safetensors\n"
    "  weights_quantize --kind fc2=bf16 --kind camera=f32 model.safetensors mixed.safetensors\n"
    "  weights_quantize --dry-run model.safetensors\n\n"
    "Exit status: 0 done, 1 failed at run time (full disk), 2 wrong usage, 3 bad input file, 4 "
    "memory or a\nlimit, 130 interrupted.";

struct Options {
  std::string input, output, storage = "int8", sha256;
  std::vector<std::string> kinds, drop;
  bool force = false, dry_run = false;
};

lvggt::StoragePolicy policy_of(const Options& options) {
  using namespace lvggt;
  StoragePolicy policy = StoragePolicy::of(parse_storage(options.storage, "--storage"));
  for (const std::string& kind : options.kinds) {
    const std::size_t equals = kind.find('=');
    if (equals == std::string::npos)
      fail(ErrorKind::kUsage, "--kind: '", kind, "' is not of the form KIND=TYPE");
    policy.set(kind.substr(0, equals), parse_storage(kind.substr(equals + 1), "--kind"), "--kind");
  }
  return policy;
}

std::string bytes_text(std::int64_t bytes) {
  return lvggt::cli::bytes_text(static_cast<std::size_t>(bytes));
}

void print_kinds(const lvggt::QuantizeResult& result, bool with_errors) {
  std::printf("%-13s %-10s %7s %11s %11s%s\n", "layers", "type", "tensors", "before", "after",
              with_errors ? "  rounding" : "");
  for (const lvggt::QuantizedKind& row : result.kinds) {
    std::printf("%-13s %-10s %7lld %11s %11s", row.kind.c_str(), row.dtypes.c_str(),
                static_cast<long long>(row.num_tensors), bytes_text(row.bytes_before).c_str(),
                bytes_text(row.bytes_after).c_str());
    if (with_errors && row.relative_error > 0)
      std::printf("  %s %%", lvggt::cli::fixed(100 * row.relative_error, 2).c_str());
    std::printf("\n");
  }
}

int run(const Options& options) {
  lvggt::QuantizeOptions quantize;
  quantize.policy = policy_of(options);
  quantize.drop = options.drop;
  if (options.output.empty() && !options.dry_run)
    lvggt::fail(lvggt::ErrorKind::kUsage, "the name of the .safetensors file to write is missing");
  const lvggt::cli::InterruptGuard interrupt;
  if (!options.output.empty()) lvggt::check_output_file(options.output, options.force);
  if (!options.sha256.empty()) lvggt::check_sha256(options.input, options.sha256);
  const auto source = lvggt::WeightSource::open(options.input);
  for (const std::string& note : source->notes()) std::fprintf(stderr, "note: %s\n", note.c_str());
  if (options.dry_run) {
    const lvggt::QuantizeResult plan = plan_quantization(*source, quantize);
    print_kinds(plan, false);
    std::printf("%s would become %s\n", bytes_text(plan.bytes_before).c_str(),
                bytes_text(plan.bytes_after).c_str());
    return 0;
  }
  lvggt::cli::Progress progress(static_cast<std::int64_t>(source->tensors().size()), "tensors");
  quantize.before_each = [&](std::size_t done, std::size_t) {
    if (interrupt.requested())
      lvggt::fail(lvggt::ErrorKind::kInterrupted, "interrupted, nothing is written");
    progress.show(static_cast<std::int64_t>(done));
  };
  const lvggt::QuantizeResult result = quantize_weights(*source, options.output, quantize);
  progress.clear();
  print_kinds(result, true);
  std::printf("%s: %s, from %s\n", options.output.c_str(), bytes_text(result.bytes_after).c_str(),
              bytes_text(result.bytes_before).c_str());
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  lvggt::cli::Program program("weights_quantize", kDescription, LVGGT_VERSION);
  CLI::App& app = program.app();
  app.footer(kFooter);
  app.add_option("in", options.input, "Checkpoint or safetensors to read")->required();
  app.add_option("out", options.output, "The .safetensors file to write");
  app.add_option("--storage", options.storage, "How layers are kept: int8, bf16, f16 or f32")
      ->check(CLI::IsMember({"int8", "bf16", "f16", "f32"}))
      ->type_name("TYPE")
      ->capture_default_str();
  app.add_option("--kind", options.kinds,
                 "Another type for one kind of layers; may be given several times, the last one "
                 "counts")
      ->type_name("KIND=TYPE")
      ->allow_extra_args(false);
  app.add_option("--drop", options.drop,
                 "Leave out tensors whose names begin so; may be given several times")
      ->type_name("PREFIX")
      ->allow_extra_args(false);
  app.add_option("--sha256", options.sha256, "Refuse the input unless its SHA-256 sum is this")
      ->type_name("HEX");
  app.add_flag("--dry-run", options.dry_run, "Print what would become of the layers, and stop");
  app.add_flag("--force", options.force, "Replace an existing output");
  return program.run(argc, argv, [&] { return run(options); });
}
