// SPDX-License-Identifier: Apache-2.0
// Questions about one frame of a lifted clip, at 294 x 518 pixels and three levels, with
// autoencoders of the published shapes and random weights:
//   bench_query [--benchmark_filter=answer]
#include <algorithm>
#include <filesystem>
#include <optional>
#include <string>

#include "bench/peak.h"
#include "lvggt/field/field_query.h"
#include "lvggt/field/semantic_codes.h"
#include "lvggt/model/deterministic_weights.h"

namespace {

using namespace lvggt;

constexpr std::int64_t kHeight = 294, kWidth = 518, kLevels = 3;

Autoencoder random_autoencoder(const AutoencoderShape& shape) {
  return Autoencoder(shape, [](const TensorSpec& spec, std::span<float> values) {
    deterministic_values(spec.name, spec.shape, 1, values);
  });
}

// Unit vectors by the same rule.
Tensor<float, 2> unit_rows(const std::string& name, std::int64_t n, std::int64_t width,
                           Context& ctx) {
  Tensor<float, 2> rows(Shape{n, width});
  deterministic_uniform(name, 1, -1, 1,
                        std::span(rows.data(), static_cast<std::size_t>(rows.size())));
  normalise_rows(rows, {}, rows.view(), ctx);
  return rows;
}

Tensor<float, 4> random_codes(const std::string& name, std::int64_t levels, std::int64_t dim,
                              Context& ctx) {
  const Tensor<float, 2> rows = unit_rows(name, levels * kHeight * kWidth, dim, ctx);
  Tensor<float, 4> codes(Shape{levels, kHeight, kWidth, dim});
  std::copy_n(rows.data(), rows.size(), codes.data());
  return codes;
}

// Answers `phrases` phrases and `states` states about a frame. MB is what the maps and the scratch
// of a query take beside the codes.
void answer(benchmark::State& state) {
  const std::int64_t phrases = state.range(0), states = state.range(1);
  Context ctx;
  const Autoencoder clip = random_autoencoder(AutoencoderShape::clip());
  const DecodedCosines decoder(clip, ctx);
  std::optional<Autoencoder> dynamic;
  std::optional<DecodedCosines> state_decoder;
  QuestionVectors vectors{unit_rows("bench.phrases", phrases + states, clip.feature_width(), ctx),
                          unit_rows("bench.canonical", 4, clip.feature_width(), ctx),
                          {}};
  const Tensor<float, 4> codes = random_codes("bench.codes", kLevels, clip.code_width(), ctx);
  Tensor<float, 4> state_codes;
  if (states > 0) {
    dynamic.emplace(random_autoencoder(AutoencoderShape::dynamic()));
    state_decoder.emplace(*dynamic, ctx);
    vectors.states = unit_rows("bench.states", states, dynamic->feature_width(), ctx);
    state_codes = random_codes("bench.state_codes", 1, dynamic->code_width(), ctx);
  }
  FieldQuery query(decoder, state_decoder ? &*state_decoder : nullptr, vectors, {}, ctx);
  const View<const float, 4> state_view =
      states > 0 ? View<const float, 4>(state_codes.view()) : View<const float, 4>();
  std::int64_t found = 0;
  for (auto _ : state)
    query.ask(
        codes, state_view, [&](const FrameAnswer& one) { found += one.mask(0, 0); }, ctx);
  benchmark::DoNotOptimize(found);
  state.counters["s/question"] = benchmark::Counter(
      static_cast<double>(phrases + states),
      benchmark::Counter::kIsIterationInvariantRate | benchmark::Counter::kInvert);
  state.counters["maps_MB"] =
      1e-6 * static_cast<double>(FieldQuery::map_bytes(phrases + states, kHeight, kWidth));
  state.counters["scratch_MB"] = 1e-6 * static_cast<double>(ctx.arena().peak_bytes());
}
BENCHMARK(answer)
    ->ArgNames({"phrases", "states"})
    ->Args({1, 0})
    ->Args({4, 0})
    ->Args({16, 0})
    ->Args({64, 0})
    ->Args({1000, 0})
    ->Args({0, 1})
    ->Unit(benchmark::kMillisecond)
    ->MeasureProcessCPUTime()
    ->UseRealTime();

// The share of a state's answer that grows with its mask: the mean cosine inside a mask of so many
// percent of the frame.
void state_inside(benchmark::State& state) {
  Context ctx;
  const Autoencoder dynamic = random_autoencoder(AutoencoderShape::dynamic());
  const DecodedCosines decoder(dynamic, ctx);
  const StateQuery query(decoder, unit_rows("bench.states", 1, dynamic.feature_width(), ctx), ctx);
  const Tensor<float, 4> codes = random_codes("bench.state_codes", 1, dynamic.code_width(), ctx);
  Tensor<std::uint8_t, 3> mask(Shape{std::int64_t{1}, kHeight, kWidth});
  std::fill_n(mask.data(), mask.size() * state.range(0) / 100, std::uint8_t{1});
  float similarity = 0;
  for (auto _ : state) query.similarity({&similarity, 1}, codes.view()[0], mask.view(), ctx);
  benchmark::DoNotOptimize(similarity);
}
BENCHMARK(state_inside)
    ->ArgName("percent")
    ->Arg(5)
    ->Arg(20)
    ->Arg(100)
    ->Unit(benchmark::kMillisecond)
    ->UseRealTime();

// The codes of a frame from disk (from the file system's memory, as it is read again and again).
void read_frame(benchmark::State& state) {
  Context ctx;
  const Tensor<float, 4> codes = random_codes("bench.codes", kLevels, 3, ctx);
  const CodesFormat format{{"small", "middle", "large"}, kHeight, kWidth, 3, "bench"};
  const std::string path =
      (std::filesystem::temp_directory_path() / "lvggt_bench_codes.safetensors").string();
  write_codes(path, codes, format, 0);
  Tensor<float, 4> read(format.shape());
  for (auto _ : state) read_codes(read, path, format, 0);
  state.SetBytesProcessed(static_cast<std::int64_t>(state.iterations()) * 2 * codes.size());
  std::filesystem::remove(path);
}
BENCHMARK(read_frame)->Unit(benchmark::kMillisecond)->UseRealTime();

}  // namespace
