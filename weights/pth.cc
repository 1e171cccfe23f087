// SPDX-License-Identifier: Apache-2.0
#include "weights/pth.h"

#include <algorithm>
#include <array>
#include <cstring>
#include <set>

#include "kernels/io/printable.h"
#include "kernels/io/safetensors_header.h"
#include "lvggt/core/error.h"
#include "lvggt/io/checked.h"
#include "lvggt/io/safetensors.h"

namespace lvggt {
namespace {

constexpr std::string_view kPickleName = "data.pkl";
constexpr std::string_view kModulePrefix = "module.";

// The published checkpoints' pickles have less than 1 MB.
constexpr std::int64_t kMaxPickleBytes = std::int64_t{64} << 20;

// Dictionaries around the state dict: {"state_dict": {"model": {...}}} is the deepest that is seen.
constexpr int kMaxNesting = 4;

// Tied weights share a storage, so tensors may need more bytes than the file has, but not many
// times more.
constexpr std::int64_t kMaxSharing = 8;

// Names left out are listed up to this many.
constexpr std::size_t kMaxListed = 5;

bool strides_are_dense(const PthTensor& tensor) {
  std::int64_t stride = 1;
  for (std::size_t axis = tensor.shape.size(); axis-- > 0;) {
    if (tensor.shape[axis] == 1) continue;
    if (tensor.view.strides[axis] != stride) return false;
    stride = size_product(stride, tensor.shape[axis]);
  }
  return true;
}

// Copies a strided view, row-major; the innermost axis in runs when it is contiguous.
void gather(const PthTensor& tensor, std::span<const std::byte> storage, std::span<std::byte> out) {
  const auto item = static_cast<std::size_t>(dtype_size(tensor.dtype));
  const std::size_t rank = tensor.shape.size();
  std::vector<std::int64_t> index(rank, 0);
  std::int64_t at = tensor.view.offset;  // every reachable value was checked to lie in the storage
  for (std::size_t done = 0; done < out.size(); done += item) {
    std::memcpy(out.data() + done, storage.data() + size_product(at, dtype_size(tensor.dtype)),
                item);
    for (std::size_t axis = rank; axis-- > 0;) {
      at += tensor.view.strides[axis];
      if (++index[axis] < tensor.shape[axis]) break;
      at -= size_product(tensor.view.strides[axis], tensor.shape[axis]);
      index[axis] = 0;
    }
  }
}

// Index of the last element of the view in its storage, or empty when it does not fit 63 bits.
std::optional<std::int64_t> last_element(const PickleTensor& view) {
  std::optional<std::int64_t> last = view.offset;
  for (std::size_t axis = 0; axis < view.shape.size() && last; ++axis) {
    const auto step = checked_mul(view.shape[axis] - 1, view.strides[axis]);
    last = step ? checked_add(*last, *step) : std::nullopt;
  }
  return last;
}

}  // namespace

PthFile::PthFile(const std::string& path) : zip_(path) {
  find_archive_root();
  const std::int64_t entry = zip_.find(root_ + std::string(kPickleName));
  const std::int64_t num_bytes = zip_.entries()[static_cast<std::size_t>(entry)].num_bytes;
  if (num_bytes > kMaxPickleBytes)
    fail(ErrorKind::kLimit, path, ": its ", kPickleName, " has ", num_bytes,
         " bytes, more than the limit of ", kMaxPickleBytes);
  std::string bytes(static_cast<std::size_t>(num_bytes), '\0');
  zip_.read(entry, std::as_writable_bytes(std::span(bytes)));
  pickle_ = read_pickle(bytes, path + ": " + std::string(kPickleName));
  add_tensors(find_state_dict());
  strip_module_prefix();
  check_totals();
}

void PthFile::find_archive_root() {
  const std::string suffix = "/" + std::string(kPickleName);
  bool found = false;
  for (const auto& entry : zip_.entries()) {
    if (!entry.name.ends_with(suffix)) continue;
    if (found) fail(ErrorKind::kFormat, path(), " holds two entries named ", kPickleName);
    found = true;
    root_ = entry.name.substr(0, entry.name.size() - kPickleName.size());
  }
  if (!found)
    fail(ErrorKind::kFormat, path(), " is a zip archive, but not one of torch.save: it holds no ",
         kPickleName);
  if (zip_.find(root_ + "constants.pkl") >= 0)
    fail(ErrorKind::kUnsupported, path(),
         " is a TorchScript program, not a checkpoint; save its state_dict()");
  const std::int64_t order = zip_.find(root_ + "byteorder");
  if (order < 0) return;
  constexpr std::string_view kLittle = "little";
  std::array<char, kLittle.size()> text{};
  const bool right_size =
      zip_.entries()[static_cast<std::size_t>(order)].num_bytes == kLittle.size();
  if (right_size) zip_.read(order, std::as_writable_bytes(std::span(text)));
  if (std::string_view(text.data(), text.size()) != kLittle)
    fail(ErrorKind::kUnsupported, path(), " was written on a big-endian machine");
}

PickleId PthFile::find_state_dict() {
  PickleId id = pickle_.root;
  for (int depth = 0; depth <= kMaxNesting; ++depth) {
    const PickleValue& dict = pickle_.values[id];
    if (dict.kind != PickleKind::kDict)
      fail(ErrorKind::kUnsupported, path(), " holds something else than a dictionary of tensors");
    const auto& items = pickle_.sequences[dict.payload];
    const auto value_of = [&](std::string_view wanted) -> std::optional<PickleId> {
      for (std::size_t i = 0; i + 1 < items.size(); i += 2) {
        const PickleValue& key = pickle_.values[items[i]];
        if (key.kind == PickleKind::kString && pickle_.strings[key.payload] == wanted &&
            pickle_.values[items[i + 1]].kind == PickleKind::kDict)
          return items[i + 1];
      }
      return std::nullopt;
    };
    std::optional<PickleId> inner;
    for (const std::string_view key : {"model_state_dict", "state_dict", "model"}) {
      inner = value_of(key);
      if (!inner) continue;
      notes_.push_back(concat("the weights are under '", key, "'; the ", items.size() / 2 - 1,
                              " other entries beside it are left out"));
      break;
    }
    if (!inner) return id;
    id = *inner;
  }
  fail(ErrorKind::kUnsupported, path(), " nests the weights more than ", kMaxNesting,
       " dictionaries deep");
}

std::int64_t PthFile::storage_entry(const PickleStorage& storage) const {
  const std::int64_t entry = zip_.find(root_ + "data/" + storage.key);
  if (entry < 0)
    fail(ErrorKind::kFormat, path(), ": the storage data/", storage.key, " is missing");
  const std::int64_t found = zip_.entries()[static_cast<std::size_t>(entry)].num_bytes;
  const auto expected = checked_mul(storage.size, dtype_size(storage.dtype));
  if (!expected || *expected != found)
    fail(ErrorKind::kFormat, path(), ": the storage data/", storage.key, " has ", found,
         " bytes, but ", storage.size, " elements of ", dtype_name(storage.dtype), " are expected");
  return entry;
}

PthTensor PthFile::checked_tensor(const std::string& name, const PickleTensor& view) const {
  const auto bad = [&](const auto&... parts) {
    fail(ErrorKind::kFormat, path(), ": tensor '", name, "' of shape ", shape_text(view.shape), " ",
         parts...);
  };
  const PickleStorage& storage = pickle_.storages[view.storage];
  storage_entry(storage);
  const auto negative = [](std::int64_t n) { return n < 0; };
  if (view.offset < 0 || std::any_of(view.shape.begin(), view.shape.end(), negative) ||
      std::any_of(view.strides.begin(), view.strides.end(), negative))
    bad("has a negative size, stride or offset");
  const auto volume = checked_volume(view.shape);
  if (!volume) bad("has too many elements to exist");
  if (*volume > 0) {
    const auto last = last_element(view);
    if (!last || *last >= storage.size)
      bad("reaches past the ", storage.size, " elements of its storage");
    if (*volume > storage.size)
      bad("repeats elements of its storage of ", storage.size, "; save it as .contiguous()");
  }
  // At most the bytes of the storage, which the archive really has.
  return {name, storage.dtype, view.shape, *checked_mul(*volume, dtype_size(storage.dtype)), view};
}

void PthFile::add_tensors(PickleId dict) {
  const auto& items = pickle_.sequences[pickle_.values[dict].payload];
  std::vector<std::string> left_out;
  for (std::size_t i = 0; i + 1 < items.size(); i += 2) {
    const PickleValue& key = pickle_.values[items[i]];
    const PickleValue& value = pickle_.values[items[i + 1]];
    const std::string name = key.kind == PickleKind::kString ? pickle_.strings[key.payload]
                                                             : std::string("(not a string)");
    const std::string fault = tensor_name_fault(name, {});
    if (!fault.empty())
      fail(ErrorKind::kFormat, path(), ": the name ", in_quotes(name), " in the state dict ",
           fault);
    if (key.kind == PickleKind::kString && value.kind == PickleKind::kTensor) {
      tensors_.push_back(checked_tensor(name, pickle_.tensors[value.payload]));
    } else {
      left_out.push_back(name);
    }
  }
  if (tensors_.empty())
    fail(ErrorKind::kFormat, path(),
         " holds no tensors, neither at the top nor under model_state_dict, "
         "state_dict or model");
  if (left_out.empty()) return;
  std::string list;
  for (std::size_t i = 0; i < std::min(left_out.size(), kMaxListed); ++i)
    list += " '" + left_out[i] + "'";
  notes_.push_back(concat(left_out.size(), " entries that are not tensors are left out:", list,
                          left_out.size() > kMaxListed ? " ..." : ""));
}

void PthFile::strip_module_prefix() {
  const bool all = std::all_of(tensors_.begin(), tensors_.end(), [](const PthTensor& t) {
    return t.name.starts_with(kModulePrefix);
  });
  if (all) {
    for (PthTensor& tensor : tensors_) tensor.name.erase(0, kModulePrefix.size());
    notes_.push_back("the prefix 'module.' that DataParallel adds is taken off every name");
  }
  std::set<std::string_view> names;
  for (const PthTensor& tensor : tensors_)
    if (!names.insert(tensor.name).second)
      fail(ErrorKind::kFormat, path(), ": tensor '", tensor.name, "' is there twice");
}

void PthFile::check_totals() const {
  std::optional<std::int64_t> total = 0;
  for (const PthTensor& tensor : tensors_)
    if (total) total = checked_add(*total, tensor.num_bytes);
  if (!total || *total / kMaxSharing > zip_.num_bytes())
    fail(ErrorKind::kLimit, path(),
         ": its tensors share storages so much that they need more than ", kMaxSharing,
         " times the bytes of the file");
}

void PthFile::read(const PthTensor& tensor, std::span<std::byte> out) {
  LVGGT_CHECK(static_cast<std::int64_t>(out.size()) == tensor.num_bytes, path(), ": tensor '",
              tensor.name, "' has ", tensor.num_bytes, " bytes, but ", out.size(), " are expected");
  if (out.empty()) return;
  const std::int64_t entry = storage_entry(pickle_.storages[tensor.view.storage]);
  const std::int64_t entry_bytes = zip_.entries()[static_cast<std::size_t>(entry)].num_bytes;
  const bool dense = strides_are_dense(tensor);
  if (dense && entry_bytes == tensor.num_bytes && cached_entry_ != entry) {
    zip_.read(entry, out);
    return;
  }
  if (cached_entry_ != entry) {
    cached_entry_ = -1;
    cache_.resize(static_cast<std::size_t>(entry_bytes));
    zip_.read(entry, cache_);
    cached_entry_ = entry;
  }
  if (dense) {
    const auto first = size_product(tensor.view.offset, dtype_size(tensor.dtype));
    std::memcpy(out.data(), cache_.data() + first, out.size());
  } else {
    gather(tensor, cache_, out);
  }
}

}  // namespace lvggt
