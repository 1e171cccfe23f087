// SPDX-License-Identifier: Apache-2.0
// Says what a weights file is: model, sizes, types, configuration.
#include <cstdio>
#include <string>

#include "lvggt/cli/program.h"
#include "lvggt/io/hash.h"
#include "weights/describe.h"

namespace {

constexpr const char* kDescription =
    "Says what a weights file is: which model, how many layers and parameters, in which types, for "
    "which\n"
    "configuration, and whether anything is missing. FILE is safetensors (a file, an index or a "
    "folder) or a\n"
    "PyTorch checkpoint, of which nothing is executed.";

constexpr const char* kFooter =
    "Examples:\n"
    "  weights_info model.safetensors\n"
    "  weights_info --check --sha256 checkpoints.pth\n"
    "  weights_info --json model.safetensors | jq .parameters\n\n"
    "Exit status: 0 done, 1 failed at run time, 2 wrong usage, 3 bad input file, 4 memory or a "
    "limit.";

struct Options {
  std::string file;
  bool check = false;
  bool sha256 = false;
  bool json = false;
};

// The sum of the only file; a model in several has none.
std::string sum_of(const lvggt::WeightsDescription& description) {
  if (description.files.size() != 1)
    lvggt::fail(lvggt::ErrorKind::kUsage, "--sha256 needs a single file, but the model is in ",
                description.files.size());
  return lvggt::sha256_file(description.files.front());
}

int run(const Options& options) {
  lvggt::WeightsDescription description = lvggt::describe_weights(options.file);
  if (options.check) lvggt::check_values(options.file, description);
  const std::string sum = options.sha256 ? sum_of(description) : std::string();
  const std::string text = options.json ? lvggt::description_json(description, sum)
                                        : lvggt::description_text(description, sum);
  if (std::fwrite(text.data(), 1, text.size(), stdout) != text.size() || std::fflush(stdout) != 0)
    lvggt::fail(lvggt::ErrorKind::kWrite, "cannot write to standard output");
  return 0;
}

}  // namespace

int main(int argc, char** argv) {
  Options options;
  lvggt::cli::Program program("weights_info", kDescription, LVGGT_VERSION);
  CLI::App& app = program.app();
  app.footer(kFooter);
  app.add_option("file", options.file, "The weights")->required();
  app.add_flag("--check", options.check,
               "Read every value and report tensors with NaN, only zeros and the like");
  app.add_flag("--sha256", options.sha256, "Print the file's SHA-256 sum");
  app.add_flag("--json", options.json, "Print one JSON object instead");
  return program.run(argc, argv, [&] { return run(options); });
}
