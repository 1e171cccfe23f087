#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Teaches the global blocks where to look: what a patch of a later frame shows was somewhere in the first frame and in
the frame before, and the renderer knows where. Two heads of each learning block but the last learn to attend there. Without it
small models learn depth from single pictures and never compare frames; their cameras then have no direction.
  matching.py      compares kernels/matching.cc with PyTorch"""
import ctypes

import torch
import torch.nn.functional as F

import attention
import scenes

ALIKE = 0.06  # of log depth: the same surface


def watch(model):
    for block in model.aggregator.global_blocks[:-1]:
        if any(p.requires_grad for p in block.attn.parameters()):
            block.attn.kept = []


def cells(x, step):
    """The values in the middle of each patch: [..., H, W] -> [..., h, w]."""
    return x[..., step // 2::step, step // 2::step]


def seen_in(points, depth, objects, here, still, rotation, translation, tangent):
    """Weights [B, h * w, h * w]: on which patches of the frame with `depth`, `objects` [B, H, W] and its camera lies what the
    patches of another frame show, points [B, h, w, 3] of the objects `here`; zeros where it is not in sight or not
    `still`. And a mask [B, h * w] of those that moved by a patch or more."""
    B, h, w, _ = points.shape
    H, W = depth.shape[1:]
    p = torch.einsum("bij,bhwj->bhwi", rotation, points) + translation[:, None, None]
    z = p[..., 2].clamp(min=0.02)
    place = p[..., :2] / z[..., None] / tangent[:, None, None]  # -1 to 1: width, height
    x, y = (place[..., 0] + 1) / 2 * W - 0.5, (place[..., 1] + 1) / 2 * H - 0.5
    column, row = x.round().long().clamp(0, W - 1), y.round().long().clamp(0, H - 1)
    clip = torch.arange(B)[:, None, None]
    alike = (depth[clip, row, column].log() - z.log()).abs() < ALIKE
    visible = (p[..., 2] > 0.02) & (place.abs() < 1).all(-1) & alike & (objects[clip, row, column] == here) & still
    # Shared among the four nearest patches: the place within a patch is taught as well.
    column, row = ((place[..., 0] + 1) / 2 * w - 0.5).clamp(0, w - 1), ((place[..., 1] + 1) / 2 * h - 0.5).clamp(0, h - 1)
    across = F.relu(1 - (column[..., None] - torch.arange(w)).abs())
    down = F.relu(1 - (row[..., None] - torch.arange(h)).abs())
    moved = torch.hypot(column - torch.arange(w), row - torch.arange(h)[:, None])
    # Neighbours guess those that hardly moved; the others have to be recognised.
    weights = down[..., :, None] * across[..., None, :] * (visible * (0.1 + moved.clamp(max=1)))[..., None, None]
    return weights.view(B, h * w, h * w), (visible & (moved >= 1)).view(B, h * w)


def targets(batch, step):
    """For each later frame, where its patches were in the first frame and in the one before: [B, S - 1, 2, h * w, h * w];
    and which of them moved."""
    points, objects = cells(batch["points"].permute(0, 1, 4, 2, 3), step).permute(0, 1, 3, 4, 2), batch["objects"]
    tangent = (batch["pose"][:, 0, 7:9] / 2).tan().flip(-1)
    still = ~(batch["held"] | batch["person"])
    rotation, translation = batch["rotation"].float(), batch["translation"].float()
    found = [seen_in(points[:, s], batch["depth"][:, f], objects[:, f], cells(objects[:, s], step),
                     cells(still[:, s], step), rotation[:, f], translation[:, f], tangent)
             for s in range(1, points.shape[1]) for f in (0, s - 1)]
    B, S = points.shape[:2]
    return [torch.stack(parts, 1).view(B, S - 1, 2, *parts[0].shape[1:]) for parts in zip(*found)]


class Look(torch.autograd.Function):
    """q, k: [B, 2, S * P, HEAD]. The cross-entropy's sum, by kernels/matching.cc; and how many are looked for in the right place."""
    @staticmethod
    def forward(ctx, q, k, wanted, moved, special):
        (B, later), frame, (dq, dk) = wanted.shape[:2], q.shape[2] // (1 + wanted.shape[1]), map(torch.empty_like, (q, k))
        found = (ctypes.c_double * 2)()
        pointers = [ctypes.c_void_p(t.data_ptr()) for t in (q, k, dq, dk, wanted, moved)]
        sizes = [ctypes.c_int64(n) for n in (B, 1 + later, frame, special, torch.get_num_threads())]
        attention.library().small_model_matching(*pointers, *sizes, found)
        ctx.save_for_backward(dq, dk)
        right = torch.tensor(found[1])
        ctx.mark_non_differentiable(right)
        return torch.tensor(found[0], dtype=torch.float32), right

    @staticmethod
    def backward(ctx, given, _):
        dq, dk = ctx.saved_tensors
        return given * dq, given * dk, None, None, None


