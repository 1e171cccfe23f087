#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Writes the small model as lvggt reads it, and reference values for check_reference.

  export.py RUN/checkpoint.pt small_model.safetensors      bf16, names of the published checkpoints
  export.py --dump case.safetensors small_model.safetensors [--size 56x84] [--frames 3]
      what PyTorch computes in float32 from the file's weights, frames one at a time, on a rendered clip
"""
import argparse
import hashlib
import json
import pathlib

import torch
import torch.nn.functional as F

import model as small
import scenes

DUMP_SEED = 1_300_000_000
POSITIONS = "aggregator.patch_embed.pos_embed"


def resized_positions(table, side):
    """The position embedding for another number of patches a side."""
    old = round((table.shape[1] - 1) ** 0.5)
    patches = table[:, 1:].reshape(1, old, old, -1).permute(0, 3, 1, 2)
    patches = F.interpolate(patches, (side, side), mode="bicubic", antialias=True)
    return torch.cat([table[:, :1], patches.permute(0, 2, 3, 1).flatten(1, 2)], 1)


def export(checkpoint, out, config_path, note, side):
    state = torch.load(checkpoint)
    config = json.loads(pathlib.Path(config_path).read_text())
    tensors = dict(state["average"])
    if side:
        config["img_size"] = side
        tensors[POSITIONS] = resized_positions(tensors[POSITIONS], side // 14)
    # Weights of layers and the table of positions; the rest is little, and float32 in the engine anyway.
    large = {name for name, t in tensors.items() if name.endswith(".weight") and t.ndim > 1} | {POSITIONS}
    tensors = {name: t.to(torch.bfloat16) if name in large else t for name, t in tensors.items()}
    for name, t in tensors.items():
        if not torch.isfinite(t).all():
            raise SystemExit(f"export.py: {checkpoint}: {name} is not finite")
    small.write_safetensors(out, tensors, {"config": json.dumps(config), "origin": note,
                                           "training_steps": str(state["total"]), "licence": "Apache-2.0"})
    data = pathlib.Path(out).read_bytes()
    print(f"{out}: {len(data)} bytes, sha256 {hashlib.sha256(data).hexdigest()}")


def dump(weights, out, frames, height, width):
    import evaluate
    from torch_geometry import Stream
    model = evaluate.load(weights)
    clip = scenes.Generator().clip(DUMP_SEED, frames, height, width)
    images = torch.from_numpy(scenes.targets([clip])["images"][0].copy())
    stream = Stream(model)
    results = [stream.push(images[s:s + 1]) for s in range(frames)]
    tensors = {"images": images, "depth": torch.cat([r["depth"][:, 0] for r in results]),
               "depth_conf": torch.cat([r["confidence"][:, 0] for r in results]),
               "cam.cached.pose_enc": torch.stack([torch.cat(r["pose"], 1)[0] for r in results])}
    last = len(model.aggregator.global_blocks) - 1
    tensors[f"agg.layer{last}"] = torch.cat([r["outputs"][-1] for r in results])
    small.write_safetensors(out, {k: v.float() for k, v in tensors.items()},
                            {"case": "stream", "weights_sha256": hashlib.sha256(pathlib.Path(weights).read_bytes()).hexdigest()})


def main():
    arguments = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    arguments.add_argument("source")
    arguments.add_argument("out", nargs="?")
    arguments.add_argument("--dump")
    arguments.add_argument("--config", default=str(small.HERE / "config.json"))
    arguments.add_argument("--note", default="trained on rendered scenes; see the card beside it")
    arguments.add_argument("--img-size", type=int, default=0, help="the size that programs use; else the configuration's")
    arguments.add_argument("--size", default="56x84")
    arguments.add_argument("--frames", type=int, default=3)
    args = arguments.parse_args()
    if args.dump:
        dump(args.source, args.dump, args.frames, *map(int, args.size.split("x")))
    elif args.out:
        export(args.source, args.out, args.config, args.note, args.img_size)
    else:
        arguments.error("give the file to write, or --dump")


if __name__ == "__main__":
    main()
