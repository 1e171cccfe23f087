// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/safetensors.h"

#include <doctest/doctest.h>

#include <vector>

#include "tests/support/temp_dir.h"

TEST_CASE("SafetensorsWriter: what is written is read back") {
  const lvggt::test::TempDir dir;
  const std::vector<float> values{1, -2.5f, 3, 0.125f, 5, 6};
  lvggt::SafetensorsWriter out(dir / "a.safetensors");
  out.set_metadata("key", "value \"x\"");
  out.add("kept", {2, 3}, values);
  out.declare("half", lvggt::Dtype::kF16, {6});
  out.declare("brain", lvggt::Dtype::kBF16, {3, 2});
  out.add_int64("ints", {2}, std::vector<std::int64_t>{-7, 1LL << 40});
  out.declare("double", lvggt::Dtype::kF64, {6});
  out.write("half", values);
  out.write("brain", std::span(values).first(2));
  out.write("brain", std::span(values).subspan(2));
  out.write("double", values);
  out.finish();

  const auto in = lvggt::Safetensors::open(dir / "a.safetensors");
  CHECK(in.metadata().at("key") == "value \"x\"");
  CHECK(in.entries().size() == 5);
  for (const char* name : {"kept", "half", "brain", "double"}) {
    std::vector<float> read(6);
    in.read_into(name, read);
    CHECK(read == values);
  }
  CHECK(in.read_int64("ints") == std::vector<std::int64_t>{-7, 1LL << 40});
  CHECK(in.read<2>("brain")(1, 1) == 0.125f);
}
