// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <optional>

#include "lvggt/train/block.h"
#include "tests/reference/activation.h"
#include "tests/reference/layer_norm.h"
#include "tests/reference/linear.h"
#include "tests/reference/masked_attention.h"
#include "tests/reference/rope.h"
#include "tests/support/block_tensors.h"
#include "tests/support/compare.h"
#include "tests/support/golden.h"
#include "tests/support/gradient.h"
#include "tests/support/random.h"
#include "tests/support/targets.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

constexpr std::int64_t kC = 16, kHidden = 24, kHeads = 2, kTokens = 6, kFrameTokens = 3;
constexpr float kEps = 1e-5f;

struct Case {
  const char* name;
  bool qk_norm, rope;
  FrameMask mask;
};
const Case kCases[] = {{"DINOv2", false, false, {}},
                       {"frame block", true, true, {kFrameTokens, false}},
                       {"global block", true, true, {kFrameTokens, true}},
                       {"norms only", true, false, {}},
                       {"rope only", false, true, {kFrameTokens, true}}};

Tensor<std::int64_t, 2> positions() {
  Tensor<std::int64_t, 2> p(Shape{kFrameTokens, std::int64_t{2}});
  p(1, 0) = p(1, 1) = p(2, 0) = 1;
  p(2, 1) = 2;
  return p;
}

// The parameters of a small block.
BlockTensors random_block(bool qk_norm) {
  BlockTensors tensors;
  std::uint32_t seed = 10;
  const auto add = [&](const std::string& name, auto shape) {
    const bool near_one = name.find("norm") != std::string::npos && name.ends_with("weight");
    tensors.add(name,
                random_tensor(shape, ++seed, near_one ? 0.5f : -0.5f, near_one ? 1.5f : 0.5f));
  };
  const auto both = [&](const std::string& name, auto weight, std::int64_t n) {
    add(name + ".weight", weight);
    add(name + ".bias", Shape{n});
  };
  both("norm1", Shape{kC}, kC);
  both("attn.qkv", Shape{3 * kC, kC}, 3 * kC);
  if (qk_norm) both("attn.q_norm", Shape{kC / kHeads}, kC / kHeads);
  if (qk_norm) both("attn.k_norm", Shape{kC / kHeads}, kC / kHeads);
  both("attn.proj", Shape{kC, kC}, kC);
  add("ls1.gamma", Shape{kC});
  both("norm2", Shape{kC}, kC);
  both("mlp.fc1", Shape{kHidden, kC}, kHidden);
  both("mlp.fc2", Shape{kC, kHidden}, kC);
  add("ls2.gamma", Shape{kC});
  return tensors;
}

// The block written out in double. `weights(name)` gives a parameter as one flat vector.
template <class Weights>
struct Definition {
  const Weights& weights;
  const Case& c;

  Tensor<double, 2> linear(const Tensor<double, 2>& x, const std::string& name) const {
    const Tensor<double, 1> flat = weights(name + ".weight"), bias = weights(name + ".bias");
    Tensor<double, 2> w(Shape{bias.size(), x.extent(1)});
    std::copy_n(flat.data(), flat.size(), w.data());
    Tensor<double, 2> y = reference::linear(x, w);
    for (std::int64_t i = 0; i < y.size(); ++i) y.data()[i] += bias[i % bias.size()];
    return y;
  }
  Tensor<double, 2> norm(const Tensor<double, 2>& x, const std::string& name) const {
    const Tensor<double, 1> gamma = weights(name + ".weight"), beta = weights(name + ".bias");
    Tensor<double, 2> y = reference::layer_norm(x, static_cast<double>(kEps));
    for (std::int64_t i = 0; i < y.size(); ++i)
      y.data()[i] = y.data()[i] * gamma[i % gamma.size()] + beta[i % beta.size()];
    return y;
  }
  // q, k or v, [N, heads, D], as attention takes it.
  Tensor<double, 3> part(const Tensor<double, 2>& qkv, std::int64_t i, const char* name) const {
    Tensor<double, 2> rows(Shape{qkv.extent(0) * kHeads, kC / kHeads});
    for (std::int64_t n = 0; n < qkv.extent(0); ++n)
      std::copy_n(qkv[n].data() + i * kC, kC, rows.data() + n * kC);
    if (i < 2 && c.qk_norm) rows = norm(rows, name);
    Tensor<double, 3> heads(Shape{qkv.extent(0), kHeads, kC / kHeads});
    std::copy_n(rows.data(), rows.size(), heads.data());
    return i < 2 && c.rope ? reference::rope_2d(heads, positions(), 100.0) : std::move(heads);
  }
  void add_scaled(Tensor<double, 2>& x, const Tensor<double, 2>& branch, const char* name) const {
    const Tensor<double, 1> gamma = weights(name);
    for (std::int64_t i = 0; i < x.size(); ++i)
      x.data()[i] += gamma[i % gamma.size()] * branch.data()[i];
  }
  Tensor<double, 2> operator()(const Tensor<double, 2>& x) const {
    Tensor<double, 2> y = x.clone(), attended(x.shape());
    const auto qkv = linear(norm(y, "norm1"), "attn.qkv");
    const auto a =
        reference::masked_attention(part(qkv, 0, "attn.q_norm"), part(qkv, 1, "attn.k_norm"),
                                    part(qkv, 2, ""), c.mask.frame_tokens, c.mask.earlier_frames);
    std::copy_n(a.data(), a.size(), attended.data());
    add_scaled(y, linear(attended, "attn.proj"), "ls1.gamma");
    Tensor<double, 2> hidden = linear(norm(y, "norm2"), "mlp.fc1");
    for (std::int64_t i = 0; i < hidden.size(); ++i)
      hidden.data()[i] = reference::activation(hidden.data()[i], Activation::kGelu);
    add_scaled(y, linear(hidden, "mlp.fc2"), "ls2.gamma");
    return y;
  }
};

