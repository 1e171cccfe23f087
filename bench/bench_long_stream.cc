// SPDX-License-Identifier: Apache-2.0
// A stream of thousands of frames: what must stay flat once the window is full, does it?
//   weights_init --config tests/golden/config_tiny.json --seed 1 tiny.safetensors
//   bench_long_stream --weights=tiny.safetensors [--frames=1000] [--window=16] [--size=84x56]
//                     [--cache=f32] [--threads=0]
// Prints resident memory, open handles and time per frame for each tenth of the frames after the
// window has filled. Exit status 1 when memory grows by 1 MiB per 1,000 frames or more or when
// handles grow; times are for the reader to judge.
#include <algorithm>
#include <cstdio>
#include <exception>
#include <filesystem>
#include <iterator>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/cli/memory.h"
#include "lvggt/lvggt.h"
#include "lvggt/model/deterministic_weights.h"
#include "lvggt/model/stream.h"

namespace {

using namespace lvggt;

// The value of "--name=value", or `otherwise`.
std::string option(int argc, char** argv, std::string_view name, std::string otherwise) {
  const std::string prefix = "--" + std::string(name) + "=";
  for (int i = 1; i < argc; ++i) {
    const std::string_view argument = argv[i];
    if (argument.starts_with(prefix)) return std::string(argument.substr(prefix.size()));
  }
  return otherwise;
}

std::ptrdiff_t open_handles() {
  return std::distance(std::filesystem::directory_iterator("/proc/self/fd"), {});
}

struct Sample {
  double memory = 0;  // resident, MiB
  std::ptrdiff_t handles = 0;
  std::vector<double> seconds;  // of its frames
};

double quantile(std::vector<double> values, double q) {
  std::sort(values.begin(), values.end());
  return values[static_cast<std::size_t>(q * static_cast<double>(values.size() - 1))];
}

int run(int argc, char** argv) {
  const std::string weights = option(argc, argv, "weights", "");
  if (weights.empty()) fail(ErrorKind::kUsage, "--weights=FILE is missing");
  const std::int64_t num_frames = std::stoll(option(argc, argv, "frames", "1000"));
  const std::int64_t window = std::stoll(option(argc, argv, "window", "16"));
  const std::string size = option(argc, argv, "size", "84x56");
  const std::int64_t W = std::stoll(size), H = std::stoll(size.substr(size.find('x') + 1));
  Context ctx(std::stoi(option(argc, argv, "threads", "0")));
  const LangVggt model = LangVggt::load({.weights = weights, .points = false}, ctx);
  StreamOptions options;
  options.max_past_frames = window;
  options.allow_degenerate_camera = true;
  options.cache_storage = parse_storage(option(argc, argv, "cache", "f32"), "--cache");
  const Tensor<float, 4> images = deterministic_images(1, 8, H, W);

  Stream stream(model, ctx, options);
  constexpr std::int64_t kTenths = 10;
  std::vector<Sample> tenths(kTenths);
  const std::int64_t each = std::max<std::int64_t>(num_frames / kTenths, 1);
  for (std::int64_t f = 0; f < window + 1 + kTenths * each; ++f) {
    const Frame frame = stream.push(images[f % images.extent(0)]);
    if (f <= window) continue;  // filling
    const std::int64_t after = f - window - 1;
    Sample& tenth = tenths[static_cast<std::size_t>(after / each)];
    tenth.seconds.push_back(frame.times.total);
    if (after % each == each - 1) {
      tenth.memory = static_cast<double>(cli::resident_bytes()) / 0x1p20;
      tenth.handles = open_handles();
    }
  }
  std::printf("%8s %14s %8s %12s %12s\n", "frames", "resident MiB", "handles", "median ms",
              "p99 ms");
  for (std::int64_t i = 0; i < kTenths; ++i) {
    const Sample& tenth = tenths[static_cast<std::size_t>(i)];
    std::printf("%8lld %14.2f %8lld %12.3f %12.3f\n", static_cast<long long>((i + 1) * each),
                tenth.memory, static_cast<long long>(tenth.handles),
                1e3 * quantile(tenth.seconds, 0.5), 1e3 * quantile(tenth.seconds, 0.99));
  }
  const Sample &first = tenths.front(), &last = tenths.back();
  const double growth =
      (last.memory - first.memory) * 1000 / static_cast<double>((kTenths - 1) * each);
  std::printf("growth %.3f MiB per 1,000 frames; p99 of the last tenth %+.1f %% of the first's\n",
              growth, 100 * (quantile(last.seconds, 0.99) / quantile(first.seconds, 0.99) - 1));
  return growth < 1 && last.handles <= first.handles ? 0 : 1;
}

}  // namespace

int main(int argc, char** argv) {
  try {
    return run(argc, argv);
  } catch (const lvggt::Error& e) {
    std::fprintf(stderr, "bench_long_stream: %s\n", e.what());
    return lvggt::exit_code(e.kind());
  } catch (const std::exception& e) {
    std::fprintf(stderr, "bench_long_stream: %s\n", e.what());
    return 1;
  }
}
