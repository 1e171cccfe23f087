// SPDX-License-Identifier: Apache-2.0
#pragma once

#include <cstddef>
#include <cstdint>
#include <span>
#include <string>
#include <vector>

#include "lvggt/io/dtype.h"
#include "weights/pickle.h"
#include "weights/zip_archive.h"

namespace lvggt {

// One tensor of a PyTorch checkpoint: a checked view of a storage.
struct PthTensor {
  std::string name;  // as in the state dict, a "module." of DataParallel taken off
  Dtype dtype = Dtype::kF32;
  std::vector<std::int64_t> shape;
  std::int64_t num_bytes = 0;  // row-major, without gaps
  PickleTensor view;
};

// A checkpoint that torch.save wrote (PyTorch 1.6 and later): a zip archive with a pickle, of which
// only tensors in plain containers are read, see pickle.h. The state dict is the top-level
// dictionary, or what it holds under model_state_dict, state_dict or model.
class PthFile {
 public:
  // Checks everything but the tensors' bytes. Errors: kRead, kFormat, kUnsupported, kLimit.
  explicit PthFile(const std::string& path);

  const std::string& path() const { return zip_.path(); }
  const std::vector<PthTensor>& tensors() const { return tensors_; }

  // What was done or left out on the way, one sentence each.
  const std::vector<std::string>& notes() const { return notes_; }

  // The tensor's values row-major without gaps; out.size() must be tensor.num_bytes.
  void read(const PthTensor& tensor, std::span<std::byte> out);

 private:
  void find_archive_root();
  PickleId find_state_dict();
  void add_tensors(PickleId dict);
  void strip_module_prefix();
  void check_totals() const;
  PthTensor checked_tensor(const std::string& name, const PickleTensor& view) const;
  std::int64_t storage_entry(const PickleStorage& storage) const;

  ZipArchive zip_;
  std::string root_;  // folder of all entries within the archive, with its slash
  Pickle pickle_;
  std::vector<PthTensor> tensors_;
  std::vector<std::string> notes_;
  std::int64_t cached_entry_ = -1;  // of cache_, for tensors that share a storage
  std::vector<std::byte> cache_;
};

}  // namespace lvggt
