# SPDX-License-Identifier: Apache-2.0
"""The small model: its configuration, its starting weights, its objective, its files."""
import json
import math
import os
import pathlib
import re
import struct
import sys

import torch
import torch.nn as nn
import torch.nn.functional as F

HERE = pathlib.Path(__file__).resolve().parent
sys.path.insert(0, str(HERE.parent / "pytorch"))
import torch_decoder  # noqa: E402
from torch_geometry import StreamVggt  # noqa: E402

# What the published configuration has and a smaller one need not repeat.
DEFAULTS = {
    "patch_size": 14, "mlp_ratio": 4, "num_register_tokens": 4, "dino_qk_norm": False, "dino_ln_eps": 1e-6,
    "dino_init_values": 1.0, "agg_qk_norm": True, "agg_ln_eps": 1e-5, "agg_init_values": 1.0, "rope_freq": 100.0,
    "cam_qk_norm": False, "cam_ln_eps": 1e-5, "cam_adaln_eps": 1e-6, "cam_iterations": 4,
    "dpt_pos_embed_ratio": 0.1, "image_mean": [0.485, 0.456, 0.406], "image_std": [0.229, 0.224, 0.225]}
POSE_DISCOUNT = 0.6  # of an earlier iteration's error
MOVING = 0.03        # of the mean distance: a translation that has a direction
TURNING = 0.01       # sine of half the angle: a rotation that has an axis


def load_config(path=HERE / "config.json"):
    return {**DEFAULTS, **json.loads(pathlib.Path(path).read_text())}


def keep_variance(model):
    """Weights with which a signal keeps its size through the layers. PyTorch's own shrink it to a half in
    each, and nothing reaches the dense head's end, nor its gradient the encoder."""
    after_relu = ("conv1", "conv2", "output_conv2.2")
    for name, module in model.named_modules():
        if isinstance(module, nn.ConvTranspose2d):  # stride = kernel: one tap for each input channel
            module.weight.normal_(0, module.in_channels ** -0.5)
        elif isinstance(module, (nn.Linear, nn.Conv2d)):
            gain = 2 if name.endswith(after_relu) and "resConfUnit" in name or name.endswith("2.2") else 1
            if name.endswith(("resConfUnit1.conv2", "resConfUnit2.conv2", "attn.proj", "mlp.fc2")):
                gain *= 0.25  # ends of residual branches
            module.weight.normal_(0, (gain / module.weight[0].numel()) ** 0.5)
        else:
            continue
        if module.bias is not None:
            module.bias.zero_()


def make_model(config, seed):
    torch.manual_seed(seed)
    torch_decoder.FusionBlock.early_out_conv = True
    model = StreamVggt(config)
    a, c = model.aggregator, model.camera_head
    with torch.no_grad():
        keep_variance(model)
    with torch.no_grad():
        for token in (a.camera_token, a.register_token, a.patch_embed.cls_token, a.patch_embed.register_tokens,
                      a.patch_embed.pos_embed):
            token.normal_(0, 0.2)
        # A still camera with a common field of view, and the mean distance everywhere.
        c.pose_branch.fc2.weight.mul_(0.05)
        c.pose_branch.fc2.bias.copy_(torch.tensor([0, 0, 0, 0, 0, 0, 0.3, 0.2, 0.27]))
        last = model.depth_head.scratch.output_conv2[2]
        last.weight.mul_(0.2)
        last.bias.zero_()
    return model


def deepened(weights, pairs):
    """The same function with more pairs of frame and global blocks: further ones before the last, copies of the one before,
    add nothing to the tokens until they learn to. weights: a state_dict. And the names of the new weights."""
    pair = re.compile(r"(aggregator\.(?:frame|global)_blocks)\.(\d+)\.(.*)")
    found = {name: pair.fullmatch(name) for name in weights}
    last = max(int(m[2]) for m in found.values() if m)
    out, new = {}, set()
    for name, value in weights.items():
        if not (m := found[name]):
            out[name] = value
        elif int(m[2]) == last:
            out[f"{m[1]}.{pairs - 1}.{m[3]}"] = value
        else:
            out[name] = value
            for i in range(last, pairs - 1) if int(m[2]) == last - 1 else ():
                end = m[3].startswith(("attn.proj.", "mlp.fc2."))
                out[f"{m[1]}.{i}.{m[3]}"] = torch.zeros_like(value) if end else value.clone()
                new.add(f"{m[1]}.{i}.{m[3]}")
    return out, new


