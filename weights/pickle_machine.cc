// SPDX-License-Identifier: Apache-2.0
#include "weights/pickle_machine.h"

#include <optional>
#include <utility>

namespace lvggt {
namespace {

// A published checkpoint makes about 20 values a tensor, some 40,000 in all; this bounds the memory
// that a hostile pickle can claim.
constexpr std::size_t kMaxValues = 2'000'000;

// Dimensions of a tensor; safetensors files have the same limit.
constexpr std::size_t kMaxRank = 8;

// Bytes of a storage's key, a small number in practice; one key may be named by many storages.
constexpr std::size_t kMaxKeyBytes = 128;

std::optional<Dtype> storage_dtype(std::string_view name) {
  static constexpr std::pair<std::string_view, Dtype> kTypes[] = {
      {"FloatStorage", Dtype::kF32},     {"HalfStorage", Dtype::kF16},
      {"BFloat16Storage", Dtype::kBF16}, {"DoubleStorage", Dtype::kF64},
      {"CharStorage", Dtype::kI8},       {"ByteStorage", Dtype::kU8},
      {"ShortStorage", Dtype::kI16},     {"IntStorage", Dtype::kI32},
      {"LongStorage", Dtype::kI64},      {"BoolStorage", Dtype::kBool}};
  for (const auto& [type, dtype] : kTypes)
    if (type == name) return dtype;
  return std::nullopt;
}

// A name from the file, fit for a message.
std::string shown(std::string_view module, std::string_view name) {
  constexpr std::size_t kMaxShown = 100;
  std::string text =
      std::string(module.substr(0, kMaxShown)) + "." + std::string(name.substr(0, kMaxShown));
  for (char& c : text)
    if (static_cast<unsigned char>(c) < 0x20 || c == 0x7f) c = '?';
  return text;
}

}  // namespace

PickleId PickleMachine::push(PickleValue value) {
  if (pickle_.values.size() >= kMaxValues)
    fail(ErrorKind::kLimit, source_, ": more than ", kMaxValues, " values");
  const auto id = static_cast<PickleId>(pickle_.values.size());
  pickle_.values.push_back(value);
  stack_.push_back(id);
  return id;
}

void PickleMachine::push_plain(PickleKind kind, std::int64_t integer) { push({kind, 0, integer}); }

void PickleMachine::push_string(std::string_view text) {
  push({PickleKind::kString, static_cast<std::uint32_t>(pickle_.strings.size()), 0});
  pickle_.strings.emplace_back(text);
}

void PickleMachine::push_sequence(PickleKind kind, std::vector<PickleId> items) {
  push({kind, static_cast<std::uint32_t>(pickle_.sequences.size()), 0});
  pickle_.sequences.push_back(std::move(items));
}

void PickleMachine::push_global(std::string_view module, std::string_view name) {
  const auto function = [&](Function f) { push({PickleKind::kFunction, f, 0}); };
  if (module == "torch") {
    if (const auto dtype = storage_dtype(name)) {
      push({PickleKind::kStorageType, 0, static_cast<std::int64_t>(*dtype)});
      return;
    }
  }
  if (module == "collections" && name == "OrderedDict") return function(kOrderedDict);
  if (module == "torch._utils" && name == "_rebuild_tensor_v2") return function(kRebuildTensor);
  if (module == "torch._utils" && name == "_rebuild_parameter") return function(kRebuildParameter);
  unsupported("the function " + shown(module, name));
}

PickleId PickleMachine::top() const {
  if (stack_.size() <= floor()) bad("an instruction needs a value, but the stack is empty");
  return stack_.back();
}

std::vector<PickleId> PickleMachine::pop(std::size_t count) {
  if (stack_.size() - floor() < count)
    bad("an instruction needs ", count, " values, but the stack has fewer");
  const auto begin = stack_.end() - static_cast<std::ptrdiff_t>(count);
  std::vector<PickleId> items(begin, stack_.end());
  stack_.erase(begin, stack_.end());
  return items;
}

std::vector<PickleId> PickleMachine::pop_to_mark() {
  if (marks_.empty()) bad("an instruction needs a mark, but there is none");
  std::vector<PickleId> items = pop(stack_.size() - marks_.back());
  marks_.pop_back();
  return items;
}

void PickleMachine::pop() {
  if (!marks_.empty() && marks_.back() == stack_.size()) {
    marks_.pop_back();
  } else {
    pop(1);
  }
}

void PickleMachine::get(std::uint32_t index) {
  const auto it = memo_.find(index);
  if (it == memo_.end()) bad("the memo has no value ", index);
  if (stack_.size() >= kMaxValues)
    fail(ErrorKind::kLimit, source_, ": more than ", kMaxValues, " values");
  stack_.push_back(it->second);
}

void PickleMachine::put(std::uint32_t index) {
  const PickleId id = top();
  if (memo_.size() >= kMaxValues)
    fail(ErrorKind::kLimit, source_, ": more than ", kMaxValues, " memo values");
  memo_[index] = id;
}

void PickleMachine::append(const std::vector<PickleId>& items) {
  const PickleValue& list = value(top());
  if (list.kind != PickleKind::kList) bad("items are appended to something that is not a list");
  auto& sequence = pickle_.sequences[list.payload];
  sequence.insert(sequence.end(), items.begin(), items.end());
}

void PickleMachine::set_items(const std::vector<PickleId>& items) {
  const PickleValue& dict = value(top());
  if (dict.kind != PickleKind::kDict) bad("items are set in something that is not a dictionary");
  if (items.size() % 2 != 0) bad("a key has no value");
  auto& sequence = pickle_.sequences[dict.payload];
  sequence.insert(sequence.end(), items.begin(), items.end());
}

const std::string& PickleMachine::string_at(PickleId id, std::string_view what) const {
  if (value(id).kind != PickleKind::kString) bad(what, " is not a string");
  return pickle_.strings[value(id).payload];
}

std::int64_t PickleMachine::integer_at(PickleId id, std::string_view what) const {
  if (value(id).kind != PickleKind::kInteger) bad(what, " is not a whole number");
  return value(id).integer;
}

const std::vector<PickleId>& PickleMachine::tuple_at(PickleId id, std::string_view what) const {
  if (value(id).kind != PickleKind::kTuple) bad(what, " is not a tuple");
  return pickle_.sequences[value(id).payload];
}

std::vector<std::int64_t> PickleMachine::integers_at(PickleId id, std::string_view what) const {
  const auto& items = tuple_at(id, what);
  if (items.size() > kMaxRank)
    fail(ErrorKind::kLimit, source_, ", byte ", position_, ": a tensor has more than ", kMaxRank,
         " dimensions");
  std::vector<std::int64_t> integers;
  for (const PickleId item : items) integers.push_back(integer_at(item, what));
  return integers;
}

void PickleMachine::stack_global() {
  const std::vector<PickleId> names = pop(2);
  const std::string module = string_at(names[0], "the module of a function");
  const std::string name = string_at(names[1], "the name of a function");
  push_global(module, name);
}

void PickleMachine::reduce() {
  const std::vector<PickleId> call = pop(2);
  const PickleValue function = value(call[0]);
  if (function.kind != PickleKind::kFunction) bad("a call of something that is not a function");
  const std::vector<PickleId>& arguments = tuple_at(call[1], "the arguments of a call");
  switch (function.payload) {
    case kOrderedDict:
      if (!arguments.empty()) bad("OrderedDict is called with arguments");
      push_sequence(PickleKind::kDict, {});
      return;
    case kRebuildParameter:
      if (arguments.size() != 3 || value(arguments[0]).kind != PickleKind::kTensor)
        bad("_rebuild_parameter is not called with a tensor and two more arguments");
      stack_.push_back(arguments[0]);
      return;
    default:
      rebuild_tensor(arguments);
  }
}

// (storage, offset, shape, strides, requires_grad, backward_hooks[, metadata])
void PickleMachine::rebuild_tensor(const std::vector<PickleId>& arguments) {
  constexpr std::size_t kFewest = 4, kMost = 7;
  if (arguments.size() < kFewest || arguments.size() > kMost)
    bad("_rebuild_tensor_v2 is called with ", arguments.size(), " arguments");
  if (value(arguments[0]).kind != PickleKind::kStorage)
    bad("a tensor is built over something that is no storage");
  PickleTensor tensor;
  tensor.storage = value(arguments[0]).payload;
  tensor.offset = integer_at(arguments[1], "a tensor's offset");
  tensor.shape = integers_at(arguments[2], "a tensor's shape");
  tensor.strides = integers_at(arguments[3], "a tensor's strides");
  if (tensor.shape.size() != tensor.strides.size())
    bad("a tensor has ", tensor.shape.size(), " dimensions but ", tensor.strides.size(),
        " strides");
  push({PickleKind::kTensor, static_cast<std::uint32_t>(pickle_.tensors.size()), 0});
  pickle_.tensors.push_back(std::move(tensor));
}

// Attributes of an object. A state dict's only one is _metadata, version numbers that nobody here
// needs.
void PickleMachine::build() {
  const PickleId state = pop(1)[0];
  if (value(top()).kind != PickleKind::kDict || value(state).kind != PickleKind::kDict)
    unsupported("setting attributes of an object");
}

// ('storage', torch.FloatStorage, key, location, number of elements)
void PickleMachine::persistent_id() {
  const std::vector<PickleId>& id = tuple_at(pop(1)[0], "a persistent id");
  constexpr std::size_t kNumParts = 5;
  if (id.size() != kNumParts ||
      string_at(id[0], "the first part of a persistent id") != "storage" ||
      value(id[1]).kind != PickleKind::kStorageType)
    bad("a persistent id is not that of a storage");
  PickleStorage storage;
  storage.dtype = static_cast<Dtype>(value(id[1]).integer);
  storage.key = string_at(id[2], "the key of a storage");
  if (storage.key.size() > kMaxKeyBytes)
    bad("the key of a storage has ", storage.key.size(), " bytes");
  string_at(id[3], "the location of a storage");
  storage.size = integer_at(id[4], "the size of a storage");
  if (storage.size < 0) bad("a storage has the negative size ", storage.size);
  push({PickleKind::kStorage, static_cast<std::uint32_t>(pickle_.storages.size()), 0});
  pickle_.storages.push_back(std::move(storage));
}

Pickle PickleMachine::finish() && {
  if (stack_.size() != 1 || !marks_.empty())
    bad("the pickle ends with ", stack_.size(), " values, not one");
  pickle_.root = stack_.back();
  return std::move(pickle_);
}

}  // namespace lvggt
