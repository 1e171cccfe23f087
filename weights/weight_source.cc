// SPDX-License-Identifier: Apache-2.0
#include "weights/weight_source.h"

#include <array>
#include <filesystem>
#include <string_view>
#include <utility>

#include "lvggt/io/input_file.h"
#include "weights/pth.h"

namespace lvggt {
namespace {

class SafetensorsSource : public WeightSource {
 public:
  explicit SafetensorsSource(const std::string& path) : file_(Safetensors::open(path)) {}

  std::string format() const override { return "safetensors"; }
  std::vector<std::string> files() const override { return file_.files(); }
  const std::vector<TensorEntry>& tensors() const override { return file_.entries(); }
  std::map<std::string, std::string> metadata() const override { return file_.metadata(); }
  void read(std::size_t i, std::span<std::byte> out) override {
    file_.read_bytes(file_.entries().at(i), out);
  }

 private:
  Safetensors file_;
};

class PthSource : public WeightSource {
 public:
  explicit PthSource(const std::string& path) : file_(path) {
    for (const PthTensor& tensor : file_.tensors())
      tensors_.push_back({tensor.name, tensor.dtype, tensor.shape, 0, 0, tensor.num_bytes});
  }

  std::string format() const override { return "PyTorch checkpoint"; }
  std::vector<std::string> files() const override { return {file_.path()}; }
  const std::vector<TensorEntry>& tensors() const override { return tensors_; }
  std::vector<std::string> notes() const override { return file_.notes(); }
  void read(std::size_t i, std::span<std::byte> out) override {
    file_.read(file_.tensors().at(i), out);
  }

 private:
  PthFile file_;
  std::vector<TensorEntry> tensors_;
};

bool is_zip(const std::string& path) {
  const InputFile file(path);
  std::array<char, 4> head{};
  if (file.size() < static_cast<std::int64_t>(head.size())) return false;
  file.read_at(0, head.data(), head.size());
  const std::string_view start(head.data(), head.size());
  return start == "PK\3\4" || start == "PK\5\6";
}

}  // namespace

std::unique_ptr<WeightSource> WeightSource::open(const std::string& path) {
  std::error_code ignored;
  if (!std::filesystem::is_directory(path, ignored) && is_zip(path))
    return std::make_unique<PthSource>(path);
  return std::make_unique<SafetensorsSource>(path);
}

}  // namespace lvggt
