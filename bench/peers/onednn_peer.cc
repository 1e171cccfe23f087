// SPDX-License-Identifier: Apache-2.0
// One operation through oneDNN with weights packed beforehand; prints the median milliseconds.
//   onednn_peer linear M N K        f32, as a 1x1 convolution: oneDNN's fastest product
//   onednn_peer linear_int8 M N K   u8 x s8 to s32
//   onednn_peer conv K CIN COUT H W f32, padded, in oneDNN's own layout
#include <algorithm>
#include <chrono>
#include <cstdlib>
#include <cstring>
#include <functional>
#include <iostream>
#include <oneapi/dnnl/dnnl.hpp>
#include <random>
#include <string>
#include <unordered_map>
#include <vector>

namespace {

using dnnl::memory;
using Type = memory::data_type;
using Tag = memory::format_tag;

// Runs of at least half a second after one to warm up.
double median_ms(const std::function<void()>& run) {
  using Clock = std::chrono::steady_clock;
  run();
  std::vector<double> times;
  const auto begin = Clock::now();
  while (times.size() < 5 || Clock::now() - begin < std::chrono::milliseconds(500)) {
    const auto start = Clock::now();
    run();
    times.push_back(std::chrono::duration<double, std::milli>(Clock::now() - start).count());
  }
  std::sort(times.begin(), times.end());
  return times[times.size() / 2];
}

memory filled(const memory::desc& desc, const dnnl::engine& engine) {
  memory m(desc, engine);
  auto* bytes = static_cast<unsigned char*>(m.get_data_handle());
  std::minstd_rand random(1);
  if (desc.data_type() == Type::f32) {
    auto* values = reinterpret_cast<float*>(bytes);
    for (std::size_t i = 0; i < desc.get_size() / 4; ++i)
      values[i] = static_cast<float>(random() % 2001) / 1000 - 1;
  } else {
    for (std::size_t i = 0; i < desc.get_size(); ++i)
      bytes[i] = static_cast<unsigned char>(random() % 64);
  }
  return m;
}

// `from` in the layout of `desc`.
memory reordered(const memory& from, const memory::desc& desc, const dnnl::engine& engine,
                 dnnl::stream& stream) {
  memory to(desc, engine);
  dnnl::reorder(from, to).execute(stream, const_cast<memory&>(from), to);
  stream.wait();
  return to;
}

double convolution(const memory::dims& x, const memory::dims& w, const memory::dims& y,
                   std::int64_t padding, Tag layout) {
  const dnnl::engine engine(dnnl::engine::kind::cpu, 0);
  dnnl::stream stream(engine);
  const dnnl::convolution_forward::primitive_desc plan(
      dnnl::convolution_forward::desc(
          dnnl::prop_kind::forward_inference, dnnl::algorithm::convolution_direct,
          memory::desc(x, Type::f32, layout), memory::desc(w, Type::f32, Tag::any),
          memory::desc(y, Type::f32, layout), {1, 1}, {padding, padding}, {padding, padding}),
      engine);
  const memory source = reordered(filled(memory::desc(x, Type::f32, Tag::nchw), engine),
                                  plan.src_desc(), engine, stream);
  const memory weights = reordered(filled(memory::desc(w, Type::f32, Tag::oihw), engine),
                                   plan.weights_desc(), engine, stream);
  const memory result(plan.dst_desc(), engine);
  const dnnl::convolution_forward run(plan);
  return median_ms([&] {
    run.execute(stream,
                {{DNNL_ARG_SRC, source}, {DNNL_ARG_WEIGHTS, weights}, {DNNL_ARG_DST, result}});
    stream.wait();
  });
}

double linear_int8(std::int64_t M, std::int64_t N, std::int64_t K) {
  const dnnl::engine engine(dnnl::engine::kind::cpu, 0);
  dnnl::stream stream(engine);
  const memory::desc x({M, K}, Type::u8, Tag::ab), y({M, N}, Type::s32, Tag::ab);
  const dnnl::matmul::primitive_desc plan(
      dnnl::matmul::desc(x, memory::desc({K, N}, Type::s8, Tag::any), y), engine);
  const memory source = filled(x, engine);
  const memory weights = reordered(filled(memory::desc({K, N}, Type::s8, Tag::ba), engine),
                                   plan.weights_desc(), engine, stream);
  const memory result(y, engine);
  const dnnl::matmul run(plan);
  return median_ms([&] {
    run.execute(stream,
                {{DNNL_ARG_SRC, source}, {DNNL_ARG_WEIGHTS, weights}, {DNNL_ARG_DST, result}});
    stream.wait();
  });
}

}  // namespace

int main(int argc, char** argv) {
  std::vector<std::int64_t> n;
  for (int i = 2; i < argc; ++i) n.push_back(std::atoll(argv[i]));
  const std::string what = argc > 1 ? argv[1] : "";
  if (what == "linear" && n.size() == 3) {
    std::cout << convolution({1, n[2], n[0], 1}, {n[1], n[2], 1, 1}, {1, n[1], n[0], 1}, 0,
                             Tag::nhwc)
              << '\n';
  } else if (what == "linear_int8" && n.size() == 3) {
    std::cout << linear_int8(n[0], n[1], n[2]) << '\n';
  } else if (what == "conv" && n.size() == 5) {
    std::cout << convolution({1, n[1], n[3], n[4]}, {n[2], n[1], n[0], n[0]}, {1, n[2], n[3], n[4]},
                             n[0] / 2, Tag::any)
              << '\n';
  } else {
    std::cerr << "onednn_peer: linear M N K | linear_int8 M N K | conv K CIN COUT H W\n";
    return 2;
  }
}
