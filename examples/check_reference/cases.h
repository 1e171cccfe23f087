// SPDX-License-Identifier: Apache-2.0
#pragma once

#include "examples/check_reference/comparison.h"

namespace check_reference {

// Each runs the model or the operators on the inputs of the comparison's file and compares every
// tensor it can compute.

// stream, stream_lang6, evict, full_size: frames one at a time with the cache.
void check_stream(Comparison& comparison, const lvggt::LoadOptions& load,
                  lvggt::Storage cache_storage, lvggt::Context& ctx);

// batch, square (causal) and vggt (bidirectional): all frames at once.
void check_clip(Comparison& comparison, const lvggt::LoadOptions& load, lvggt::BatchMode mode,
                lvggt::Context& ctx);

// ops: single operators and blocks, forward and backward.
void check_ops(Comparison& comparison, lvggt::Context& ctx);

// train, train_small, train_upstream_cos: losses, gradients and steps of the decoder, twice: in
// float64 like the reference, on plain kernels (lines "float64.*"), and by the float32 trainer.
// `inputs` is a file that holds in.*, when the comparison's own does not.
void check_train(Comparison& comparison, const std::string& name, const lvggt::LoadOptions& load,
                 const std::string& inputs, lvggt::Context& ctx);

// adamw, in ops: three clipped steps on two tensors.
void check_adamw(Comparison& comparison, lvggt::Context& ctx);

// preprocess: image loading.
void check_preprocess(Comparison& comparison);

// The camera of a pose encoding by the reference's formulas alone: unlike decode_pose_encoding, a
// field of view of 0 has an infinite focal length here instead of being refused.
lvggt::Camera camera_as_encoded(lvggt::View<const float, 1> encoding, std::int64_t H,
                                std::int64_t W);

}  // namespace check_reference
