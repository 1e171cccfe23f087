// SPDX-License-Identifier: Apache-2.0
#include <doctest/doctest.h>

#include <cstdint>
#include <sstream>
#include <string>
#include <vector>

#include "lvggt/io/input_file.h"
#include "lvggt/io/safetensors.h"
#include "lvggt/model/tensor_list.h"
#include "tests/support/paths.h"

TEST_CASE("names.tsv: the table of published tensors is what the loader expects") {
  std::ostringstream expected;
  expected << "name\tdtype\tshape\tcheckpoint\n";
  const lvggt::ModelConfig config;
  for (const auto& spec : lvggt::geometry_tensors(config))
    expected << spec.name << "\tF32\t" << lvggt::shape_text(spec.shape) << "\tgeometry\n";
  for (const auto& spec : lvggt::decoder_tensors(config))
    expected << spec.name << "\tF32\t" << lvggt::shape_text(spec.shape) << "\tdecoder\n";
  // Made by: weights_init --list > weights/names.tsv
  CHECK(lvggt::read_text_file(lvggt::test::test_data("../weights/names.tsv")) == expected.str());
}
