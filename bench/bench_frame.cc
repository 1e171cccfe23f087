// SPDX-License-Identifier: Apache-2.0
// Streamed frames by stage, at 294 x 518 pixels:
//   weights_init --seed 3 published.safetensors
//   bench_frame --weights=published.safetensors [--frames=4] [--threads=0] [--simd=AVX2]
//               [--weights-storage=f32|bf16|f16|int8] [--cache-storage=f32|bf16|int8]
#include <iostream>
#include <string>
#include <string_view>

#include "bench/peak.h"
#include "bench/simd_option.h"
#include "lvggt/lvggt.h"
#include "lvggt/model/frame_flops.h"

namespace {

using namespace lvggt;
using namespace lvggt::bench;

inline constexpr std::int64_t kHeight = 294, kWidth = 518;

// Pushes one more frame and reports its stages in seconds, and the whole against the machine's
// peak.
void push_frame(benchmark::State& state, Stream& stream, const ModelConfig& config,
                View<const float, 4> frames, Context& ctx) {
  const double before = peak_flops(ctx);
  for (auto _ : state) {
    const Frame frame = stream.push(frames[state.range(0)]);
    const StageTimes& t = frame.times;
    state.SetIterationTime(t.total);
    state.counters["dino"] = t.dino;
    state.counters["frame_blocks"] = t.frame_blocks;
    state.counters["global_blocks"] = t.global_blocks;
    state.counters["camera"] = t.camera;
    state.counters["depth"] = t.depth;
    state.counters["decoder"] = t.decoder;
    const double reached =
        frame_flops(config, kHeight, kWidth, frame.frames_attended).total() / t.total;
    state.counters["FLOP/s"] = benchmark::Counter(reached, benchmark::Counter::kDefaults,
                                                  benchmark::Counter::OneK::kIs1000);
    state.counters["%peak"] = 100 * reached / std::max(before, peak_flops(ctx));
  }
}

// The value of "--name=value", or `otherwise`.
std::string option(int argc, char** argv, std::string_view name, std::string otherwise) {
  const std::string prefix = "--" + std::string(name) + "=";
  for (int i = 1; i < argc; ++i) {
    const std::string_view argument = argv[i];
    if (argument.starts_with(prefix)) return std::string(argument.substr(prefix.size()));
  }
  return otherwise;
}

void run(int argc, char** argv) {
  const std::string weights = option(argc, argv, "weights", "");
  if (weights.empty())
    fail(ErrorKind::kUsage,
         "--weights=FILE is missing; weights_init --seed 3 FILE makes such a file");
  Context ctx(std::stoi(option(argc, argv, "threads", "0")));
  const std::int64_t num_frames = std::stoll(option(argc, argv, "frames", "4"));
  LoadOptions load{.weights = weights};
  load.storage = StoragePolicy::of(
      parse_storage(option(argc, argv, "weights-storage", "f32"), "--weights-storage"));
  const LangVggt model = LangVggt::load(load, ctx);
  const Tensor<float, 4> frames = deterministic_images(3, num_frames, kHeight, kWidth);
  StreamOptions options;
  options.cache_storage =
      parse_storage(option(argc, argv, "cache-storage", "f32"), "--cache-storage");
  Stream stream(model, ctx, options);
  const auto push = [&](benchmark::State& state) {
    push_frame(state, stream, model.config(), frames, ctx);
  };
  auto* bench = benchmark::RegisterBenchmark("Stream::push", push);
  bench->ArgName("frame")->UseManualTime()->Unit(benchmark::kSecond)->Iterations(1);
  for (std::int64_t i = 0; i < num_frames; ++i) bench->Arg(i);
  benchmark::Initialize(&argc, argv);
  benchmark::RunSpecifiedBenchmarks();
}

}  // namespace

int main(int argc, char** argv) {
  try {
    lvggt::bench::apply_simd_option(&argc, argv);
    run(argc, argv);
  } catch (const lvggt::Error& e) {
    std::cerr << "bench_frame: " << e.what() << '\n';
    return lvggt::exit_code(e.kind());
  } catch (const std::exception& e) {
    std::cerr << "bench_frame: " << e.what() << '\n';
    return 1;
  }
}
