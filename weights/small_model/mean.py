#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Weighted mean of the averaged weights of trainings that started from the same ones.

  mean.py OUT.pt 0.5=RUN1/checkpoint.pt 0.5=RUN2/checkpoint.pt

The shares add up to 1. OUT.pt goes where a checkpoint goes in evaluate.py, export.py and train.py --start-from; the
readings and the count of steps in it are the last one's.
"""
import os
import pickle
import sys

import torch


def weighted(argument):
    share, _, path = argument.partition("=")
    try:
        return float(share), path, torch.load(path)
    except (ValueError, OSError, RuntimeError, pickle.UnpicklingError) as error:
        sys.exit(f"mean.py: {argument}: not SHARE=CHECKPOINT: {error}")


def main():
    if len(sys.argv) < 3 or sys.argv[1] in ("-h", "--help"):
        sys.exit(__doc__)
    mean, parts = None, [weighted(argument) for argument in sys.argv[2:]]
    if abs(sum(share for share, _, _ in parts) - 1) > 1e-6:
        sys.exit(f"mean.py: the shares add up to {sum(share for share, _, _ in parts):g}, not to 1")
    for share, path, state in parts:
        weights = state["average"]
        if mean and {name: t.shape for name, t in mean.items()} != {name: t.shape for name, t in weights.items()}:
            sys.exit(f"mean.py: {path}: other weights than {parts[0][1]}; were both trained with one configuration?")
        mean = {name: share * t + (mean[name] if mean else 0) for name, t in weights.items()}
    kept = {name: parts[-1][2][name] for name in ("helper", "total") if name in parts[-1][2]}
    torch.save({"average": mean, **kept}, f"{sys.argv[1]}.tmp")
    os.replace(f"{sys.argv[1]}.tmp", sys.argv[1])


if __name__ == "__main__":
    main()
