// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "examples/check_reference/comparison.h"

namespace check_reference {

// autoencoder: codes, decoded features, gradients and three steps of Adam of both modes.
void check_autoencoder(Comparison& comparison, lvggt::Context& ctx);

// query: from codes to relevancy, masks, levels and scores.
void check_query(Comparison& comparison, lvggt::Context& ctx);

// polygons: masks of polygons, and of the annotation files beside the case's.
void check_polygons(Comparison& comparison);

// timeseries: smoothing, threshold, calls and scores; and the same from codes and masks.
void check_timeseries(Comparison& comparison, lvggt::Context& ctx);

}  // namespace check_reference
