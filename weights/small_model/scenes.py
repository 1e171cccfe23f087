# SPDX-License-Identifier: Apache-2.0
"""Rendered clips with exact depth and cameras as NumPy arrays, and batches of them made ahead.
  scenes.py [--seed N] [--count N] [--size HxW] [--frames N] OUT.png    a sheet to look at
  scenes.py --speed                                                      frames a second of one thread"""
import argparse
import collections
import concurrent.futures
import ctypes
import os
import pathlib
import subprocess
import tempfile
import time

import numpy as np

import pictures

HERE = pathlib.Path(__file__).resolve().parent
ROOT = HERE.parents[1]
BUILD = ROOT / "build" / "small_model"
LABELS = ("room", "thing", "held", "person")

Clip = collections.namedtuple("Clip", "rgb depth objects cam_from_world fov labels seed")


def build_library(name, sources, flags, folder=BUILD):
    """Compiles the .cc files in the folder `sources`, unless `folder` has a library newer than they are."""
    target = pathlib.Path(folder) / f"libsmall_model_{name}.so"
    newest = max(p.stat().st_mtime for kind in ("*.cc", "*.h") for p in sources.glob(kind))
    if not target.exists() or target.stat().st_mtime < newest:
        target.parent.mkdir(parents=True, exist_ok=True)
        with tempfile.TemporaryDirectory(dir=folder) as work:
            made = pathlib.Path(work) / target.name
            subprocess.run([os.environ.get("CXX", "c++"), "-std=c++20", "-O3", "-fno-math-errno", "-fPIC", "-shared", *flags,
                            f"-I{ROOT}", *map(str, sorted(sources.glob("*.cc"))), "-o", str(made)], check=True)
            os.replace(made, target)
    return target


class Generator:
    def __init__(self, folder=BUILD):
        self.render_clip = ctypes.CDLL(str(build_library("scenes", HERE, [], folder))).small_model_render
        pointer = ctypes.c_void_p
        self.render_clip.argtypes = [ctypes.c_uint64, ctypes.c_int, ctypes.c_int, ctypes.c_int] + [pointer] * 6
        self.render_clip.restype = ctypes.c_int

    def clip(self, seed, frames, height, width):
        """The scene of `seed`, or of the next seed that gives one that can be used."""
        size = (frames, height, width)
        out = Clip(np.empty((*size, 3), np.uint8), np.empty(size, np.float32), np.empty(size, np.uint8),
                   np.empty((frames, 3, 4), np.float32), np.empty(2, np.float32), np.empty(256, np.uint8), seed)
        for step in range(100):
            # Neighbours in the list of seeds do not share scenes.
            tried = (seed * 1009 + step) % (1 << 63)
            if self.render_clip(tried, frames, height, width, *(a.ctypes.data for a in out[:6])) == 0:
                return out
        raise RuntimeError(f"no usable scene near seed {seed}")


def mirrored(clip):
    """Left and right exchanged."""
    flip = np.array([-1, 1, 1], np.float32)
    camera = clip.cam_from_world * flip[None, :, None]
    camera[..., :3] *= flip
    return clip._replace(rgb=clip.rgb[:, :, ::-1], depth=clip.depth[:, :, ::-1], objects=clip.objects[:, :, ::-1],
                         cam_from_world=camera)


def backwards(clip):
    """The last frame first."""
    return clip._replace(rgb=clip.rgb[::-1], depth=clip.depth[::-1], objects=clip.objects[::-1],
                         cam_from_world=clip.cam_from_world[::-1])


class Batches:
    """Batches rendered ahead on one thread: batch k has the clips of seeds first + k * 64 + i."""

    def __init__(self, generator, plan, first_seed, begin=0, ahead=3):
        """plan(k) -> (clips, frames, height, width) of batch k"""
        self.generator, self.plan, self.first_seed = generator, plan, first_seed
        self.pool = concurrent.futures.ThreadPoolExecutor(1)
        self.next = begin
        self.pending = collections.deque()
        for _ in range(ahead):
            self.submit()

    def submit(self):
        self.pending.append(self.pool.submit(self.make, self.next))
        self.next += 1

    def make(self, k):
        clips, frames, height, width = self.plan(k)
        return [self.generator.clip(self.first_seed + k * 64 + i, frames, height, width) for i in range(clips)]

    def __next__(self):
        batch = self.pending.popleft().result()
        self.submit()
        return batch


