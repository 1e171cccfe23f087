// SPDX-License-Identifier: Apache-2.0
// One optimisation step of the published decoder at 294 x 518 pixels, by phase.
#include <algorithm>
#include <cstdio>
#include <cstdlib>
#include <string>
#include <string_view>

#include "bench/peak.h"
#include "bench/shapes.h"
#include "bench/simd_option.h"
#include "lvggt/cli/memory.h"
#include "lvggt/train/decoder_trainer.h"

namespace {

using namespace lvggt;

constexpr const char* kHelp =
    "One optimisation step of the published decoder at 294 x 518 pixels, by phase.\n"
    "Usage: bench_train_step [--batch=1] [--steps=5] [--threads=0] [--recompute] [--simd=NAME]\n"
    "  --batch=N      frames a step\n"
    "  --steps=N      steps to time\n"
    "  --threads=N    threads; 0: all this process may use\n"
    "  --recompute    compute activations again in the backward pass, for less memory\n"
    "  --simd=NAME    limit the kernels to an instruction set: AVX2\n"
    "bench/peers/torch_decoder_step.py takes the same step in PyTorch.\n";

struct Arguments {
  std::int64_t batch = 1, steps = 5;
  int threads = 0;
  bool recompute = false;
};

bool read(std::string_view argument, std::string_view name, std::int64_t& value) {
  if (!argument.starts_with(name)) return false;
  value = std::atoll(std::string(argument.substr(name.size())).c_str());
  return true;
}

Arguments parse(int argc, char** argv) {
  Arguments a;
  for (int i = 1; i < argc; ++i) {
    std::int64_t threads = 0;
    if (read(argv[i], "--batch=", a.batch) || read(argv[i], "--steps=", a.steps)) continue;
    if (read(argv[i], "--threads=", threads)) {
      a.threads = static_cast<int>(threads);
    } else if (std::string_view(argv[i]) == "--recompute") {
      a.recompute = true;
    } else {
      fail(ErrorKind::kUsage, "unknown argument ", argv[i], "; see --help");
    }
  }
  return a;
}

// Work of a step, 2 a multiply-add: every product of the forward pass, and two as large backward.
double step_flops(const ModelConfig& c, std::int64_t B) {
  const double N = 294 * 518, n = 21 * 37, F = 128, h = 32,
               C2 = 2 * static_cast<double>(c.embed_dim);
  double dpt = C2 * n * (256 + 512 + 1024 + 1024);
  dpt += n * (256.0 * 256 * 16 + 512.0 * 512 * 4) + 11 * 19 * 9 * 1024.0 * 1024;
  dpt += 9 * F * (16 * n * 256 + 4 * n * 512 + n * 1024 + 11 * 19 * 1024.0);
  dpt += 9 * F * F * (4 * 16 * n + 4 * 4 * n + 4 * n + 2 * 11 * 19) + 64 * n * 9 * F * F;
  dpt += F * F * (16 * n + 4 * n + n + 11 * 19);
  double encoder = N * 9 * (F * h + h * h), decoder = N * 9 * h * 3;
  for (int i = 1; i < 4; ++i) {
    const double c1 = h * (1 << i), pixels = N / (1 << (2 * i));
    encoder += pixels * (9 * (c1 / 2 * c1 + c1 * c1) + 4 * c1 / 2 * c1 / 2);
  }
  for (int i = 0; i < 3; ++i) {
    const double c1 = h * (1 << i), pixels = N / (1 << (2 * i));
    decoder += pixels * (9 * 3 * c1 * c1 + 2 * c1 * c1);
  }
  return 3 * 2 * static_cast<double>(B) * (dpt + 2 * encoder + 4 * decoder);
}

void run(const Arguments& a) {
  const ModelConfig config;
  Context ctx(a.threads);
  const double peak = std::max(bench::peak_flops(ctx), bench::peak_flops(ctx));
  TrainOptions options;
  options.schedule.learning_rate = 4e-5;
  if (a.recompute) options.activations = CheckpointActivations::kRecompute;
  const std::int64_t h = 21, w = 37, H = 294, W = 518;
  const TrainingMemory plan = plan_training(config, options, a.batch, h, w, H, W);
  ParameterStore store(config);
  store.initialise(1, ctx);
  SingleProcess alone;
  DecoderTrainer trainer(store, options, alone, ctx);
  const auto tokens = bench::random_tensor(Shape{a.batch, h * w, 2 * config.embed_dim}, 1);
  const auto images = bench::random_tensor(Shape{a.batch, H, W, std::int64_t{3}}, 2);
  const auto features =
      bench::random_tensor(Shape{a.batch, config.sbd_levels, H, W, config.lang_dim}, 3);
  Tensor<float, 4> mask(Shape{a.batch, config.sbd_levels, H, W});
  std::fill_n(mask.data(), mask.size(), 1.0f);
  const DecoderBatch batch{h, w, {tokens, tokens, tokens, tokens}, images, features, mask};
  const double flops = step_flops(config, a.batch);
  std::printf("%d threads, peak %.0f GFLOP/s, %.0f GFLOP a step\n", ctx.num_threads(), peak * 1e-9,
              flops * 1e-9);
  for (std::int64_t i = 0; i < a.steps; ++i) {
    const StepReport r = trainer.step(batch);
    const double total = r.times.forward + r.times.backward + r.times.optimiser;
    std::printf(
        "step %lld: %.3f s = forward %.3f + backward %.3f + optimiser %.3f   "
        "%.0f GFLOP/s, %.0f %% of peak   loss %.6f\n",
        static_cast<long long>(i + 1), total, r.times.forward, r.times.backward, r.times.optimiser,
        flops / total * 1e-9, 100 * flops / total / peak, r.loss.total);
  }
  std::printf("arena: peak %.0f MiB, planned %.0f MiB\n",
              static_cast<double>(ctx.arena().peak_bytes()) / (1 << 20),
              static_cast<double>(plan.activations) / (1 << 20));
  std::printf("process: peak %.0f MiB, planned %.0f MiB\n",
              static_cast<double>(cli::peak_resident_bytes()) / (1 << 20),
              static_cast<double>(plan.total) / (1 << 20));
}

}  // namespace

int main(int argc, char** argv) {
  for (int i = 1; i < argc; ++i) {
    if (std::string_view(argv[i]) != "--help") continue;
    std::fputs(kHelp, stdout);
    return 0;
  }
  try {
    bench::apply_simd_option(&argc, argv);
    run(parse(argc, argv));
  } catch (const lvggt::Error& e) {
    std::fprintf(stderr, "bench_train_step: %s\n", e.what());
    return lvggt::exit_code(e.kind());
  }
}
