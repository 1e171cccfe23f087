#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""One optimisation step of the published decoder at 294 x 518 in PyTorch, beside bench_train_step:
  OMP_WAIT_POLICY=passive MALLOC_MMAP_MAX_=0 MALLOC_TRIM_THRESHOLD_=20000000000 \
    torch_decoder_step.py [--batch N] [--steps N] [--threads N] [--channels-last]
"""
import argparse
import pathlib
import resource
import sys
import time

import torch

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "weights" / "pytorch"))
from torch_decoder import Decoder, objective, optimiser  # noqa: E402


def main():
    parser = argparse.ArgumentParser()
    parser.add_argument("--batch", type=int, default=1)
    parser.add_argument("--steps", type=int, default=5)
    parser.add_argument("--threads", type=int, default=2)
    parser.add_argument("--channels-last", action="store_true")
    args = parser.parse_args()
    torch.set_num_threads(args.threads)
    torch.manual_seed(1)
    h, w, B = 21, 37, args.batch
    H, W = 14 * h, 14 * w
    model = Decoder().train()
    if args.channels_last:
        model = model.to(memory_format=torch.channels_last)
    opt = optimiser(model, 4e-5)
    taps = [torch.rand(B, h * w, 2048) * 2 - 1] * 4
    images = torch.rand(B, 3, H, W)
    features = torch.rand(B, 3, 3, H, W) * 2 - 1
    mask = torch.ones(B, 3, 1, H, W)
    for step in range(args.steps):
        t0 = time.perf_counter()
        language, rgb = model(taps, h, w)
        loss, _ = objective(language, rgb, features, mask, images)
        t1 = time.perf_counter()
        opt.zero_grad(set_to_none=False)
        loss.backward()
        t2 = time.perf_counter()
        torch.nn.utils.clip_grad_norm_(model.parameters(), 1.0)
        opt.step()
        t3 = time.perf_counter()
        print(f"step {step + 1}: {t3 - t0:.3f} s = forward {t1 - t0:.3f} + backward {t2 - t1:.3f}"
              f" + optimiser {t3 - t2:.3f}   loss {loss.item():.6f}", flush=True)
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 1024
    print(f"process: peak {peak:.0f} MiB   torch {torch.__version__}, {args.threads} threads,"
          f" channels_last {args.channels_last}")


main()