def gradient_error(error):
    """How unevenly the error lies, over three scales."""
    total = 0
    for step in (1, 2, 4):
        e = error[..., ::step, ::step]
        total = total + e.diff(dim=-1).abs().mean() + e.diff(dim=-2).abs().mean()
    return total / 3


def direction_error(said, wanted, shortest):
    """One minus the cosine between vectors [..., 3], mean over those that are long enough to have a direction."""
    length = wanted.norm(dim=-1)
    cosine = (said * wanted).sum(-1) / (said.norm(dim=-1).clamp(min=0.01) * length.clamp(min=1e-6))
    return (1 - cosine)[length > shortest].sum() / max(1, (length > shortest).sum())


def objective(out, batch, dense=None):
    """The loss and its terms. dense: the pictures out["depth"] is of, as in StreamVggt.clips."""
    truth = batch["depth"] if dense is None else batch["depth"].flatten(0, 1)[dense]
    error = out["depth"].log() - truth.log()
    absolute = error.abs()
    depth = absolute.mean()
    # What is taken for far though it is near weighs more than its logarithm says.
    relative = error.clamp(max=1.1).expm1().abs().mean()
    gradient = gradient_error(error)
    # Its best value is 1 / error; it learns from the error and does not weigh it.
    confidence = (out["confidence"] * absolute.detach() - out["confidence"].log()).mean()
    wanted = batch["pose"][:, :, None]
    weight = POSE_DISCOUNT ** torch.arange(out["pose"].shape[2] - 1, -1, -1.0)
    off = ((out["pose"] - wanted).abs().mean((0, 1)) * weight[:, None]).sum(0) / weight.sum()
    shift, turn, view = off[:3].mean(), off[3:7].mean(), off[7:].mean()
    # L1 alone leaves the short translations and small turns of hand-held cameras unlearnt.
    direction = direction_error(out["pose"][..., -1, :3], batch["pose"][..., :3], MOVING)
    axis = direction_error(out["pose"][..., -1, 3:6], batch["pose"][..., 3:6], TURNING)
    loss = depth + 0.4 * relative + 0.5 * gradient + 0.12 * confidence + 10 * shift + 20 * turn + 0.7 * view
    return loss + 0.5 * direction + 0.8 * axis, {
        "direction": direction, "axis": axis, "depth": depth, "relative": relative, "gradient": gradient,
        "confidence": confidence, "shift": shift, "turn": turn, "view": view}


def write_safetensors(path, tensors, metadata):
    """tensors: name -> float32 or bfloat16 tensor. Appears under its name only when complete."""
    kinds = {torch.float32: "F32", torch.bfloat16: "BF16", torch.int64: "I64"}
    header, offset, parts = {"__metadata__": metadata}, 0, []
    for name in sorted(tensors):
        t = tensors[name].detach().contiguous()
        raw = (t.view(torch.int16) if t.dtype == torch.bfloat16 else t).numpy().tobytes()
        header[name] = {"dtype": kinds[t.dtype], "shape": list(t.shape), "data_offsets": [offset, offset + len(raw)]}
        offset += len(raw)
        parts.append(raw)
    text = json.dumps(header, separators=(",", ":")).encode()
    text += b" " * (-len(text) % 8)
    unfinished = f"{path}.tmp"
    with open(unfinished, "wb") as file:
        file.write(struct.pack("<Q", len(text)) + text + b"".join(parts))
    os.replace(unfinished, path)


def read_safetensors(path):
    """name -> float32 tensor, and the metadata."""
    data = pathlib.Path(path).read_bytes()
    size = struct.unpack("<Q", data[:8])[0]
    header = json.loads(data[8:8 + size])
    metadata, tensors = header.pop("__metadata__", {}), {}
    kinds = {"F32": torch.float32, "BF16": torch.bfloat16}
    for name, entry in header.items():
        if entry["dtype"] not in kinds:
            continue  # numbers that are no weights
        begin, end = entry["data_offsets"]
        raw = torch.frombuffer(bytearray(data[8 + size + begin:8 + size + end]), dtype=kinds[entry["dtype"]])
        tensors[name] = raw.float().view(entry["shape"])
    return tensors, metadata


def count(model):
    return sum(math.prod(p.shape) for p in model.parameters())
