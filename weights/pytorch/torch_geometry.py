#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""The streaming geometry transformer in PyTorch: frames one at a time, or whole clips for training,
with the modules and parameter names of the published checkpoints, so that a state_dict fits either
side. For training the small model and for comparison; the engine does not need it."""
import functools
import math

import torch
import torch.nn as nn
import torch.nn.functional as F

from torch_decoder import FeatureExtractor


class Mlp(nn.Module):
    def __init__(self, dim, hidden, out=None):
        super().__init__()
        self.fc1 = nn.Linear(dim, hidden)
        self.fc2 = nn.Linear(hidden, out or dim)

    def forward(self, x):
        return self.fc2(F.gelu(self.fc1(x)))


class LayerScale(nn.Module):
    def __init__(self, dim, value):
        super().__init__()
        self.gamma = nn.Parameter(torch.full((dim,), value))

    def forward(self, x):
        return x * self.gamma


def rope_tables(positions, dim, base):
    """positions: [P] -> cos, sin [P, dim], every angle twice."""
    frequencies = base ** (-torch.arange(0, dim, 2, dtype=torch.float64) / dim)
    angles = positions[:, None].double() * frequencies
    angles = torch.cat([angles, angles], -1)
    return angles.cos().float(), angles.sin().float()


class Rope2d:
    """Rotary embedding of the head's first half by the row, of its second half by the column.
    frames > 1: for the tokens of so many frames in a row."""

    def __init__(self, h, w, head_dim, base=100.0, special=5, frames=1):
        rows, columns = torch.meshgrid(torch.arange(h) + 1, torch.arange(w) + 1, indexing="ij")
        zeros = torch.zeros(special, dtype=torch.long)
        y = rope_tables(torch.cat([zeros, rows.flatten()]), head_dim // 2, base)
        x = rope_tables(torch.cat([zeros, columns.flatten()]), head_dim // 2, base)
        self.cos = torch.cat([y[0], x[0]], -1).repeat(frames, 1)
        # Element k goes with k + a quarter of the head, in each half; the first gets a minus.
        quarter = head_dim // 4
        sign = torch.cat([-torch.ones(quarter), torch.ones(quarter)]).repeat(2)
        self.sin = (torch.cat([y[1], x[1]], -1) * sign).repeat(frames, 1)
        self.split = (2, 2, quarter)

    def __call__(self, t):
        return t * self.cos + t.unflatten(-1, self.split).flip(-2).flatten(-3) * self.sin


def frame_mask(frames, tokens):
    """[N, N]: 0 where a token's frame may look, minus infinity at later frames."""
    frame = torch.arange(frames).repeat_interleave(tokens)
    return torch.zeros(len(frame), len(frame)).masked_fill(frame[:, None] < frame, -math.inf)


