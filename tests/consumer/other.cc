// SPDX-License-Identifier: Apache-2.0
#include <lvggt/lvggt.h>

bool all_chunks_run();

bool all_chunks_run() {
  lvggt::Context ctx(2);
  lvggt::Tensor<float, 1> done(lvggt::Shape<1>{64});
  lvggt::parallel_chunks(
      64, [&](std::int64_t chunk, int) { done(chunk) = 1.0f; }, ctx);
  float sum = 0;
  for (std::int64_t chunk = 0; chunk < 64; ++chunk) sum += done(chunk);
  return sum == 64;
}
