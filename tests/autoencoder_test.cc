// SPDX-License-Identifier: Apache-2.0
#include "lvggt/language/autoencoder.h"

#include <doctest/doctest.h>

#include <map>

#include "lvggt/language/autoencoder_trainer.h"
#include "lvggt/language/decoded_cosines.h"
#include "tests/reference/autoencoder.h"
#include "tests/support/compare.h"
#include "tests/support/gradient.h"
#include "tests/support/temp_dir.h"

using namespace lvggt;
using namespace lvggt::test;

namespace {

const AutoencoderShape kSmall{20, {16, 8, 3}, {8, 16, 20}, 3};

// Random weights of a shape, reproducible, in several forms.
class SmallWeights {
 public:
  explicit SmallWeights(const AutoencoderShape& shape, std::uint32_t seed = 1) : shape_(shape) {
    for (const TensorSpec& spec : autoencoder_tensors(shape)) {
      const bool matrix = spec.shape.size() == 2;
      const bool variance = spec.name.ends_with("running_var");
      const float scale =
          matrix ? std::sqrt(3.0F / static_cast<float>(spec.shape[1])) : (variance ? 0.5F : 0.3F);
      Tensor<float, 1> values = random_tensor(Shape{spec.volume()}, seed++, -scale, scale);
      const bool gamma = !matrix && spec.name.ends_with(".weight");
      for (std::int64_t i = 0; i < values.size(); ++i)
        if (gamma || variance) values[i] += 1;
      values_[spec.name] = std::move(values);
    }
  }
  void fill(const TensorSpec& spec, std::span<float> out) const {
    const Tensor<float, 1>& values = values_.at(spec.name);
    std::copy_n(values.data(), values.size(), out.begin());
  }
  Autoencoder autoencoder() const {
    return Autoencoder(shape_,
                       [&](const TensorSpec& spec, std::span<float> out) { fill(spec, out); });
  }
  template <class T>
  reference::Weights<T> weights() const {
    auto all = std::make_shared<std::map<std::string, std::vector<T>>>();
    for (const auto& [name, values] : values_)
      for (std::int64_t i = 0; i < values.size(); ++i)
        (*all)[name].push_back(T(static_cast<double>(values[i])));
    return [all](const std::string& name) -> const std::vector<T>& { return all->at(name); };
  }
  void write(const std::string& path, const std::string& without = "none",
             const std::string& prefix = "") const {
    SafetensorsWriter out(path);
    for (const TensorSpec& spec : autoencoder_tensors(shape_)) {
      if (spec.name.starts_with(without)) continue;
      const Tensor<float, 1>& values = values_.at(spec.name);
      out.add(prefix + spec.name, spec.shape,
              std::span(values.data(), static_cast<std::size_t>(values.size())));
    }
    out.finish();
  }
  std::map<std::string, Tensor<float, 1>>& values() { return values_; }

 private:
  AutoencoderShape shape_;
  std::map<std::string, Tensor<float, 1>> values_;
};

Tensor<float, 2> unit_features(std::int64_t N, std::int64_t D, std::uint32_t seed) {
  Tensor<float, 2> x = random_tensor(Shape{N, D}, seed);
  Context ctx(1);
  normalise_rows(x, {}, x, ctx);
  return x;
}

template <class T>
reference::Rows<T> rows_of(const Tensor<float, 2>& x) {
  reference::Rows<T> rows;
  for (std::int64_t n = 0; n < x.extent(0); ++n) {
    rows.emplace_back();
    for (std::int64_t c = 0; c < x.extent(1); ++c)
      rows.back().push_back(T(static_cast<double>(x(n, c))));
  }
  return rows;
}

Tensor<double, 2> tensor_of(const reference::Rows<double>& rows) {
  Tensor<double, 2> x(Shape{std::ssize(rows), std::ssize(rows[0])});
  for (std::int64_t i = 0; i < x.size(); ++i)
    x.data()[i] =
        rows[static_cast<std::size_t>(i / x.extent(1))][static_cast<std::size_t>(i % x.extent(1))];
  return x;
}

}  // namespace

TEST_CASE("autoencoder: the published shapes have their published tensors") {
  CHECK(to_text(AutoencoderShape::clip()) ==
        "512 -> 256, 128, 64, 32, 3 -> 16, 32, 64, 128, 256, 512");
  const auto tensors = autoencoder_tensors(AutoencoderShape::clip());
  const auto shape_of = [&](const std::string& name) {
    for (const TensorSpec& spec : tensors)
      if (spec.name == name) return shape_text(spec.shape);
    return std::string("missing");
  };
  CHECK(shape_of("encoder.0.weight") == "[256,512]");
  CHECK(shape_of("encoder.10.running_var") == "[32]");
  CHECK(shape_of("encoder.12.weight") == "[3,32]");
  CHECK(shape_of("encoder.13.weight") == "missing");
  CHECK(shape_of("decoder.10.weight") == "[512,256]");
  CHECK(autoencoder_tensors(AutoencoderShape::dynamic()).back().shape[0] == 4096);
}

