// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstdint>
#include <string>
#include <string_view>
#include <vector>

#include "lvggt/io/dtype.h"

namespace lvggt {

// A pickle as PyTorch writes it, read without executing anything. Pickle is a program for a small
// stack machine; this machine knows only the instructions that build plain values and containers,
// and of the functions that a pickle may name only these, which it interprets itself:
//   collections.OrderedDict              an empty dictionary
//   torch.FloatStorage and its like      the element type of a storage
//   torch._utils._rebuild_tensor_v2      a tensor over a storage
//   torch._utils._rebuild_parameter      the tensor it is given
// Everything else ends the reading: kUnsupported with the name of the instruction or function.

// Index of a value in Pickle::values.
using PickleId = std::uint32_t;

enum class PickleKind : std::uint8_t {
  kNone,
  kBool,
  kInteger,
  kReal,
  kString,
  kTuple,
  kList,
  kDict,
  kStorageType,
  kStorage,
  kTensor,
  kFunction
};

struct PickleValue {
  PickleKind kind = PickleKind::kNone;
  std::uint32_t payload = 0;  // index into the table of its kind
  std::int64_t integer = 0;   // of kBool and kInteger; Dtype of kStorageType
};

// Elements of one of the archive's entries.
struct PickleStorage {
  Dtype dtype = Dtype::kF32;
  std::string key;        // the entry is data/<key>
  std::int64_t size = 0;  // elements
};

// A strided view of a storage, in elements. Not yet checked against the storage.
struct PickleTensor {
  std::uint32_t storage = 0;  // index into Pickle::storages
  std::int64_t offset = 0;
  std::vector<std::int64_t> shape;
  std::vector<std::int64_t> strides;
};

struct Pickle {
  std::vector<PickleValue> values;
  std::vector<std::string> strings;  // of kString
  std::vector<std::vector<PickleId>>
      sequences;  // of kTuple, kList; of kDict key, value, key, value, ...
  std::vector<PickleStorage> storages;
  std::vector<PickleTensor> tensors;
  PickleId root = 0;
};

// Runs the pickle. `source` opens every message. Errors: kFormat for a broken pickle, kUnsupported
// for one that asks for more than tensors and plain containers, kLimit for one of absurd size.
Pickle read_pickle(std::string_view bytes, const std::string& source);

}  // namespace lvggt
