// SPDX-License-Identifier: Apache-2.0
// Makes one safetensors file of a published checkpoint.
#include <cstdio>
#include <string>
#include <vector>

#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/program.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/hash.h"
#include "lvggt/model/config.h"
#include "weights/convert.h"

namespace {

constexpr const char* kDescription =
    "Makes one safetensors file of published weights. IN is a PyTorch checkpoint (.pth, .pt, .bin) "
    "or safetensors\n"
    "(a file, the index of a model in several files, or the folder it is in). A checkpoint is a "
    "program for\n"
    "Python's unpickler; here only tensors and plain containers are read, and nothing is ever "
    "executed. Tensor\n"
    "names stay as they are.";

constexpr const char* kFooter =
    "Examples:\n"
    "  weights_convert checkpoints.pth streamvggt.safetensors\n"
    "  weights_convert --dtype bf16 --drop track_head. model.pt vggt.safetensors\n"
    "  weights_convert --config decoder.json decoder.pth decoder.safetensors\n\n"
    "Exit status: 0 done, 1 failed at run time (full disk), 2 wrong usage, 3 "
    "bad input file,\n"
    "4 memory or a limit.";

struct Options {
  std::string input;
  std::string output;
  std::string dtype;
  std::string config;
  std::string sha256;
  std::vector<std::string> drop;
  bool allow_nonfinite = false;
  bool force = false;
};

lvggt::ConvertOptions convert_options(const Options& options) {
  lvggt::ConvertOptions convert;
  if (options.dtype == "f32") convert.dtype = lvggt::Dtype::kF32;
  if (options.dtype == "f16") convert.dtype = lvggt::Dtype::kF16;
  if (options.dtype == "bf16") convert.dtype = lvggt::Dtype::kBF16;
  if (options.config == "published") {
    convert.config = lvggt::to_json(lvggt::ModelConfig{});
  } else if (!options.config.empty()) {
    convert.config = lvggt::to_json(lvggt::load_config(options.config));
  }
  convert.drop = options.drop;
  convert.allow_nonfinite = options.allow_nonfinite;
  return convert;
}

int run(const Options& options) {
  const lvggt::cli::InterruptGuard interrupt;
  lvggt::check_output_file(options.output, options.force);
  lvggt::ConvertOptions convert = convert_options(options);
  convert.before_each = [&] {
    if (interrupt.requested())
      lvggt::fail(lvggt::ErrorKind::kInterrupted, "interrupted, nothing is written");
  };
  if (!options.sha256.empty()) lvggt::check_sha256(options.input, options.sha256);
  const auto source = lvggt::WeightSource::open(options.input);
  for (const std::string& note : source->notes()) std::fprintf(stderr, "note: %s\n", note.c_str());
  const lvggt::ConvertResult result = lvggt::convert_weights(*source, options.output, convert);
  for (const std::string& warning : result.warnings)
    std::fprintf(stderr, "warning: %s\n", warning.c_str());
  std::printf("%s: %zu tensors, %lld values, %s", options.output.c_str(), result.num_tensors,
              static_cast<long long>(result.num_values),
              lvggt::cli::bytes_text(static_cast<std::size_t>(result.num_bytes)).c_str());
  if (result.num_dropped > 0) std::printf(", %zu tensors left out", result.num_dropped);
  std::printf("\n");
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  lvggt::cli::Program program("weights_convert", kDescription, LVGGT_VERSION);
  CLI::App& app = program.app();
  app.footer(kFooter);
  app.add_option("in", options.input, "Checkpoint or safetensors to read")->required();
  app.add_option("out", options.output, "The .safetensors file to write")->required();
  app.add_option("--dtype", options.dtype,
                 "Type of floating-point values in the output; by default unchanged")
      ->check(CLI::IsMember({"f32", "f16", "bf16"}));
  app.add_option("--config", options.config,
                 "'published' or a JSON file: sizes of the model, kept in the output's metadata");
  app.add_option("--drop", options.drop,
                 "Leave out tensors whose names begin so; may be given several times")
      ->allow_extra_args(false);
  app.add_option("--sha256", options.sha256, "Refuse the input unless its SHA-256 sum is this");
  app.add_flag("--allow-nonfinite", options.allow_nonfinite,
               "Accept NaN and infinity in the weights");
  app.add_flag("--force", options.force, "Replace an existing output");
  return program.run(argc, argv, [&] { return run(options); });
}