TEST_CASE("autoencoder: codes and features are those of the definition") {
  const SmallWeights weights(kSmall);
  const Autoencoder autoencoder = weights.autoencoder();
  const Tensor<float, 2> x = unit_features(37, 20, 5);
  for (const int threads : {1, 8}) {
    Context ctx(threads);
    Tensor<float, 2> codes(Shape{37, 3}), features(Shape{37, 20});
    autoencoder.encode(codes, x, ctx);
    autoencoder.decode(features, codes, ctx);
    const auto expected =
        reference::encode(rows_of<double>(x), kSmall, false, weights.weights<double>());
    CHECK_CLOSE(codes, tensor_of(expected), 1e-5);
    CHECK_CLOSE(features, tensor_of(reference::decode(expected, kSmall, weights.weights<double>())),
                1e-5);
  }
}

TEST_CASE("autoencoder: widths come from the file, and a decoder alone is enough to decode") {
  const TempDir dir;
  const SmallWeights weights(kSmall);
  weights.write(dir / "whole.safetensors");
  CHECK(Autoencoder::load(dir / "whole.safetensors").shape() == kSmall);
  weights.write(dir / "decoder.safetensors", "encoder");
  const Autoencoder decoder = Autoencoder::load(dir / "decoder.safetensors");
  CHECK(!decoder.has_encoder());
  Context ctx(1);
  const Tensor<float, 2> codes = unit_features(5, 3, 2);
  Tensor<float, 2> a(Shape{5, 20}), b(Shape{5, 20});
  decoder.decode(a, codes, ctx);
  weights.autoencoder().decode(b, codes, ctx);
  CHECK_SAME_BITS(a, b);
  Tensor<float, 2> out(Shape{5, 3});
  CHECK_THROWS_WITH_AS(decoder.encode(out, a, ctx),
                       "autoencoder: only its decoder was loaded, it cannot encode", Error);
}

TEST_CASE("autoencoder: a file that is none, or whose layers do not fit, is refused by name") {
  const TempDir dir;
  SafetensorsWriter other(dir / "other.safetensors");
  other.add("x", Tensor<float, 1>(Shape{3}));
  other.finish();
  CHECK_THROWS_WITH_AS(
      Autoencoder::load(dir / "other.safetensors"),
      doctest::Contains("holds no autoencoder; there is no tensor decoder.0.weight"), Error);
  const SmallWeights weights(kSmall);
  weights.write(dir / "norm.safetensors", "encoder.1.running_mean");
  CHECK_THROWS_WITH_AS(Autoencoder::load(dir / "norm.safetensors"),
                       doctest::Contains("encoder.1.running_mean is missing"), Error);
  SmallWeights broken(kSmall);
  broken.values().at("decoder.2.bias")[3] = std::numeric_limits<float>::quiet_NaN();
  broken.write(dir / "nan.safetensors");
  CHECK_THROWS_WITH_AS(Autoencoder::load(dir / "nan.safetensors"),
                       doctest::Contains("decoder.2.bias is nan at element 3"), Error);
}

TEST_CASE("autoencoder: gradients agree with the complex step") {
  SmallWeights weights(kSmall);
  Context ctx(2);
  ParameterStore store(autoencoder_tensors(kSmall));
  for (const StoreRole role : {StoreRole::kWeights, StoreRole::kBuffers})
    store.for_each(role, [&](const ParameterEntry& entry, std::span<float> values) {
      weights.fill({entry.name, entry.shape}, values);
    });
  const double c = 0.3;
  AutoencoderTrainer trainer(store, kSmall, {.cosine_weight = c}, ctx);
  const Tensor<float, 2> x = unit_features(11, 20, 9);
  const AutoencoderLoss loss = trainer.gradients({}, {}, x);

  std::map<std::string, std::vector<Complex>> all;
  for (const auto& [name, values] : weights.values())
    for (std::int64_t i = 0; i < values.size(); ++i) all[name].emplace_back(values[i], 0);
  const reference::Weights<Complex> lookup =
      [&](const std::string& name) -> const std::vector<Complex>& { return all.at(name); };
  const reference::Rows<Complex> rows = rows_of<Complex>(x);
  const auto total = [&] {
    return reference::reconstruction_loss(
        reference::decode(reference::encode(rows, kSmall, true, lookup), kSmall, lookup), rows, c);
  };
  CHECK(loss.total(c) == doctest::Approx(total().real()).epsilon(1e-6));
  double squared_error = 0, squared_norm = 0;
  store.for_each(StoreRole::kGradients, [&](const ParameterEntry& entry, std::span<float> values) {
    for (std::size_t i = 0; i < values.size(); i += 3) {
      Complex& weight = all.at(entry.name)[i];
      weight += Complex(0, 1e-50);
      const double expected = total().imag() / 1e-50;
      weight = weight.real();
      squared_error += std::pow(values[i] - expected, 2);
      squared_norm += expected * expected;
    }
  });
  CHECK(std::sqrt(squared_error / squared_norm) < 5e-5);
}

