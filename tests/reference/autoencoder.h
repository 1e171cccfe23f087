// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cmath>
#include <complex>
#include <functional>
#include <string>
#include <vector>

#include "lvggt/language/autoencoder.h"

namespace lvggt::reference {

template <class T>
using Rows = std::vector<std::vector<T>>;
// The values of a tensor by its name.
template <class T>
using Weights = std::function<const std::vector<T>&(const std::string&)>;

template <class T>
Rows<T> linear_rows(const Rows<T>& x, const std::string& name, const Weights<T>& weights) {
  const std::vector<T>&w = weights(name + ".weight"), &b = weights(name + ".bias");
  Rows<T> y(x.size(), b);
  for (std::size_t n = 0; n < x.size(); ++n)
    for (std::size_t o = 0; o < b.size(); ++o)
      for (std::size_t i = 0; i < x[n].size(); ++i) y[n][o] += w[o * x[n].size() + i] * x[n][i];
  return y;
}

template <class T>
void relu_rows(Rows<T>& x) {
  for (auto& row : x)
    for (T& v : row)
      if (!(std::real(v) > 0)) v = T(0);
}

template <class T>
void unit_rows(Rows<T>& x) {
  for (auto& row : x) {
    T sum = 0;
    for (const T& v : row) sum += v * v;
    if (std::real(sum) > 0)
      for (T& v : row) v /= std::sqrt(sum);
  }
}

// With the statistics of the batch, or running ones.
template <class T>
void norm_rows(Rows<T>& x, const std::string& name, bool batch, const Weights<T>& weights) {
  const auto n = static_cast<double>(x.size());
  for (std::size_t c = 0; c < x[0].size(); ++c) {
    T mean = 0, var = 0;
    for (const auto& row : x) mean += row[c] / n;
    for (const auto& row : x) var += (row[c] - mean) * (row[c] - mean) / n;
    if (!batch) mean = weights(name + ".running_mean")[c], var = weights(name + ".running_var")[c];
    for (auto& row : x)
      row[c] = weights(name + ".weight")[c] * (row[c] - mean) / std::sqrt(var + T(1e-5)) +
               weights(name + ".bias")[c];
  }
}

template <class T>
Rows<T> encode(Rows<T> x, const AutoencoderShape& shape, bool batch, const Weights<T>& weights) {
  for (std::size_t i = 0; i < shape.encoder.size(); ++i) {
    if (i > 0) norm_rows(x, concat("encoder.", 3 * i - 2), batch, weights), relu_rows(x);
    x = linear_rows(x, concat("encoder.", 3 * i), weights);
  }
  unit_rows(x);
  return x;
}

template <class T>
Rows<T> decode(Rows<T> x, const AutoencoderShape& shape, const Weights<T>& weights) {
  for (std::size_t i = 0; i < shape.decoder.size(); ++i) {
    if (i > 0) relu_rows(x);
    x = linear_rows(x, concat("decoder.", 2 * i), weights);
  }
  unit_rows(x);
  return x;
}

// Mean squared error + c (1 - mean cosine) of rows and what they come back as.
template <class T>
T reconstruction_loss(const Rows<T>& y, const Rows<T>& x, double c) {
  T squares = 0, cosines = 0;
  for (std::size_t n = 0; n < x.size(); ++n) {
    T xy = 0, xx = 0, yy = 0;
    for (std::size_t i = 0; i < x[n].size(); ++i) {
      squares += (y[n][i] - x[n][i]) * (y[n][i] - x[n][i]);
      xy += x[n][i] * y[n][i], xx += x[n][i] * x[n][i], yy += y[n][i] * y[n][i];
    }
    cosines += xy / std::sqrt(xx * yy);
  }
  const auto rows = static_cast<double>(x.size());
  return squares / (rows * static_cast<double>(x[0].size())) + c * (1.0 - cosines / rows);
}

}  // namespace lvggt::reference