def targets(clips):
    """A list of clips as arrays: images [B,S,3,H,W] in [0,1]; depth [B,S,H,W] and cameras with the first
    frame's mean distance as unit and its camera as world; pose encodings [B,S,9]; points [B,S,H,W,3] in
    the first camera; objects [B,S,H,W] and masks of what is held and of people; unit [B], metres."""
    images = np.stack([c.rgb for c in clips]).astype(np.float32) / 255
    depth = np.stack([c.depth for c in clips])
    B, S, H, W = depth.shape
    fov = np.stack([c.fov for c in clips])
    u = (np.arange(W, dtype=np.float32) + 0.5) / W * 2 - 1
    v = (np.arange(H, dtype=np.float32) + 0.5) / H * 2 - 1
    rays = np.ones((B, H, W, 3), np.float32)
    rays[..., 0] = u * np.tan(fov[:, 1] / 2)[:, None, None]
    rays[..., 1] = v[:, None] * np.tan(fov[:, 0] / 2)[:, None, None]
    unit = (depth[:, 0] * np.linalg.norm(rays, axis=-1)).mean((1, 2))
    depth = depth / unit[:, None, None, None]
    pose = np.stack([c.cam_from_world for c in clips]).astype(np.float64)
    R, t = pose[..., :3], pose[..., 3]
    relative = R @ R[:, :1].swapaxes(-1, -2)
    moved = (t - (relative @ t[:, :1, :, None])[..., 0]) / unit[:, None, None]
    in_camera = rays[:, None] * depth[..., None] - moved[:, :, None, None].astype(np.float32)
    points = np.einsum("bsji,bshwj->bshwi", relative.astype(np.float32), in_camera)
    encoding = np.concatenate([moved, quaternions(relative), np.broadcast_to(fov[:, None], (B, S, 2))], -1)
    objects = np.stack([c.objects for c in clips]).astype(np.int64)
    labels = np.stack([c.labels[c.objects] for c in clips])
    held, person = (labels == LABELS.index(name) for name in ("held", "person"))
    return {"images": images.transpose(0, 1, 4, 2, 3), "depth": depth, "pose": encoding.astype(np.float32),
            "points": points, "objects": objects, "held": held, "person": person, "unit": unit,
            "rotation": relative, "translation": moved, "fov": fov}


def quaternions(R):
    """Scalar last and not negative; for rotations well under half a turn."""
    w = np.sqrt(np.maximum(1e-9, 1 + R[..., 0, 0] + R[..., 1, 1] + R[..., 2, 2])) / 2
    x, y, z = R[..., 2, 1] - R[..., 1, 2], R[..., 0, 2] - R[..., 2, 0], R[..., 1, 0] - R[..., 0, 1]
    q = np.stack([x / (4 * w), y / (4 * w), z / (4 * w), w], -1)
    return q / np.linalg.norm(q, axis=-1, keepdims=True)


def sheet(generator, seed, count, frames, height, width):
    """[rows, columns, 3] bytes: each clip's frames over their depth, near is bright."""
    rows = []
    for i in range(count):
        clip = generator.clip(seed + i, frames, height, width)
        near = np.log(clip.depth)
        near = 1 - (near - near.min()) / max(np.ptp(near), 1e-6)
        grey = np.repeat((255 * near).astype(np.uint8)[..., None], 3, -1)
        rows.append(np.concatenate([np.concatenate(list(clip.rgb), 1), np.concatenate(list(grey), 1)], 1))
    half = (count + 1) // 2
    while len(rows) < 2 * half:
        rows.append(np.zeros_like(rows[0]))
    return np.concatenate([np.concatenate(rows[:half], 0), np.concatenate(rows[half:], 0)], 1)


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("out", nargs="?")
    arguments.add_argument("--seed", type=int, default=1)
    arguments.add_argument("--count", type=int, default=24)
    arguments.add_argument("--frames", type=int, default=2)
    arguments.add_argument("--size", default="112x154")
    arguments.add_argument("--speed", action="store_true")
    args = arguments.parse_args()
    height, width = map(int, args.size.split("x"))
    generator = Generator()
    if args.speed:
        begin = time.perf_counter()
        for i in range(args.count):
            generator.clip(args.seed + i, args.frames, height, width)
        took = time.perf_counter() - begin
        print(f"{args.count * args.frames / took:.1f} frames a second at {args.size}")
    if args.out:
        pictures.write_png(args.out, sheet(generator, args.seed, args.count, args.frames, height, width))


if __name__ == "__main__":
    main()
