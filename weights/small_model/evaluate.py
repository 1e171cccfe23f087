#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Scores the small model, in PyTorch, on scenes it was not trained on and on the labelled cup clip.

  evaluate.py MODEL [--clips 200] [--frames 4] [--size 112x154] [--cup DATA/cup] [--json OUT]

MODEL: a safetensors file with its configuration, or a training's checkpoint.pt (its averaged weights).
Depth is scored in the unit the model was trained for, the first frame's mean distance, with no fitting; the
lines "fitted" are after one scale a clip. Cameras: each later frame against the first; turn and direction are medians over
those that moved by 3 % of the mean distance or more. Intervals: 95 % of what other clips of the same kind would give.
"""
import argparse
import json
import math
import pathlib

import numpy as np
import torch

import model as small
import pictures
import scenes
import tuned

HELD_OUT_SEED = 1_200_000_000


def angle_between(a, b):
    """Degrees between rotations [..., 3, 3]."""
    trace = np.einsum("...ij,...ij", a, b)
    return np.degrees(np.arccos(np.clip((trace - 1) / 2, -1, 1)))


def rotation_of(q):
    x, y, z, w = np.moveaxis(q / np.linalg.norm(q, axis=-1, keepdims=True), -1, 0)
    return np.stack([1 - 2 * (y * y + z * z), 2 * (x * y - z * w), 2 * (x * z + y * w),
                     2 * (x * y + z * w), 1 - 2 * (x * x + z * z), 2 * (y * z - x * w),
                     2 * (x * z - y * w), 2 * (y * z + x * w), 1 - 2 * (x * x + y * y)], -1).reshape(*q.shape[:-1], 3, 3)


def run_clips(model, images):
    with torch.no_grad():
        out = model.clips(torch.from_numpy(np.ascontiguousarray(images)))
    return out["depth"].numpy(), out["confidence"].numpy(), out["pose"][:, :, -1].double().numpy()


def depth_levels(model, images):
    """Of every level's sum in the depth head, from the finest on, the share above 0: what the rest of the head can see of it.
    A level where it stays 0 gives a constant and learns nothing."""
    shares, hooks = [0.0] * 4, []
    for level in range(4):
        unit = getattr(model.depth_head.scratch, f"refinenet{level + 1}").resConfUnit2
        hooks.append(unit.register_forward_pre_hook(
            lambda _, x, level=level: shares.__setitem__(level, (x[0] > 0).float().mean().item())))
    run_clips(model, images)
    for hook in hooks:
        hook.remove()
    return shares


def interval(of_clips, statistic):
    """Where 95 % of the statistic's values lie when clips are drawn again from those at hand, as a list. of_clips: an array a clip."""
    if not any(map(len, of_clips)):
        return [math.nan, math.nan]
    draw = np.random.default_rng(0)
    drawn = (np.concatenate([of_clips[i] for i in draw.integers(0, len(of_clips), len(of_clips))]) for _ in range(500))
    values = [statistic(values) for values in drawn if len(values)]
    return [round(float(v), 4) for v in np.percentile(values, (2.5, 97.5))]


def score_rendered(model, generator, seed, clips, frames, height, width):
    log_error, fitted, relative, relative_fitted, most, constant = [], [], [], [], [], []
    turn, direction, still, view = [], [], [], []
    turn_at = [[] for _ in range(1, frames)]
    for first in range(0, clips, 8):
        truth = scenes.targets([generator.clip(seed + i, frames, height, width)
                                for i in range(first, min(first + 8, clips))])
        depth, confidence, pose = run_clips(model, truth["images"])
        error = np.log(depth) - np.log(truth["depth"])
        scale = np.median(error, (1, 2, 3), keepdims=True)
        log_error.append(np.abs(error).mean((1, 2, 3)))
        fitted.append(np.abs(error - scale).mean((1, 2, 3)))
        relative.append((np.abs(depth - truth["depth"]) / truth["depth"]).mean((1, 2, 3)))
        relative_fitted.append((np.abs(depth / np.exp(scale) - truth["depth"]) / truth["depth"]).mean((1, 2, 3)))
        constant.append(np.abs(np.log(truth["depth"])).mean((1, 2, 3)))
        for e, c in zip(np.abs(error), confidence):
            for ef, cf in zip(e.reshape(frames, -1), c.reshape(frames, -1)):
                most.append(ef[cf >= np.median(cf)].mean() / max(ef.mean(), 1e-9))
        view.append(np.degrees(np.abs(pose[..., 8] - truth["fov"][:, None, 1])).ravel())
        t, want = pose[:, 1:, :3].reshape(-1, 3), truth["translation"][:, 1:].reshape(-1, 3)
        size = np.linalg.norm(want, axis=-1)
        cosine = (t * want).sum(-1) / np.maximum(np.linalg.norm(t, axis=-1) * size, 1e-9)
        direction.append(np.degrees(np.arccos(np.clip(cosine, -1, 1)))[size > small.MOVING])
        off = angle_between(rotation_of(pose[:, 1:, 3:7]), truth["rotation"][:, 1:])
        moves = (size > small.MOVING).reshape(off.shape)
        turn.extend(o[m] for o, m in zip(off, moves))
        for s, at in enumerate(turn_at):
            at.extend(off[moves[:, s], s])
        still.append(np.linalg.norm(t, axis=-1)[size < 1e-6])
    spread = {"abs_rel_interval": interval(np.concatenate(relative)[:, None], np.mean),
              "rotation_degrees_interval": interval(turn, np.median)}
    log_error, turn, direction, still = map(np.concatenate, (log_error, turn, direction, still))
    return {"log_depth": float(log_error.mean()), "log_depth_median": float(np.median(log_error)),
            "log_depth_fitted": float(np.concatenate(fitted).mean()),
            "abs_rel": float(np.concatenate(relative).mean()), "abs_rel_fitted": float(np.concatenate(relative_fitted).mean()),
            "constant_log_depth": float(np.concatenate(constant).mean()),
            "confident_half": float(np.mean(most)), "rotation_degrees": float(np.median(turn)) if len(turn) else math.nan,
            **{f"rotation_degrees_frame_{s}": float(np.median(at)) for s, at in enumerate(turn_at, 1) if at},
            "direction_degrees": float(np.median(direction)) if len(direction) else math.nan,
            **spread, "moving": len(direction), "still_translation": float(np.median(still)) if len(still) else math.nan,
            "view_degrees": float(np.median(np.concatenate(view)))}


