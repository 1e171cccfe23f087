// SPDX-License-Identifier: Apache-2.0
// Writes the weights of an untrained model that depend on a seed only.
#include <algorithm>
#include <cstdio>
#include <limits>
#include <string>
#include <vector>

#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/program.h"
#include "lvggt/cli/threads.h"
#include "lvggt/core/context.h"
#include "lvggt/io/atomic_file.h"
#include "lvggt/io/safetensors.h"
#include "lvggt/model/config.h"
#include "lvggt/model/deterministic_weights.h"
#include "lvggt/model/tensor_list.h"

namespace {

using lvggt::ModelConfig;
using lvggt::TensorSpec;

constexpr const char* kDescription =
    "Writes untrained weights for any configuration. Every value follows from the tensor's name, "
    "its shape and\n"
    "the seed, so two people with the same seed have the same model without sending a file. Such a "
    "model runs\n"
    "at full speed and is good for tests and measurements; what it predicts means nothing.";

constexpr const char* kFooter =
    "Examples:\n"
    "  weights_init --seed 3 model.safetensors                 the published sizes, 4.9 GB\n"
    "  weights_init --config small.json model.safetensors      sizes from a JSON file\n"
    "  weights_init --decoder-out decoder.safetensors geometry.safetensors\n"
    "                                                          two files, as the releases have "
    "them\n\n"
    "Exit status: 0 done, 1 failed at run time, 2 wrong usage, 3 bad input file, 4 memory or a "
    "limit.";

struct Options {
  std::string output;
  std::string decoder_output;
  std::string config = "published";
  std::string part = "all";
  std::uint64_t seed = 0;
  int threads = 0;
  bool force = false;
  bool list = false;
};

ModelConfig config_of(const std::string& option) {
  return option == "published" ? ModelConfig{} : lvggt::load_config(option);
}

// Streams the tensors of `specs` into one file; returns the bytes written.
std::int64_t write_weights(const std::string& path, const std::vector<TensorSpec>& specs,
                           const ModelConfig& config, std::uint64_t seed,
                           const lvggt::cli::InterruptGuard& interrupt, lvggt::Context& ctx) {
  lvggt::SafetensorsWriter out(path);
  out.set_metadata("config", lvggt::to_json(config));
  out.set_metadata("origin", "untrained, by the deterministic rule");
  out.set_metadata("seed", std::to_string(seed));
  std::int64_t largest = 0;
  std::int64_t total = 0;
  for (const TensorSpec& spec : specs) {
    out.declare(spec.name, lvggt::Dtype::kF32, spec.shape);
    largest = std::max(largest, spec.volume());
    total += spec.volume();
  }
  std::vector<float> buffer(static_cast<std::size_t>(largest));
  for (const TensorSpec& spec : specs) {
    if (interrupt.requested())
      lvggt::fail(lvggt::ErrorKind::kInterrupted, "interrupted, ", path, " is not written");
    const auto values = std::span(buffer).first(static_cast<std::size_t>(spec.volume()));
    lvggt::deterministic_values(spec.name, spec.shape, seed, values, ctx);
    out.write(spec.name, std::span<const float>(values));
  }
  out.finish();
  return total * lvggt::dtype_size(lvggt::Dtype::kF32);
}

void report(const std::string& path, std::size_t num_tensors, std::int64_t num_bytes) {
  std::printf("%s: %zu tensors, %s\n", path.c_str(), num_tensors,
              lvggt::cli::bytes_text(static_cast<std::size_t>(num_bytes)).c_str());
}

// The loader's contract, as in names.tsv.
void print_tensors(const std::vector<TensorSpec>& specs, const char* part) {
  for (const TensorSpec& spec : specs)
    std::printf("%s\tF32\t%s\t%s\n", spec.name.c_str(), lvggt::shape_text(spec.shape).c_str(),
                part);
}

int list_tensors(const Options& options) {
  const ModelConfig config = config_of(options.config);
  std::printf("name\tdtype\tshape\tcheckpoint\n");
  if (options.part != "decoder") print_tensors(lvggt::geometry_tensors(config), "geometry");
  if (options.part != "geometry") print_tensors(lvggt::decoder_tensors(config), "decoder");
  return 0;
}

int run(const Options& options) {
  if (options.list) return list_tensors(options);
  if (options.output.empty())
    lvggt::fail(lvggt::ErrorKind::kUsage, "the name of the .safetensors file to write is missing");
  const bool two_files = !options.decoder_output.empty();
  if (two_files && options.part != "all")
    lvggt::fail(lvggt::ErrorKind::kUsage, "--decoder-out writes both parts, so --part ",
                options.part, " makes no sense with it");
  if (two_files && options.decoder_output == options.output)
    lvggt::fail(lvggt::ErrorKind::kUsage, "--decoder-out names the same file as the geometry's");
  const lvggt::cli::InterruptGuard interrupt;
  lvggt::check_output_file(options.output, options.force);
  if (two_files) lvggt::check_output_file(options.decoder_output, options.force);

  const ModelConfig config = config_of(options.config);
  lvggt::Context ctx(lvggt::cli::choose_threads(options.threads).threads);
  std::vector<TensorSpec> specs;
  if (options.part != "decoder") specs = lvggt::geometry_tensors(config);
  const std::vector<TensorSpec> decoder =
      options.part == "geometry" ? std::vector<TensorSpec>{} : lvggt::decoder_tensors(config);
  if (!two_files) specs.insert(specs.end(), decoder.begin(), decoder.end());
  report(options.output, specs.size(),
         write_weights(options.output, specs, config, options.seed, interrupt, ctx));
  if (two_files)
    report(options.decoder_output, decoder.size(),
           write_weights(options.decoder_output, decoder, config, options.seed, interrupt, ctx));
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  lvggt::cli::Program program("weights_init", kDescription, LVGGT_VERSION);
  CLI::App& app = program.app();
  app.footer(kFooter);
  app.add_option("output", options.output, "The .safetensors file to write");
  app.add_option("--decoder-out", options.decoder_output,
                 "Write the decoder's tensors to this file instead of the same one");
  app.add_option("--config", options.config, "'published', or a JSON file with sizes")
      ->capture_default_str();
  app.add_option("--part", options.part, "Which tensors")
      ->check(CLI::IsMember({"all", "geometry", "decoder"}))
      ->capture_default_str();
  program.add_number<std::uint64_t>("--seed", options.seed, "The same seed gives the same weights",
                                    0, std::numeric_limits<std::uint64_t>::max());
  lvggt::cli::add_threads_option(program, options.threads);
  app.add_flag("--list", options.list, "Print names and shapes as a table and write nothing");
  app.add_flag("--force", options.force, "Replace existing files");
  return program.run(argc, argv, [&] { return run(options); });
}
