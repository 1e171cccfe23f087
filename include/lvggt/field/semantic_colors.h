// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <Eigen/Core>
#include <Eigen/Eigenvalues>
#include <array>
#include <cstdint>
#include <vector>

#include "lvggt/core/tensor.h"
#include "lvggt/field/color_map.h"

namespace lvggt {

// Shows semantic vectors of d values as colours. Three values are shown as they are, one range for
// all of them; more are projected onto their three principal components, each with its own range;
// with fewer, the missing channels stay at the middle. Basis and ranges come from one frame and
// then hold for the whole video, so that equal vectors keep their colour.
class SemanticColors {
 public:
  bool fitted() const { return basis_.size() > 0; }

  // Takes basis and ranges from a frame of features. The sign of a component, which PCA leaves
  // open, is such that its largest entry is positive. Constant features give a grey picture.
  //   features: [H, W, d]
  void fit(View<const float, 3> features) {
    const auto [H, W, d] = features.shape();
    LVGGT_CHECK(H > 0 && W > 0 && d > 0, "semantic colours: features are ", features.shape());
    mean_ = Eigen::VectorXd::Zero(d);
    for_each(features, [&](const Eigen::Ref<const Eigen::VectorXd>& f) { mean_ += f; });
    mean_ /= static_cast<double>(H * W);
    if (d <= kChannels) {
      basis_ = Eigen::MatrixXd::Identity(kChannels, d);
      mean_.setZero();
    } else {
      fit_basis(features);
    }
    fit_ranges(features);
  }

  //   pixels: [H, W, 3]   features: [H, W, d]
  void apply(View<std::uint8_t, 3> pixels, View<const float, 3> features) const {
    const auto [H, W, d] = features.shape();
    LVGGT_CHECK(fitted() && d == basis_.cols(), "semantic colours: fitted to ", basis_.cols(),
                " values, but features are ", features.shape());
    LVGGT_CHECK((pixels.shape() == Shape{H, W, std::int64_t{kChannels}}),
                "semantic colours: pixels are ", pixels.shape(), " but features are ",
                features.shape());
    std::uint8_t* pixel = nullptr;
    std::int64_t i = 0;
    const std::int64_t width = W;
    for_each(features, [&](const Eigen::Ref<const Eigen::VectorXd>& f) {
      const Eigen::Vector3d y = basis_ * (f - mean_);
      pixel = pixels[i / width][i % width].data();
      for (int c = 0; c < kChannels; ++c)
        pixel[c] = to_byte(ranges_[static_cast<std::size_t>(c)].position(y[c]));
      ++i;
    });
  }

  // The principal directions, row by row: [3, d].
  const Eigen::MatrixXd& basis() const { return basis_; }

 private:
  static constexpr int kChannels = 3;
  static constexpr double kPercentile = 1;  // of the values, at either end, that may saturate

  template <class F>
  static void for_each(View<const float, 3> features, F&& body) {
    const auto [H, W, d] = features.shape();
    Eigen::VectorXd f(d);
    for (std::int64_t y = 0; y < H; ++y) {
      for (std::int64_t x = 0; x < W; ++x) {
        f = Eigen::Map<const Eigen::VectorXf>(features[y][x].data(), d).template cast<double>();
        body(f);
      }
    }
  }

  void fit_basis(View<const float, 3> features) {
    const std::int64_t d = features.extent(2);
    Eigen::MatrixXd covariance = Eigen::MatrixXd::Zero(d, d);
    for_each(features, [&](const Eigen::Ref<const Eigen::VectorXd>& f) {
      covariance.selfadjointView<Eigen::Lower>().rankUpdate(f - mean_);
    });
    const Eigen::SelfAdjointEigenSolver<Eigen::MatrixXd> solver(covariance);
    if (solver.info() != Eigen::Success)
      fail(ErrorKind::kNumeric, "semantic colours: the features have no principal components");
    basis_.resize(kChannels, d);
    for (int c = 0; c < kChannels; ++c) {
      const Eigen::VectorXd direction = solver.eigenvectors().col(d - 1 - c);
      Eigen::Index largest = 0;
      direction.cwiseAbs().maxCoeff(&largest);
      basis_.row(c) = (direction[largest] < 0 ? -1 : 1) * direction.transpose();
    }
  }

  void fit_ranges(View<const float, 3> features) {
    const std::int64_t d = features.extent(2);
    const auto channels = static_cast<std::size_t>(std::min<std::int64_t>(d, kChannels));
    std::array<std::vector<float>, kChannels> values;
    for_each(features, [&](const Eigen::Ref<const Eigen::VectorXd>& f) {
      const Eigen::Vector3d y = basis_ * (f - mean_);
      // Principal components have ranges of their own, plain channels share one.
      for (std::size_t c = 0; c < channels; ++c)
        values[d > kChannels ? c : 0].push_back(static_cast<float>(y[static_cast<int>(c)]));
    });
    ranges_.fill({0, 0});
    for (std::size_t c = 0; c < channels; ++c) {
      if (d <= kChannels && c > 0) {
        ranges_[c] = ranges_[0];
        continue;
      }
      const float low = percentile_in_place(values[c], kPercentile);
      ranges_[c] = {low, percentile_in_place(values[c], 100 - kPercentile)};
    }
  }

  Eigen::VectorXd mean_;   // [d]
  Eigen::MatrixXd basis_;  // [3, d]
  std::array<ValueRange, kChannels> ranges_;
};

}  // namespace lvggt
