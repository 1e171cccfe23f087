// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <string>
#include <type_traits>

#include "lvggt/train/parameter_store.h"

namespace lvggt {

// An input of a function template: T follows from the other arguments, so that a View<T, R> fits.
template <class T, int R>
using ConstView = std::type_identity_t<View<const T, R>>;

// Parameters of the elementary layers as views into the store: with T = const float the weights,
// with T = float their gradients, both under the same names.

template <class T>
struct LinearParameters {
  View<T, 2> weight;  // [N, K]
  View<T, 1> bias;    // [N]
};

template <class T>
struct Conv2dParameters {
  View<T, 4> weight;  // [Cout, Cin, k, k]
  View<T, 1> bias;    // [Cout]; empty for a layer without, or a gradient that is known to be 0
  std::int64_t stride = 1;
  std::int64_t padding = 1;
};

template <class T>
struct ConvTranspose2dParameters {
  View<T, 4> weight;  // [Cin, Cout, k, k], stride k
  View<T, 1> bias;    // [Cout]
};

template <class T>
struct NormParameters {
  View<T, 1> gamma, beta;  // [C]
};

// The running statistics belong to the weights: they are empty with the gradients.
template <class T>
struct BatchNormParameters {
  View<T, 1> gamma, beta;                                     // [C]
  View<std::remove_const_t<T>, 1> running_mean, running_var;  // [C], moved by forward passes
};

// Views into one block of a store, by the layers' published names without a final dot. Store has
// config(), view() and block() as ParameterStore.
template <class T, class Store = ParameterStore>
class ParameterBinder {
 public:
  using Scalar = std::remove_const_t<T>;
  static constexpr bool kGradients = !std::is_const_v<T>;

  // running: the running statistics that forward passes move, in the layout of the store's buffers;
  // not used for gradients. batch_statistics: batch norms take the batch's statistics, so that a
  // bias right before one cancels out and has no gradient.
  ParameterBinder(Store& store, Scalar* running, bool batch_statistics)
      : store_(store), running_(running), batch_statistics_(batch_statistics) {}

  const ModelConfig& config() const { return store_.config(); }

  template <int R>
  View<T, R> view(const std::string& name) const {
    return store_.template view<R>(kGradients ? StoreRole::kGradients : StoreRole::kWeights, name);
  }

  NormParameters<T> norm(const std::string& prefix) const {
    return {view<1>(prefix + ".weight"), view<1>(prefix + ".bias")};
  }

  // A 1x1 convolution, as a linear layer over pixels.
  LinearParameters<T> pixel_linear(const std::string& prefix) const {
    const View<T, 4> weight = view<4>(prefix + ".weight");
    return {weight.reshaped(Shape{weight.extent(0), weight.extent(1)}), view<1>(prefix + ".bias")};
  }

  Conv2dParameters<T> conv2d(const std::string& prefix, std::int64_t stride,
                             std::int64_t padding) const {
    return {view<4>(prefix + ".weight"), view<1>(prefix + ".bias"), stride, padding};
  }

  Conv2dParameters<T> conv2d_without_bias(const std::string& prefix, std::int64_t stride,
                                          std::int64_t padding) const {
    return {view<4>(prefix + ".weight"), {}, stride, padding};
  }

  // 3x3, with a batch norm right behind it.
  Conv2dParameters<T> normed_conv2d(const std::string& prefix) const {
    return kGradients && batch_statistics_ ? conv2d_without_bias(prefix, 1, 1)
                                           : conv2d(prefix, 1, 1);
  }

  ConvTranspose2dParameters<T> conv_transpose2d(const std::string& prefix) const {
    return {view<4>(prefix + ".weight"), view<1>(prefix + ".bias")};
  }

  BatchNormParameters<T> batch_norm(const std::string& prefix) const {
    return {view<1>(prefix + ".weight"), view<1>(prefix + ".bias"),
            running(prefix + ".running_mean"), running(prefix + ".running_var")};
  }

 private:
  View<Scalar, 1> running(const std::string& name) const {
    if (kGradients) return {};
    const View<Scalar, 1> stored = store_.template view<1>(StoreRole::kBuffers, name);
    return {running_ + (stored.data() - store_.block(StoreRole::kBuffers).data()), stored.shape()};
  }

  Store& store_;
  Scalar* running_;
  bool batch_statistics_;
};

}  // namespace lvggt
