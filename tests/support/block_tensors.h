// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <map>
#include <string>
#include <utility>
#include <vector>

#include "lvggt/train/block.h"

namespace lvggt::test {

// A block's parameters, or their gradients, by name.
class BlockTensors {
 public:
  template <int R>
  void add(const std::string& name, const Tensor<float, R>& values) {
    Entry entry{{values.shape().extents.begin(), values.shape().extents.end()},
                Tensor<float, 1>(Shape{values.size()})};
    std::copy_n(values.data(), values.size(), entry.values.data());
    entries_.insert_or_assign(name, std::move(entry));
  }

  std::vector<std::string> names() const {
    std::vector<std::string> names;
    for (const auto& [name, entry] : entries_) names.push_back(name);
    return names;
  }
  // Flat.
  template <class T>
  Tensor<T, 1> get(const std::string& name) const {
    const Tensor<float, 1>& values = entries_.at(name).values;
    Tensor<T, 1> copy(values.shape());
    std::copy_n(values.data(), values.size(), copy.data());
    return copy;
  }

  // Zeros of the same names and shapes.
  BlockTensors zeros() const {
    BlockTensors zeros;
    for (const auto& [name, entry] : entries_)
      zeros.entries_.emplace(name, Entry{entry.shape, Tensor<float, 1>(entry.values.shape())});
    return zeros;
  }
  void clear() {
    for (auto& [name, entry] : entries_)
      std::fill_n(entry.values.data(), entry.values.size(), 0.0f);
  }

  BlockParameters<const float> weights() { return bound<const float>(); }
  BlockParameters<float> gradients() { return bound<float>(); }

 private:
  struct Entry {
    std::vector<std::int64_t> shape;
    Tensor<float, 1> values;
  };

  template <class T>
  BlockParameters<T> bound() {
    BlockParameters<T> block;
    for_each_param(block, [&]<int R>(const std::string& name, View<T, R>& view) {
      const auto found = entries_.find(name);
      if (found == entries_.end()) return;
      Shape<R> shape;
      LVGGT_CHECK(found->second.shape.size() == R, name, " does not have ", R, " axes");
      std::copy_n(found->second.shape.begin(), R, shape.extents.begin());
      view = View<T, R>(found->second.values.data(), shape);
    });
    return block;
  }

  std::map<std::string, Entry> entries_;
};

}  // namespace lvggt::test
