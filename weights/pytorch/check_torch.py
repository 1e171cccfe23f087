#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Compares the PyTorch definition with reference values: frames one at a time, and as a whole clip.

  weights_init --config tests/golden/config_tiny.json --seed 1 tiny.safetensors
  check_torch.py tests/golden/config_tiny.json tiny.safetensors tests/golden/stream_tiny_seed1.safetensors

Prints max|ours - ref| / max|ref| of each tensor; the exit status is 1 if one is above 2e-4.
"""
import json
import pathlib
import sys

import torch

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "small_model"))
from model import read_safetensors  # noqa: E402
from torch_geometry import Stream, StreamVggt  # noqa: E402

TOLERANCE = 2e-4


def main():
    if len(sys.argv) != 4:
        sys.exit(__doc__)
    config = json.loads(pathlib.Path(sys.argv[1]).read_text())
    weights, _ = read_safetensors(sys.argv[2])
    reference, _ = read_safetensors(sys.argv[3])
    model = StreamVggt(config)
    model.load_state_dict({name: weights.get(name, own) for name, own in model.state_dict().items()})
    images = reference["images"]
    stream = Stream(model)
    frames = [stream.push(image[None]) for image in images]
    with torch.no_grad():
        clip = model.clips(images[None])
    ours = {"depth": torch.cat([f["depth"][:, 0] for f in frames]),
            "depth_conf": torch.cat([f["confidence"][:, 0] for f in frames]),
            "cam.cached.pose_enc": torch.stack([torch.cat(f["pose"], 1)[0] for f in frames])}
    for i in range(len(model.aggregator.global_blocks)):
        ours[f"agg.layer{i}"] = torch.cat([f["outputs"][i] for f in frames])
    whole = {"depth": clip["depth"][0], "depth_conf": clip["confidence"][0], "cam.cached.pose_enc": clip["pose"][0]}
    worst = 0.0
    for way, values in (("frames", ours), ("clip", whole)):
        for name, value in values.items():
            error = float((value - reference[name]).abs().max() / reference[name].abs().max())
            worst = max(worst, error)
            print(f"{way:7} {name:20} {error:.2e}")
    sys.exit(1 if not worst <= TOLERANCE else 0)


if __name__ == "__main__":
    main()