TEST_CASE("autoencoder: the loss gradient of a row without length is that of the squares alone") {
  Context ctx(1);
  Tensor<float, 2> y(Shape{2, 3}), x = unit_features(2, 3, 4), dy(Shape{2, 3});
  y(0, 0) = 1;
  const AutoencoderLoss loss = autoencoder_loss_backward(dy, y, x, 10, ctx);
  CHECK(loss.cos == doctest::Approx(1 - x(0, 0) / 2.0));
  for (std::int64_t c = 0; c < 3; ++c) CHECK(dy(1, c) == doctest::Approx(-x(1, c) / 3));
}

TEST_CASE("autoencoder: training brings rows back, the same bits for any number of threads") {
  const Tensor<float, 2> x = unit_features(64, 20, 3);
  std::vector<float> first;
  for (const int threads : {1, 8}) {
    Context ctx(threads);
    ParameterStore store(autoencoder_tensors(kSmall));
    store.initialise(1, ctx);
    AutoencoderTrainer trainer(store, kSmall, {.learning_rate = 5e-3}, ctx);
    const double before = trainer.step(x).total(1);
    for (int i = 0; i < 150; ++i) trainer.step(x);
    CHECK(evaluate_autoencoder(trainer.autoencoder(), x, ctx).total(1) < 0.75 * before);
    const std::span<const float> block = store.block(StoreRole::kWeights);
    if (first.empty()) first.assign(block.begin(), block.end());
    CHECK(std::equal(first.begin(), first.end(), block.begin()));
  }
}

TEST_CASE("decoded_cosines: are the cosines of the decoded features") {
  Context ctx(3);
  // More features than hidden units, fewer, and a decoder of one layer.
  for (const AutoencoderShape& shape :
       {AutoencoderShape{200, {}, {16, 150, 200}, 3}, AutoencoderShape{24, {}, {16, 40, 24}, 6},
        AutoencoderShape{12, {}, {12}, 4}}) {
    const Autoencoder autoencoder = SmallWeights(shape).autoencoder();
    const Tensor<float, 2> codes = random_tensor(Shape{std::int64_t{300}, shape.code}, 8);
    const Tensor<float, 2> vectors = unit_features(5, shape.features, 7);
    Tensor<float, 2> features(Shape{std::int64_t{300}, shape.features});
    autoencoder.decode(features, codes, ctx);
    Tensor<double, 2> expected(Shape{std::int64_t{300}, std::int64_t{5}});
    for (std::int64_t i = 0; i < 300; ++i)
      for (std::int64_t j = 0; j < 5; ++j)
        for (std::int64_t c = 0; c < shape.features; ++c)
          expected(i, j) += static_cast<double>(features(i, c)) * vectors(j, c);
    const DecodedCosines decoder(autoencoder, ctx);
    Tensor<float, 2> cosines(Shape{300, 5});
    decoder.cosines(cosines, codes, decoder.prepare(vectors, ctx), ctx);
    CHECK_CLOSE(cosines, expected, 2e-6);
  }
}

TEST_CASE("decoded_cosines: a code that decodes to nothing has the cosine 0") {
  Context ctx(1);
  SmallWeights weights({200, {}, {16, 100, 200}, 3});
  for (auto& [name, values] : weights.values())
    if (name.ends_with(".bias")) std::fill_n(values.data(), values.size(), 0.0F);
  const Autoencoder autoencoder = weights.autoencoder();
  const DecodedCosines decoder(autoencoder, ctx);
  Tensor<float, 2> codes(Shape{2, 3}), cosines(Shape{2, 1});
  codes(1, 0) = 1;
  decoder.cosines(cosines, codes, decoder.prepare(unit_features(1, 200, 3), ctx), ctx);
  CHECK(cosines(0, 0) == 0);
  CHECK(std::abs(cosines(1, 0)) <= 1);
}

TEST_CASE("decoded_cosines: embeddings of another width are refused with both widths") {
  Context ctx(1);
  const Autoencoder autoencoder = SmallWeights(kSmall).autoencoder();
  const DecodedCosines decoder(autoencoder, ctx);
  CHECK_THROWS_WITH_AS(decoder.prepare(unit_features(1, 512, 1), ctx),
                       "cosines: the embeddings are 512 wide but the autoencoder decodes to 20",
                       Error);
}
