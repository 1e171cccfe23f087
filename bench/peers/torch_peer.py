#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""One operation in PyTorch; prints the median milliseconds.
  torch_peer.py linear M N K | attention NQ NK | block N | conv K CIN COUT H W | bilinear C
  torch_peer.py frame SIZE FRAMES   a streamed frame of the published configuration (random weights):
                                    the last of FRAMES, 294 x 518 pixels for SIZE 518
  torch_peer.py stream SIZE FRAMES  the median of those frames
  torch_peer.py release SIZE FRAMES the last one in the steps of the authors' release, see torch_release.py
"""
import json
import os
import pathlib
import statistics
import sys
import time

import torch
import torch.nn as nn
import torch.nn.functional as F

sys.path.insert(0, str(pathlib.Path(__file__).resolve().parents[2] / "weights" / "pytorch"))


def median_ms(run, seconds=1.0):
    run()
    times, begin = [], time.perf_counter()
    while len(times) < 5 or time.perf_counter() - begin < seconds:
        start = time.perf_counter()
        run()
        times.append(1e3 * (time.perf_counter() - start))
    return statistics.median(times)


def linear(M, N, K):
    layer, x = nn.Linear(K, N), torch.randn(1, M, K)
    # The layer that widens four times is fc1, with its GELU.
    return median_ms((lambda: F.gelu(layer(x))) if N == 4 * K else (lambda: layer(x)))


def attention(Nq, Nk, heads=16, dim=64):
    """The faster of all heads at once and head by head: the scores of all heads may not fit."""
    q, k, v = (torch.randn(heads, n, dim) for n in (Nq, Nk, Nk))

    def all_heads():
        return torch.softmax((q * dim ** -0.5) @ k.transpose(-2, -1), -1) @ v

    def head_by_head():
        return [torch.softmax((q[h] * dim ** -0.5) @ k[h].t(), -1) @ v[h] for h in range(heads)]

    times = [median_ms(head_by_head)]
    if Nk <= 16 * 782:
        times.append(median_ms(all_heads))
    return min(times)


def block(N):
    from torch_geometry import Block, Rope2d
    w = 37
    layer = Block(1024, 16, True, 1e-5, 0.01)
    rope = Rope2d((N - 5) // w, w, 64)
    x = torch.randn(1, N, 1024)
    return median_ms(lambda: layer(x, rope))


def conv(kernel, cin, cout, H, W):
    """The fastest of three layouts."""
    layer, x = nn.Conv2d(cin, cout, kernel, padding=kernel // 2).eval(), torch.randn(1, cin, H, W)
    times = [median_ms(lambda: layer(x))]
    last, xl = layer.to(memory_format=torch.channels_last), x.contiguous(memory_format=torch.channels_last)
    times.append(median_ms(lambda: last(xl)))
    from torch.utils import mkldnn
    blocked, xb = mkldnn.to_mkldnn(layer), x.to_mkldnn()
    times.append(median_ms(lambda: blocked(xb)))
    return min(times)


def bilinear(C):
    x = torch.randn(1, C, 168, 296).contiguous(memory_format=torch.channels_last)
    return median_ms(lambda: F.interpolate(x, (294, 518), mode="bilinear", align_corners=True))


PUBLISHED = json.loads("""{
  "patch_size": 14, "img_size": 518, "mlp_ratio": 4, "num_register_tokens": 4, "embed_dim": 1024,
  "dino_depth": 24, "dino_heads": 16, "dino_qk_norm": false, "dino_ln_eps": 1e-6, "dino_init_values": 1.0,
  "agg_depth": 24, "agg_heads": 16, "agg_qk_norm": true, "agg_ln_eps": 1e-5, "agg_init_values": 0.01, "rope_freq": 100.0,
  "cam_heads": 16, "cam_trunk_depth": 4, "cam_qk_norm": false, "cam_ln_eps": 1e-5, "cam_adaln_eps": 1e-6,
  "cam_iterations": 4, "taps": [4, 11, 17, 23], "dpt_features": 256, "dpt_out_channels": [256, 512, 1024, 1024],
  "dpt_head_features_2": 32, "dpt_pos_embed_ratio": 0.1, "image_mean": [0.485, 0.456, 0.406],
  "image_std": [0.229, 0.224, 0.225]}""")


def release(size, frames):
    import torch_release
    torch_release.use()
    return frame(size, frames)


def frame(size, frames):
    return frame_times(size, frames)[-1]


def stream(size, frames):
    return statistics.median(frame_times(size, frames))


def frame_times(size, frames):
    from torch_decoder import Decoder
    from torch_geometry import Stream, StreamVggt
    laps, clock, times = {}, [time.perf_counter()], []

    def lap(name):
        now = time.perf_counter()
        laps[name] = laps.get(name, 0) + now - clock[0]
        clock[0] = now

    stream = Stream(StreamVggt(PUBLISHED), Decoder().eval(), lap)
    for _ in range(frames):
        laps.clear()
        image = torch.rand(1, 3, round(size * 9 / 16 / 14) * 14, size)
        clock[0] = time.perf_counter()
        stream.push(image)
        print("  ".join(f"{name} {t:.2f} s" for name, t in laps.items()), file=sys.stderr, flush=True)
        times.append(1e3 * sum(laps.values()))
    return times


def main():
    rows = {f.__name__: f for f in (linear, attention, block, conv, bilinear, frame, stream, release)}
    if len(sys.argv) < 2 or sys.argv[1] not in rows:
        sys.exit(__doc__)
    torch.set_num_threads(len(os.sched_getaffinity(0)))
    torch.set_grad_enabled(False)
    torch.manual_seed(0)
    print(f"{rows[sys.argv[1]](*map(int, sys.argv[2:])):.4f}")


if __name__ == "__main__":
    main()
