# SPDX-License-Identifier: Apache-2.0
"""What the authors' release does in a streamed frame and our definition of the model (weights/pytorch) spares itself: the
cache has keys as they came, and each frame normalises and rotates all of them once more, a half of a head at a time;
sines and cosines of every pixel's place are computed anew. The results are the same."""
import math

import torch
import torch.nn.functional as F

import torch_geometry


class Rope(torch_geometry.Rope2d):
    """Tables by position, looked up for every token."""

    def __init__(self, h, w, head_dim, base=100.0, special=5):
        super().__init__(h, w, head_dim, base, special)
        rows, columns = torch.meshgrid(torch.arange(h) + 1, torch.arange(w) + 1, indexing="ij")
        places = torch.stack([rows, columns], -1).flatten(0, 1)
        self.positions = torch.cat([torch.zeros(special, 2, dtype=torch.long), places])
        self.tables = torch_geometry.rope_tables(torch.arange(max(h, w) + 1), head_dim // 2, base)


def rotate(tokens, rope, frames):
    """tokens: [B, heads, N, D] of so many frames in a row."""
    halves = []
    for half, place in zip(tokens.chunk(2, -1), rope.positions.repeat(frames, 1).unbind(-1)):
        cos, sin = (F.embedding(place, table) for table in rope.tables)
        first, second = half.chunk(2, -1)
        halves.append(half * cos + torch.cat([-second, first], -1) * sin)
    return torch.cat(halves, -1)


def attention(self, x, rope=None, cache=None, mask=None):
    """Attention.forward of a streamed frame. cache: [] or [(keys, values)] of all frames, [B, heads, frames, N, D]."""
    B, N, C = x.shape
    q, k, v = self.qkv(x).reshape(B, N, 3, self.heads, C // self.heads).permute(2, 0, 3, 1, 4).unbind(0)
    frames = 1
    if cache is not None:
        k, v = k[:, :, None], v[:, :, None]
        if cache:
            k, v = (torch.cat([past, new], 2) for past, new in zip(cache[0], (k, v)))
        cache[:] = [(k, v)]
        frames = k.shape[2]
        k, v = k.flatten(2, 3), v.flatten(2, 3)
    q, k = self.q_norm(q), self.k_norm(k)
    if rope is not None:
        q, k = rotate(q, rope, 1), rotate(k, rope, frames)
    weights = ((q * q.shape[-1] ** -0.5) @ k.transpose(-2, -1)).softmax(-1)
    return self.proj((weights @ v).transpose(1, 2).reshape(B, N, C))


def position_embedding(h, w, dim, aspect, ratio=0.1):
    """[dim, h, w], pixel by pixel."""
    diagonal = math.sqrt(aspect * aspect + 1)
    spans = [(w, aspect / diagonal), (h, 1 / diagonal)]
    axes = [torch.linspace(-span * (n - 1) / n, span * (n - 1) / n, n) for n, span in spans]
    omega = 100.0 ** (-torch.arange(dim // 4, dtype=torch.float64) / (dim / 4))
    angles = [place.reshape(-1, 1) * omega for place in torch.meshgrid(*axes, indexing="xy")]
    table = torch.cat([f(a) for a in angles for f in (torch.sin, torch.cos)], -1).float()
    return ratio * table.view(h, w, dim).permute(2, 0, 1)


def use():
    """From now on the model takes these steps."""
    torch_geometry.Rope2d = Rope
    torch_geometry.Attention.forward = attention
    torch_geometry.position_embedding = position_embedding