def frame_attention(q, k, v, frame=None):
    """q, k, v: [B, heads, N, d]; frame: so many tokens are one frame's, and see those of their own and of earlier
    frames; all see all if None."""
    scores = (q * q.shape[-1] ** -0.5) @ k.transpose(-2, -1)
    if frame and frame < q.shape[2]:
        scores = scores + frame_mask(q.shape[2] // frame, frame)
    return torch.softmax(scores, -1) @ v


class Attention(nn.Module):
    kept = None  # a list for a training that wants to see queries and keys

    def __init__(self, dim, heads, qk_norm):
        super().__init__()
        self.heads = heads
        self.qkv = nn.Linear(dim, 3 * dim)
        self.q_norm = nn.LayerNorm(dim // heads, eps=1e-5) if qk_norm else nn.Identity()
        self.k_norm = nn.LayerNorm(dim // heads, eps=1e-5) if qk_norm else nn.Identity()
        self.proj = nn.Linear(dim, dim)

    def forward(self, x, rope=None, cache=None, frame=None):
        """x: [B, N, C]; cache: list of earlier (k, v), to which this call adds its own; frame: as in frame_attention."""
        B, N, C = x.shape
        q, k, v = self.qkv(x).to(x.dtype).reshape(B, N, 3, self.heads, C // self.heads).permute(2, 0, 3, 1, 4)
        q, k = self.q_norm(q), self.k_norm(k)
        if rope is not None:
            q, k = rope(q), rope(k)
        if self.kept is not None:
            self.kept.append((q, k))
        if cache is not None:
            cache.append((k, v))
            k, v = (torch.cat(parts, 2) for parts in zip(*cache))
        return self.proj(frame_attention(q, k, v, frame).transpose(1, 2).reshape(B, N, C))


class Block(nn.Module):
    def __init__(self, dim, heads, qk_norm, eps, init_values, mlp_ratio=4):
        super().__init__()
        self.norm1 = nn.LayerNorm(dim, eps=eps)
        self.attn = Attention(dim, heads, qk_norm)
        self.ls1 = LayerScale(dim, init_values)
        self.norm2 = nn.LayerNorm(dim, eps=eps)
        self.mlp = Mlp(dim, int(dim * mlp_ratio))
        self.ls2 = LayerScale(dim, init_values)

    def forward(self, x, rope=None, cache=None, frame=None):
        x = x + self.ls1(self.attn(self.norm1(x), rope, cache, frame))
        return x + self.ls2(self.mlp(self.norm2(x)))


class DinoV2(nn.Module):
    def __init__(self, c):
        super().__init__()
        C, side = c["embed_dim"], c["img_size"] // c["patch_size"]
        self.patch_embed = nn.Module()
        self.patch_embed.proj = nn.Conv2d(3, C, c["patch_size"], stride=c["patch_size"])
        self.cls_token = nn.Parameter(torch.zeros(1, 1, C))
        self.register_tokens = nn.Parameter(torch.zeros(1, c["num_register_tokens"], C))
        self.pos_embed = nn.Parameter(torch.zeros(1, 1 + side * side, C))
        self.mask_token = nn.Parameter(torch.zeros(1, C))
        self.blocks = nn.ModuleList(
            Block(C, c["dino_heads"], c["dino_qk_norm"], c["dino_ln_eps"], c["dino_init_values"], c["mlp_ratio"])
            for _ in range(c["dino_depth"]))
        self.norm = nn.LayerNorm(C, eps=c["dino_ln_eps"])
        self.side = side

    def positions(self, h, w):
        if h == self.side and w == self.side:
            return self.pos_embed
        table = self.pos_embed[:, 1:].reshape(1, self.side, self.side, -1).permute(0, 3, 1, 2)
        table = F.interpolate(table, (h, w), mode="bicubic", antialias=True)
        return torch.cat([self.pos_embed[:, :1], table.permute(0, 2, 3, 1).flatten(1, 2)], 1)

    def forward(self, image):
        x = self.patch_embed.proj(image)
        h, w = x.shape[2:]
        x = torch.cat([self.cls_token.expand(len(x), -1, -1), x.flatten(2).transpose(1, 2)], 1) + self.positions(h, w)
        x = torch.cat([x[:, :1], self.register_tokens.expand(len(x), -1, -1), x[:, 1:]], 1)
        for block in self.blocks:
            x = block(x)
        return self.norm(x)[:, 1 + self.register_tokens.shape[1]:]


class Aggregator(nn.Module):
    def __init__(self, c):
        super().__init__()
        C, registers = c["embed_dim"], c["num_register_tokens"]
        self.patch_embed = DinoV2(c)
        self.camera_token = nn.Parameter(torch.zeros(1, 2, 1, C))
        self.register_token = nn.Parameter(torch.zeros(1, 2, registers, C))

        def blocks():
            return nn.ModuleList(
                Block(C, c["agg_heads"], c["agg_qk_norm"], c["agg_ln_eps"], c["agg_init_values"], c["mlp_ratio"])
                for _ in range(c["agg_depth"]))

        self.frame_blocks, self.global_blocks = blocks(), blocks()
        self.c = c

    def forward(self, image, caches, rope, first, lap=lambda name: None):
        """One frame. image: [1, 3, H, W] in [0, 1]; caches: one list of (k, v) for each global block."""
        mean = torch.tensor(self.c["image_mean"])[:, None, None]
        std = torch.tensor(self.c["image_std"])[:, None, None]
        x = self.patch_embed((image - mean) / std)
        lap("dino")
        which = 0 if first else 1
        x = torch.cat([self.camera_token[:, which], self.register_token[:, which], x], 1)
        outputs = []
        for frame_block, global_block, cache in zip(self.frame_blocks, self.global_blocks, caches):
            within = x = frame_block(x, rope)
            lap("frame_blocks")
            x = global_block(x, rope, cache)
            lap("global_blocks")
            outputs.append(torch.cat([within, x], -1))
        return outputs

    def clips(self, images, rope, frames_rope):
        """Whole clips, each frame seeing itself and those before. images: [B, S, 3, H, W];
        frames_rope: of all S frames in a row. Outputs [B, S, P, 2C]."""
        B, S = images.shape[:2]
        mean = torch.tensor(self.c["image_mean"])[:, None, None]
        std = torch.tensor(self.c["image_std"])[:, None, None]
        x = self.patch_embed((images.flatten(0, 1) - mean) / std).unflatten(0, (B, S))
        which = torch.tensor([0] + [1] * (S - 1))
        special = torch.cat([self.camera_token[:, which], self.register_token[:, which]], 2)
        x = torch.cat([special.expand(B, -1, -1, -1), x], 2)
        outputs, P = [], x.shape[2]
        for frame_block, global_block in zip(self.frame_blocks, self.global_blocks):
            within = frame_block(x.flatten(0, 1), rope).view(B, S, P, -1)
            x = global_block(within.flatten(1, 2), frames_rope, None, P).view(B, S, P, -1)
            outputs.append(torch.cat([within, x], -1))
        return outputs


class CameraHead(nn.Module):
    def __init__(self, c):
        super().__init__()
        C = 2 * c["embed_dim"]
        self.token_norm = nn.LayerNorm(C, eps=c["cam_ln_eps"])
        self.trunk_norm = nn.LayerNorm(C, eps=c["cam_ln_eps"])
        self.trunk = nn.Sequential(*(
            Block(C, c["cam_heads"], c["cam_qk_norm"], c["cam_ln_eps"], c["agg_init_values"], c["mlp_ratio"])
            for _ in range(c["cam_trunk_depth"])))
        self.empty_pose_tokens = nn.Parameter(torch.zeros(1, 1, 9))
        self.embed_pose = nn.Linear(9, C)
        self.poseLN_modulation = nn.Sequential(nn.SiLU(), nn.Linear(C, 3 * C))
        self.adaln_norm = nn.LayerNorm(C, elementwise_affine=False, eps=c["cam_adaln_eps"])
        self.pose_branch = Mlp(C, C // 2, 9)
        self.iterations = c["cam_iterations"]

    def forward(self, token, caches=None):
        """token: [B, 1, 2C]; caches: one list for each block of the trunk. Every iteration's encoding."""
        t = self.token_norm(token)
        encoding, results = None, []
        for _ in range(self.iterations):
            e = self.embed_pose(self.empty_pose_tokens.expand(len(t), 1, 9) if encoding is None else encoding)
            shift, scale, gate = self.poseLN_modulation(e).chunk(3, -1)
            x = gate * (self.adaln_norm(t) * (1 + scale) + shift) + t
            for block, cache in zip(self.trunk, caches or [None] * len(self.trunk)):
                x = block(x, None, cache)
            delta = self.pose_branch(self.trunk_norm(x))
            encoding = delta if encoding is None else encoding + delta
            results.append(torch.cat([encoding[..., :7], F.relu(encoding[..., 7:])], -1))
        return results


@functools.lru_cache(maxsize=64)
def position_embedding(h, w, dim, aspect, ratio=0.1):
    """[dim, h, w]: sines and cosines of the place in the picture, u in the first half, v in the second."""
    diagonal = math.sqrt(aspect * aspect + 1)

    def axis(count, span):
        return torch.linspace(-span * (count - 1) / count, span * (count - 1) / count, count, dtype=torch.float64)

    omega = 100.0 ** (-torch.arange(dim // 4, dtype=torch.float64) / (dim / 4))
    u = axis(w, aspect / diagonal)[:, None] * omega
    v = axis(h, 1 / diagonal)[:, None] * omega
    u = torch.cat([u.sin(), u.cos()], -1)[None].expand(h, w, -1)
    v = torch.cat([v.sin(), v.cos()], -1)[:, None].expand(h, w, -1)
    return (ratio * torch.cat([u, v], -1)).permute(2, 0, 1).float()


class DptHead(FeatureExtractor):
    """Depth and its confidence (channels 2) or points and theirs (channels 4)."""

    def __init__(self, c, channels):
        features = c["dpt_features"]
        super().__init__(2 * c["embed_dim"], features, c["dpt_out_channels"])
        self.scratch.output_conv1 = nn.Conv2d(features, features // 2, 3, padding=1)
        hidden = c["dpt_head_features_2"]
        self.scratch.output_conv2 = nn.Sequential(
            nn.Conv2d(features // 2, hidden, 3, padding=1), nn.ReLU(), nn.Conv2d(hidden, channels, 1))
        self.ratio = c["dpt_pos_embed_ratio"]

    def placed(self, x, size):
        return x + position_embedding(x.shape[2], x.shape[3], x.shape[1], size[1] / size[0], self.ratio)

    def forward(self, taps, h, w, size):
        x = self.scratch.output_conv2(self.placed(super().forward(taps, h, w, size), size)).float()
        values, confidence = x[:, :-1], 1 + x[:, -1:].exp()
        if values.shape[1] == 1:
            return values.exp(), confidence
        return values.sign() * values.abs().expm1(), confidence


class StreamVggt(nn.Module):
    def __init__(self, c, point_head=False):
        super().__init__()
        self.aggregator = Aggregator(c)
        self.camera_head = CameraHead(c)
        self.depth_head = DptHead(c, 2)
        if point_head:
            self.point_head = DptHead(c, 4)
        self.c = c

    def clips(self, images, bf16=False, dense=None):
        """images: [B, S, 3, H, W] -> poses [B, S, iterations, 9] with the camera head's cache as in a
        stream, depth and confidence [B, S, H, W], and what every pair of blocks gave, [B, S, P, 2C] each. bf16:
        products of the aggregator and the depth head in bfloat16, for training on a CPU that has them.
        dense: the pictures b * S + s to give depth for, all of them if None; depth and confidence are then
        [n, H, W], empty for none."""
        c, (B, S, _, H, W) = self.c, images.shape
        h, w, special = H // c["patch_size"], W // c["patch_size"], 1 + c["num_register_tokens"]
        head_dim = c["embed_dim"] // c["agg_heads"]
        rope = Rope2d(h, w, head_dim, c["rope_freq"], special)
        frames_rope = Rope2d(h, w, head_dim, c["rope_freq"], special, S)
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            outputs = self.aggregator.clips(images, rope, frames_rope)
        outputs = [x.float() for x in outputs]
        caches = [[] for _ in self.camera_head.trunk]
        poses = [torch.cat(self.camera_head(outputs[-1][:, s, :1], caches), 1) for s in range(S)]
        taps = [outputs[i][:, :, special:].flatten(0, 1) for i in c["taps"]]
        shape = (B, S, H, W) if dense is None else (len(dense), H, W)
        if 0 in shape:
            nothing = images.new_empty(shape)
            return {"pose": torch.stack(poses, 1), "depth": nothing, "confidence": nothing, "blocks": outputs}
        with torch.autocast("cpu", torch.bfloat16, enabled=bf16):
            depth, confidence = self.depth_head(taps if dense is None else [x[dense] for x in taps], h, w, (H, W))
        return {"pose": torch.stack(poses, 1), "depth": depth.view(shape), "confidence": confidence.view(shape),
                "blocks": outputs}


class Stream:
    """Frames one at a time, keys and values kept after norm and rotary embedding."""

    def __init__(self, model, decoder=None, lap=lambda name: None):
        self.model, self.decoder, self.lap = model, decoder, lap
        self.caches = [[] for _ in model.aggregator.global_blocks]
        self.camera_caches = [[] for _ in model.camera_head.trunk]
        self.rope, self.frames = None, 0

    @torch.no_grad()
    def push(self, image):
        c, size = self.model.c, image.shape[2:]
        h, w = (s // c["patch_size"] for s in size)
        special = 1 + c["num_register_tokens"]
        if self.rope is None:
            self.rope = Rope2d(h, w, c["embed_dim"] // c["agg_heads"], c["rope_freq"], special)
        outputs = self.model.aggregator(image, self.caches, self.rope, self.frames == 0, self.lap)
        self.frames += 1
        pose = self.model.camera_head(outputs[-1][:, :1], self.camera_caches)
        self.lap("camera")
        taps = [outputs[i][:, special:] for i in c["taps"]]
        depth, confidence = self.model.depth_head(taps, h, w, tuple(size))
        self.lap("depth")
        language, rgb = self.decoder(taps, h, w) if self.decoder else (None, None)
        self.lap("decoder")
        return {"outputs": outputs, "pose": pose, "depth": depth, "confidence": confidence, "taps": taps,
                "language": language, "rgb": rgb}
