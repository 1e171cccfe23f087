// SPDX-License-Identifier: Apache-2.0
#include "lvggt/io/read_depth_png.h"

#include "lvggt/io/json.h"

namespace lvggt {

void read_depth_png(View<float, 2> numbers, const std::string& png_path,
                    const std::string& json_path) {
  const Json sidecar = Json::read(json_path);
  const Json* member = sidecar.find("scale");
  const double scale = member != nullptr ? member->as_double(json_path + ": scale") : 0;
  if (!(scale > 0)) fail(ErrorKind::kFormat, json_path, ": has no positive scale");
  const Tensor<std::uint16_t, 2> values = load_grey16(png_path);
  LVGGT_CHECK(values.shape() == numbers.shape(), png_path, ": is ", values.shape(), ", expected ",
              numbers.shape());
  for (std::int64_t y = 0; y < numbers.extent(0); ++y)
    for (std::int64_t x = 0; x < numbers.extent(1); ++x)
      numbers(y, x) = static_cast<float>(values(y, x) * scale);
}

}  // namespace lvggt
