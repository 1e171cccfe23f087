#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Takes the weights of dead levels of the depth head away, which leaves room for more pairs of blocks.

  drop_dead_levels.py MODEL.safetensors OUT.safetensors

A level's sum passes a ReLU on its way. Where all of it is negative, the level gives a constant whatever its channels say.
The two coarsest levels, those of the third and the last tap, get the fewest channels a configuration can have, and weights
that add nothing.
Unless depth and confidence of six rendered clips stay the same to the bit, nothing is written.
"""
import json
import sys

import torch

import evaluate
import model as small
import scenes
import train

FEWEST = 4       # channels that lvggt reads
NOTHING = 1e-30  # beside a bias; zeros would look like a damaged file


def dropped(tensors):
    """The weights with both levels silent."""
    def silence(name, *shape):
        tensors[name] = torch.full((*shape, *tensors[name].shape[2:]), NOTHING)

    for level in (2, 3):
        project, layer = f"depth_head.projects.{level}", f"depth_head.scratch.layer{level + 1}_rn.weight"
        silence(f"{project}.weight", FEWEST, tensors[f"{project}.weight"].shape[1])
        silence(f"{project}.bias", FEWEST)
        silence(layer, tensors[layer].shape[0], FEWEST)
    silence("depth_head.resize_layers.3.weight", FEWEST, FEWEST)
    silence("depth_head.resize_layers.3.bias", FEWEST)
    return tensors


def main():
    if len(sys.argv) != 3 or sys.argv[1] in ("-h", "--help"):
        sys.exit(__doc__)
    try:
        before = evaluate.load(sys.argv[1])
        tensors, metadata = small.read_safetensors(sys.argv[1])
        config = json.loads(metadata["config"])
    except (OSError, KeyError, ValueError, RuntimeError) as error:
        sys.exit(f"drop_dead_levels.py: {sys.argv[1]}: not a small model's safetensors with its configuration: {error}")
    config["dpt_out_channels"][2:] = [FEWEST, FEWEST]
    after = small.make_model({**small.DEFAULTS, **config}, 0)
    after.load_state_dict(dropped(tensors))
    generator = scenes.Generator()
    images = scenes.targets([generator.clip(train.HELD_OUT_SEED + i, 2, 168, 238) for i in range(6)])["images"]
    was, now = (evaluate.run_clips(model.eval(), images) for model in (before, after))
    for name, a, b in zip(("depth", "confidence"), was, now):
        if (a != b).any():
            shares = ", ".join(f"{share:.3f}" for share in evaluate.depth_levels(before, images))
            sys.exit(f"drop_dead_levels.py: {sys.argv[1]}: {name} would change by up to {abs(a - b).max():.2g}: its two coarsest levels "
                     f"are not dead (shares above 0 of the four levels: {shares})")
    small.write_safetensors(sys.argv[2], tensors, {**metadata, "config": json.dumps(config)})
    print(f"{sys.argv[2]}: {small.count(before) - small.count(after)} values less, the same depths")


if __name__ == "__main__":
    main()
