// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "weights/small_model/scene.h"

namespace small_model {

// From light to a picture: exposure, white balance, vignette, blur, tone curve, noise and 8 bits.
void take_picture(Picture& picture, const Look& look, std::uint64_t noise_seed);

}  // namespace small_model