// The block of a case with its input, run forward and backward by the engine.
struct Trained {
  const Case& c;
  BlockTensors tensors = random_block(c.qk_norm), zeros = tensors.zeros();
  BlockParameters<const float> weights = tensors.weights();
  BlockParameters<float> gradient = zeros.gradients();
  RopeTable table = make_rope_table(positions(), kC / kHeads, 100);
  BlockSettings settings{kHeads, kEps, c.mask, c.rope ? &table : nullptr};
  Tensor<float, 2> x = random_tensor(Shape{kTokens, kC}, 1), dy = random_tensor(x.shape(), 2);
  Tensor<float, 2> y{x.shape()}, dx{x.shape()};

  explicit Trained(const Case& which) : c(which) {}
  void run(Context& ctx) {
    Arena::Scope scope(ctx.arena());
    BlockActivations kept;
    block_forward(y, kept, x, weights, settings, ctx);
    block_backward(dx, gradient, dy, kept, weights, settings, ctx);
  }
  // The loss with one parameter, or none, replaced.
  double loss(const Tensor<double, 2>& input, const std::string& name,
              const Tensor<double, 1>& values) const {
    const auto of = [&](const std::string& parameter) {
      return parameter == name ? values.clone() : tensors.get<double>(parameter);
    };
    return weighted_sum(dy, Definition<decltype(of)>{of, c}(input));
  }
};

}  // namespace

TEST_CASE("block_backward: dx and every parameter agree with central differences") {
  Context ctx(2);
  for (const Case& c : kCases) {
    CAPTURE(c.name);
    Trained trained(c);
    for_each_target([&] {
      trained.zeros.clear();
      trained.run(ctx);
    });
    const auto plain = [&](const auto& v) { return trained.loss(v, "", {}); };
    const auto dx = central_differences(trained.x, plain);
    CHECK_CLOSE(trained.dx, dx, 2e-6 * largest_magnitude(trained.dx) + 1e-8);
    const Tensor<double, 2> input = in_double(trained.x);
    for (const std::string& name : trained.tensors.names()) {
      CAPTURE(name);
      const Tensor<float, 1> gradient = trained.zeros.get<float>(name);
      const auto expected =
          central_differences(trained.tensors.get<float>(name),
                              [&](const auto& v) { return trained.loss(input, name, v); });
      CHECK_CLOSE(gradient, expected, 2e-6 * largest_magnitude(gradient) + 5e-7);
    }
  }
}

TEST_CASE("block_backward: parameters' gradients accumulate, frozen ones are left out") {
  Context ctx(1);
  Trained all(kCases[2]), twice(kCases[2]), some(kCases[2]), frozen(kCases[2]);
  all.run(ctx);
  twice.run(ctx);
  twice.run(ctx);
  some.gradient.attn = {};
  some.gradient.norm2.beta = {};
  some.run(ctx);
  frozen.gradient = {};
  frozen.run(ctx);
  CHECK_SAME_BITS(twice.dx, all.dx);
  CHECK_SAME_BITS(some.dx, all.dx);
  CHECK_SAME_BITS(frozen.dx, all.dx);
  for (const std::string& name : all.tensors.names()) {
    CAPTURE(name);
    const Tensor<float, 1> once = all.zeros.get<float>(name);
    const bool left_out = name.starts_with("attn.") || name == "norm2.bias";
    const Tensor<float, 1> expected = left_out ? Tensor<float, 1>(once.shape()) : once.clone();
    CHECK_SAME_BITS(some.zeros.get<float>(name), expected);
    const Tensor<float, 1> sum = twice.zeros.get<float>(name);
    for (std::int64_t i = 0; i < once.size(); ++i) CHECK(sum[i] == doctest::Approx(2 * once[i]));
    CHECK(largest_magnitude(frozen.zeros.get<float>(name)) == 0);
  }
}

TEST_CASE("block_backward: 1 and 8 threads give the same bits; heads that do not divide C fail") {
  Context one(1), eight(8);
  Trained a(kCases[2]), b(kCases[2]);
  a.run(one);
  b.run(eight);
  CHECK_SAME_BITS(b.y, a.y);
  CHECK_SAME_BITS(b.dx, a.dx);
  for (const std::string& name : a.tensors.names())
    CHECK_SAME_BITS(b.zeros.get<float>(name), a.zeros.get<float>(name));
  a.settings.num_heads = 3;
  CHECK_THROWS_WITH_AS(a.run(one), doctest::Contains("3 heads"), Error);
}