def look(q, k, wanted, moved, special):
    """What Look computes, in PyTorch."""
    S, P, total, right = 1 + wanted.shape[1], special + wanted.shape[-1], 0, 0
    for s in range(1, S):
        scores = q[:, :, s * P + special:(s + 1) * P] @ k[:, :, :(s + 1) * P].transpose(-1, -2) * q.shape[-1] ** -0.5
        log = scores.log_softmax(-1)
        for head, frame in ((0, 0), (1, s - 1)):
            at = log[:, head, :, frame * P + special:(frame + 1) * P]
            total = total - (wanted[:, s - 1, head] * at).sum()
            best = wanted[:, s - 1, head].gather(-1, at.argmax(-1, keepdim=True))[..., 0]
            right = right + (moved[:, s - 1, head] & (best > 0)).sum()
    return total, right


def loss(model, batch, special):
    """Cross-entropy of the two heads' attention, mean over the patches that are in sight; and how many of those that moved
    are looked for in the right place by the last of them."""
    kept = [block.attn.kept for block in model.aggregator.global_blocks if block.attn.kept is not None]
    seen = [[x[:, :2].float() for x in pairs.pop()] for pairs in kept]
    if batch["depth"].shape[1] == 1 or not seen:
        return torch.zeros(()), torch.zeros(())
    wanted, moved = targets(batch, model.c["patch_size"])
    way = Look.apply if seen[0][0].shape[-1] == attention.HEAD else look
    found = [way(*(x.contiguous() for x in pair), wanted, moved, special) for pair in seen]
    return sum(total for total, _ in found) / wanted.sum().clamp(min=1) / len(seen), found[-1][1] / moved.sum().clamp(min=1)


def main():
    torch.manual_seed(1)
    generator, step, special = scenes.Generator(), 14, 5
    for clips, frames in ((12, 2), (6, 4), (3, 7)):
        batch = scenes.targets([generator.clip(1 + i, frames, 12 * step, 17 * step) for i in range(clips)])
        wanted, moved = targets({name: torch.from_numpy(value) for name, value in batch.items()}, step)
        shape, results = (clips, 2, frames * (special + wanted.shape[-1]), attention.HEAD), []
        q, k = (2 * torch.randn(shape) for _ in range(2))
        for way in (look, Look.apply):
            parts = [x.clone().requires_grad_() for x in (q, k)]
            total, right = way(*parts, wanted, moved, special)
            results.append((total.detach(), right.float(), *torch.autograd.grad(total, parts)))
        off = max(((a - b).abs().max() / a.abs().max().clamp(min=1e-9)).item() for a, b in zip(*results))
        print(f"{clips} clips of {frames} frames, {int(results[0][1])} right: apart by {off:.1e} of the largest value at most")
        if not off < 2e-5:
            raise SystemExit("matching.py: matching.cc does not compute what PyTorch does")


if __name__ == "__main__":
    main()
