// SPDX-License-Identifier: Apache-2.0
#include <algorithm>

#include "examples/check_reference/cases.h"
#include "lvggt/train/adamw.h"

namespace check_reference {

using namespace lvggt;

void check_adamw(Comparison& comparison, Context& ctx) {
  const Safetensors& file = comparison.file();
  const auto size = [&](const char* name) { return file.at(name).shape; };
  ParameterStore store({{"w", size("adamw.w0")}, {"b", size("adamw.b0")}});
  const auto read = [&](const std::string& name, StoreRole role, const char* parameter) {
    file.read_into(name, store.values(role, parameter));
    comparison.accept(name);
  };
  read("adamw.w0", StoreRole::kWeights, "w");
  read("adamw.b0", StoreRole::kWeights, "b");
  std::vector<float> norms;
  for (std::int64_t t = 1; t <= file.at("adamw.norms").size(); ++t) {
    const std::string number = std::to_string(t);
    read("adamw.gw" + number, StoreRole::kGradients, "w");
    read("adamw.gb" + number, StoreRole::kGradients, "b");
    const double norm = gradient_norm(store, ctx);
    norms.push_back(static_cast<float>(norm));
    adamw_step(store, t, 1e-3, std::min(1.0, 1 / (norm + 1e-6)), 0, {.weight_decay = 0.1}, ctx);
    comparison.compare("adamw.w" + number, store.values(StoreRole::kWeights, "w"));
    comparison.compare("adamw.b" + number, store.values(StoreRole::kWeights, "b"));
  }
  comparison.compare("adamw.norms", std::span<const float>(norms));
}

}  // namespace check_reference
