#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Gives the two coarsest levels of the depth head, those of the third and the last tap, a new start.

  revive.py MODEL OUT.pt

MODEL: a training's checkpoint.pt or a model's safetensors.

A level's sum passes a ReLU on its way. Where all of it is negative the level gives a constant, has no gradient and
never comes back: the head then sees the first two taps only. Both levels start again from random weights, but give the
constant they gave (away from the borders) until they learn more. The share of values above 0 is printed, before and
after, on six rendered clips.
"""
import os
import pickle
import sys

import torch

import evaluate
import scenes
import train


def start_again(convolution, gain):
    with torch.no_grad():
        convolution.weight.normal_(0, gain / convolution.weight[0].numel() ** 0.5)
        if convolution.bias is not None:
            convolution.bias.zero_()


def revive(head):
    scratch = head.scratch
    last, features = scratch.refinenet3, scratch.refinenet3.out_conv.in_channels
    with torch.no_grad():
        constant = last.out_conv(last.resConfUnit2(torch.zeros(1, features, 13, 13)))[0, :, 6, 6].clone()
    for level, layer in ((2, scratch.layer3_rn), (3, scratch.layer4_rn)):
        start_again(head.projects[level], 1)
        start_again(layer, 1)
    start_again(head.resize_layers[3], 1)
    for fusion in (scratch.refinenet3, scratch.refinenet4):
        for unit in ("resConfUnit1", "resConfUnit2"):
            if hasattr(fusion, unit):  # the coarsest has nothing coarser to add to
                start_again(getattr(fusion, unit).conv1, 1.4)
                start_again(getattr(fusion, unit).conv2, 0.5)
        start_again(fusion.out_conv, 1)
    with torch.no_grad():
        last.out_conv.weight.zero_()
        last.out_conv.bias.copy_(constant)


def alive(model, images):
    return ", ".join(f"level {k} {share:.3f}" for k, share in enumerate(evaluate.depth_levels(model, images), 1))


def main():
    if len(sys.argv) != 3 or sys.argv[1] in ("-h", "--help"):
        sys.exit(__doc__)
    try:
        state, model = torch.load(sys.argv[1]) if sys.argv[1].endswith(".pt") else {}, evaluate.load(sys.argv[1])
    except (OSError, KeyError, ValueError, RuntimeError, pickle.UnpicklingError) as error:
        sys.exit(f"revive.py: {sys.argv[1]}: neither a checkpoint of train.py with config.json's sizes nor a model's safetensors: {error}")
    generator = scenes.Generator()
    images = scenes.targets([generator.clip(train.HELD_OUT_SEED + i, 2, 168, 238) for i in range(6)])["images"]
    print("before:", alive(model, images))
    torch.manual_seed(5)
    revive(model.depth_head)
    print("after: ", alive(model, images))
    kept = {name: state[name] for name in ("helper", "total") if name in state}
    torch.save({"average": model.state_dict(), **kept}, f"{sys.argv[2]}.tmp")
    os.replace(f"{sys.argv[2]}.tmp", sys.argv[2])


if __name__ == "__main__":
    main()