def score_cup(model, folder, height, width):
    """The cup: bottle before hand before wall, by medians over its labels; how still wall and camera are."""
    folder = pathlib.Path(folder)
    frames = sorted((folder / "rgb" / "2x").glob("*.png"))
    images = np.stack([pictures.resized(pictures.read_png(path), height, width) for path in frames])
    depths, poses = run_stream(model, images)
    order, wall, medians = [], [], []
    for path, depth in zip(frames, depths):
        labels = np.load(folder / "clip_features" / f"{path.stem}_s.npy")[0]
        rows = (np.arange(height) + 0.5) * labels.shape[0] // height
        columns = (np.arange(width) + 0.5) * labels.shape[1] // width
        here = labels[rows.astype(int)][:, columns.astype(int)]
        median = [float(np.median(depth[here == k])) if (here == k).any() else math.nan for k in (0, 1, 2)]
        medians.append(median)
        order.append(median[0] < median[1] < median[2])
        wall.append(median[2])
    turn = angle_between(rotation_of(poses[:, 3:7]), rotation_of(poses[:1, 3:7]))
    moved = np.linalg.norm(poses[:, :3] - poses[:1, :3], axis=-1)
    bottle, hand, far = np.nanmedian(np.array(medians), 0)
    return {"frames": len(frames), "ordered": float(np.mean(order)),
            "hand_before_wall": float(np.mean([m[1] < m[2] for m in medians])), "bottle": float(bottle),
            "hand": float(hand), "wall": float(far), "wall_variation": float(np.std(wall) / np.mean(wall)),
            "camera_moved": float(np.median(moved)), "camera_moved_most": float(moved.max()),
            "camera_turned_degrees": float(np.median(turn)), "camera_turned_most_degrees": float(turn.max())}


def run_stream(model, images):
    """Frame by frame as the engine does. images [S, 3, H, W] -> depth [S, H, W], last pose encodings [S, 9]."""
    from torch_geometry import Stream
    stream = Stream(model)
    depths, poses = [], []
    for image in images:
        out = stream.push(torch.from_numpy(image[None]))
        depths.append(out["depth"][0, 0].numpy())
        poses.append(out["pose"][-1][0, 0].double().numpy())
    return np.stack(depths), np.stack(poses)


def load(path, config=None):
    if str(path).endswith(".pt"):
        model = small.make_model(small.load_config(config or small.HERE / "config.json"), 0)
        model.load_state_dict(torch.load(path)["average"])
    else:
        tensors, metadata = small.read_safetensors(path)
        model = small.make_model({**small.DEFAULTS, **json.loads(metadata["config"])}, 0)
        own = model.state_dict()
        model.load_state_dict({**own, **{k: v for k, v in tensors.items() if k in own}})
    return model.eval()


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("model")
    arguments.add_argument("--clips", type=int, default=200)
    arguments.add_argument("--frames", type=int, default=4)
    arguments.add_argument("--size", default="112x154")
    arguments.add_argument("--cup")
    arguments.add_argument("--threads", type=int, default=2)
    arguments.add_argument("--json")
    args = arguments.parse_args()
    tuned.tune()
    torch.set_num_threads(args.threads)
    height, width = map(int, args.size.split("x"))
    model = load(args.model)
    results = {"size": args.size}
    if args.clips:
        results["rendered"] = score_rendered(model, scenes.Generator(), HELD_OUT_SEED, args.clips, args.frames, height, width)
    if args.cup:
        results["cup"] = score_cup(model, args.cup, height, width)
    text = json.dumps(results, indent=1)
    print(text)
    if args.json:
        pathlib.Path(args.json).write_text(text + "\n")


if __name__ == "__main__":
    main()
