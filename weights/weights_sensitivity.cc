// SPDX-License-Identifier: Apache-2.0
// Says what narrow storage of one kind of layers after the other costs in accuracy.
#include <cstdio>
#include <string>
#include <vector>

#include "lvggt/cli/interrupt.h"
#include "lvggt/cli/program.h"
#include "lvggt/cli/progress.h"
#include "lvggt/cli/threads.h"
#include "weights/sensitivity.h"

namespace {

using namespace lvggt;

constexpr const char* kDescription =
    "Runs a model in float32, then again with one kind of layers after the other in narrow types, "
    "and prints what\n"
    "that changes in camera poses, depth, semantics and colours, in percent: |narrow - f32| / "
    "|f32|. The last rows\n"
    "are caches of past frames in narrow types and the whole of --weights-storage and "
    "--cache-storage. The frames\n"
    "follow from a seed, so that the table can be repeated anywhere.";

constexpr const char* kFooter =
    "Examples:\n"
    "  weights_sensitivity model.safetensors\n"
    "  weights_sensitivity --size 518x294 --kind dino.fc2 --kind global.fc2 model.safetensors\n\n"
    "Needs the memory of the float32 model, and the time of two frames for every row.\n\n"
    "Exit status: 0 done, 1 failed at run time, 2 wrong usage, 3 bad input file, 4 memory or a "
    "limit.";

struct Options {
  LoadOptions load;
  SensitivityOptions measure;
  std::vector<std::string> storages{"bf16", "int8"};
  std::string size = "182x98";
  int threads = 0;
};

// "182x98" as W and H.
void parse_size(const std::string& text, SensitivityOptions& options) {
  const std::size_t x = text.find('x');
  if (x == std::string::npos || !cli::parse_number(text.substr(0, x), options.W) ||
      !cli::parse_number(text.substr(x + 1), options.H) || options.W < 1 || options.H < 1 ||
      options.W > kMaxSide || options.H > kMaxSide)
    fail(ErrorKind::kUsage, "--size: '", text, "' is not WIDTHxHEIGHT in pixels, like 182x98");
}

std::string percent(double share) {
  if (share < 0) return "-";
  return cli::fixed(100 * share, share < 0.001 ? 3 : 2);
}

void print_table(const std::vector<Sensitivity>& rows) {
  std::printf("| %-12s | weights | cache | %9s |", "layers", "size");
  for (const std::string_view output : kSensitivityOutputs)
    std::printf(" %9s |", std::string(output).c_str());
  std::printf("\n|---|---|---|---|");
  for (std::size_t i = 0; i < kSensitivityOutputs.size(); ++i) std::printf("---|");
  std::printf("\n");
  for (const Sensitivity& row : rows) {
    std::printf("| %-12s | %-7s | %-5s | %9s |", row.what.c_str(),
                std::string(storage_name(row.weights)).c_str(),
                std::string(storage_name(row.cache)).c_str(), cli::bytes_text(row.bytes).c_str());
    for (const double share : row.relative_l2) std::printf(" %9s |", percent(share).c_str());
    std::printf("\n");
  }
}

int run(Options& options) {
  parse_size(options.size, options.measure);
  options.measure.storages.clear();
  for (const std::string& name : options.storages)
    options.measure.storages.push_back(parse_storage(name, "--storage"));
  const cli::InterruptGuard interrupt;
  Context ctx(cli::choose_threads(options.threads).threads);
  cli::Progress progress(-1, "rows");
  options.measure.before_each = [&](std::size_t done, std::size_t) {
    if (interrupt.requested()) fail(ErrorKind::kInterrupted, "interrupted");
    progress.show(static_cast<std::int64_t>(done));
  };
  const std::vector<Sensitivity> rows = measure_sensitivity(options.load, options.measure, ctx);
  progress.clear();
  print_table(rows);
  if (std::fflush(stdout) != 0) fail(ErrorKind::kWrite, "standard output: cannot be written");
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  cli::Program program("weights_sensitivity", kDescription, LVGGT_VERSION);
  CLI::App& app = program.app();
  app.footer(kFooter);
  app.add_option("weights", options.load.weights, "Geometry weights, maybe with the decoder's")
      ->required();
  app.add_option("--decoder", options.load.decoder, "Decoder weights, if in a file of their own")
      ->type_name("FILE");
  app.add_option("--config", options.load.config,
                 "Configuration (JSON); else the weights' metadata or shapes tell it")
      ->type_name("FILE");
  app.add_option("--kind", options.measure.kinds,
                 "Only this kind of layers, like dino.fc2; may be given several times")
      ->type_name("KIND")
      ->allow_extra_args(false);
  app.add_option("--storage", options.storages, "Types to try; may be given several times")
      ->type_name("TYPE")
      ->allow_extra_args(false)
      ->default_str("bf16 int8");
  app.add_option("--size", options.size, "Size of the frames, multiples of the patch size")
      ->type_name("WxH")
      ->capture_default_str();
  program.add_number<std::int64_t>("--frames", options.measure.frames, "Number of frames", 1, 1000);
  program.add_number<std::uint64_t>("--seed", options.measure.seed, "Seed of the frames", 0,
                                    std::uint64_t{1} << 63);
  cli::add_threads_option(program, options.threads);
  return program.run(argc, argv, [&] { return run(options); });
}
