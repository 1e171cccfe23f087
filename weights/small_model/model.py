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
USUAL_TURN, USUAL_DIRECTION = 0.0175, 0.175  # a good camera's errors, radians
HELD_WEIGHT = 2.0    # of the depth of what is held and of people
MOVING = 0.03        # of the mean distance: a translation that has a direction
TURNING = 0.01       # sine of half the angle: a rotation that has an axis
WEIGHTS = {"depth": 1, "relative": 0.6, "gradient": 0.7, "grip": 0.7, "confidence": 0.2, "shift": 10, "turn": 20, "view": 0.7,
           "direction": 0.5, "axis": 0.8, "turned": 2.0, "headed": 0.15}  # of the objective's terms


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


def gradient_error(error, worth):
    """How unevenly the error lies: between neighbours, and between a hand and what it holds. A pair of pixels counts as much
    as the worthier of them."""
    total, steps = 0, (1, 2, 4, 8, 16, 32)
    for step in steps:
        n = min(step, 4)
        e, w = (x[..., ::step // n, ::step // n] for x in (error, worth))
        for side in (-1, -2):
            size = e.shape[side] - n
            pair = torch.maximum(w.narrow(side, 0, size), w.narrow(side, n, size))
            apart = (e.narrow(side, n, size) - e.narrow(side, 0, size)).abs()
            total = total + (pair * apart).mean() / pair.mean()
    return total / len(steps)


def grip_error(error, objects, held, person):
    """How differently far a held thing and the arm that holds it, the object numbered after it, are taken to be. error, objects'
    numbers and masks, all [N, H, W]; mean over the pairs that fill a hundredth of a picture each."""
    pictures, ids = len(error), int(objects.max()) + 2
    place = (objects + ids * torch.arange(pictures)[:, None, None]).flatten()

    def sums(values):
        return torch.zeros(pictures * ids).scatter_add(0, place, values.flatten().float()).view(pictures, ids)

    size = sums(torch.ones_like(error))
    mean, large = sums(error) / size.clamp(min=1), size > 0.01 * error[0].numel()
    pairs = (large & (sums(held) > 0))[:, :-1] & (large & (sums(person) > 0))[:, 1:]
    return (mean[:, :-1] - mean[:, 1:]).abs()[pairs].sum() / pairs.sum().clamp(min=1)


def direction_error(said, wanted, shortest):
    """One minus the cosine between vectors [..., 3], mean over those that are long enough to have a direction."""
    length = wanted.norm(dim=-1)
    cosine = (said * wanted).sum(-1) / (said.norm(dim=-1).clamp(min=0.01) * length.clamp(min=1e-6))
    return (1 - cosine)[length > shortest].sum() / max(1, (length > shortest).sum())


def typical(off, unit):
    """Mean of log(1 + off / unit): errors of the many small ones count as much as of the few large ones, as in a median."""
    return (off / unit).log1p().sum() / max(1, len(off))


def directions_apart(said, wanted, shortest):
    """Distances on the unit sphere between directions of vectors [..., 3], of those that are long enough to have one."""
    far = wanted.norm(dim=-1) > shortest
    return (F.normalize(said[far], dim=-1, eps=0.01) - F.normalize(wanted[far], dim=-1)).norm(dim=-1)


def depth_terms(out, batch, dense):
    def of(name):
        return batch[name] if dense is None else batch[name].flatten(0, 1)[dense]

    error = out["depth"].log() - of("depth").log()
    absolute = error.abs()
    # What is held and people are small in most pictures, and what they are looked at for.
    worth = torch.where(of("held") | of("person"), HELD_WEIGHT, 1.0)
    worth = worth / worth.mean()
    # What is taken for far though it is near weighs more than its logarithm says.
    relative = error.clamp(max=1.1).expm1().abs()
    # Its best value is 1 / error; it learns from the error and does not weigh it.
    confidence = out["confidence"] * absolute.detach() - out["confidence"].log()
    masks = (of(name).flatten(0, -3) for name in ("objects", "held", "person"))
    return {"depth": (worth * absolute).mean(), "relative": (worth * relative).mean(),
            "gradient": gradient_error(error, worth), "grip": grip_error(error.flatten(0, -3), *masks),
            "confidence": confidence.mean()}


def camera_terms(out, batch):
    said, true = out["pose"], batch["pose"]
    weight = POSE_DISCOUNT ** torch.arange(said.shape[2] - 1, -1, -1.0)
    off = ((said - true[:, :, None]).abs().mean((0, 1)) * weight[:, None]).sum(0) / weight.sum()
    # L1 alone leaves the short translations and small turns of hand-held cameras unlearnt.
    said = said[:, :, -1]
    turned = 2 * (F.normalize(said[:, 1:, 3:7], dim=-1) - true[:, 1:, 3:7]).norm(dim=-1)
    headed = directions_apart(said[..., :3], true[..., :3], MOVING)
    return {"shift": off[:3].mean(), "turn": off[3:7].mean(), "view": off[7:].mean(),
            "direction": direction_error(said[..., :3], true[..., :3], MOVING),
            "axis": direction_error(said[..., 3:6], true[..., 3:6], TURNING),
            "turned": typical(turned.flatten(), USUAL_TURN), "headed": typical(headed, USUAL_DIRECTION)}


def objective(out, batch, dense=None):
    """The loss and its terms. dense: the pictures out["depth"] is of, as in StreamVggt.clips; none: cameras alone."""
    depth = depth_terms(out, batch, dense) if out["depth"].numel() else {}
    terms = {**depth, **camera_terms(out, batch)}
    return sum(WEIGHTS[name] * term for name, term in terms.items()), terms


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
