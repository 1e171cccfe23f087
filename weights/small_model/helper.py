# SPDX-License-Identifier: Apache-2.0
"""Only for training, not shipped: linear readings of the encoder's tokens, and what they should say. Without them a small
model learns depth from single pictures and never how the camera moved: nothing in its tokens says where a patch was before.

- the patch's own colours, from DINOv2's tokens: pictures can be compared only while they are still there
- from each global block's tokens, where in the first frame and in the frame before the patch was; the blocks' attention
  learns to look there, see matching.py
- from the same tokens and the camera token, how the camera has moved and turned since the first frame and the one before
- depth and points in the first camera, from the last block's tokens, before the dense head knows them
"""
import torch
import torch.nn as nn
import torch.nn.functional as F

import scenes
from matching import cells

CELLS = 4      # values along each side of a patch
FARTHEST = 6   # patches: a move that counts
MOTION = torch.tensor(([2.0] * 3 + [4.0] * 3) * 2)  # weights of shift and turn


class Helper(nn.Module):
    def __init__(self, config):
        super().__init__()
        C, self.step = config["embed_dim"], config["patch_size"]
        self.colour = nn.Linear(C, 3 * CELLS * CELLS)
        later = range(config["agg_depth"] - 1)
        self.back = nn.ModuleList(nn.Linear(2 * C, 4) for _ in later)
        self.motion = nn.ModuleList(nn.Linear(2 * C, 12) for _ in later)
        self.camera = nn.ModuleList(nn.Linear(2 * C, 12) for _ in later)
        self.read = nn.Linear(2 * C, 4 * CELLS * CELLS)
        for parameter in self.parameters():  # what the readings do not know yet does not disturb the tokens
            nn.init.zeros_(parameter)

    def watch(self, model):
        model.aggregator.patch_embed.register_forward_hook(lambda module, given, tokens: setattr(self, "seen", tokens))

    def loss(self, blocks, batch):
        """blocks: [B, S, P, 2C] of all pairs. The loss, and the error of the last one's ways back to the first frame in
        parts of their length."""
        B, S, H, W = batch["depth"].shape
        h, w = H // self.step, W // self.step
        patches = [x[:, :, -h * w:] for x in blocks]

        def pooled(x):
            """[B, S, c, H, W] -> [B * S, h * w, c * CELLS * CELLS]"""
            x = F.adaptive_avg_pool2d(x.flatten(0, 1), (h * CELLS, w * CELLS))
            return x.view(B * S, -1, h, CELLS, w, CELLS).permute(0, 2, 4, 1, 3, 5).reshape(B * S, h * w, -1)

        colour = (self.colour(self.seen.float()) - pooled(batch["images"])).abs().mean()
        log_depth, points = (pooled(x) for x in (batch["depth"].log()[:, :, None], batch["points"].permute(0, 1, 4, 2, 3)))
        depth, place = self.read(patches[-1].flatten(0, 1)).split([log_depth.shape[-1], points.shape[-1]], -1)
        distance = points.unflatten(-1, (3, -1)).norm(dim=-2).repeat(1, 1, 3).clamp(min=0.1)
        scene = (depth - log_depth).abs().mean() + ((place - points).abs() / distance).mean()
        if S == 1:
            return 0.3 * scene + 0.5 * colour, torch.ones(())
        first, before = [0] * (S - 1), list(range(S - 1))
        ways = torch.cat([ways_back(batch, self.step, to) for to in (first, before)], -1)
        motion = torch.cat([motion_since(batch, to) for to in (first, before)], -1)
        back = [(read(x[:, 1:]) - ways).abs() for read, x in zip(self.back, patches[1:])]
        votes = [(read(x[:, 1:]) - motion[:, :, None]).abs() for read, x in zip(self.motion[1:], patches[2:])]
        said = [(read(x[:, 1:, 0]) - motion).abs() for read, x in zip(self.camera[1:], blocks[2:])]
        moves = sum(0.08 * (x * MOTION).sum(-1).mean() for x in votes) + sum(0.15 * (x * MOTION).sum(-1).mean() for x in said)
        length = ways[..., :2].abs().mean().clamp(min=1e-3)
        return (0.3 * scene + 0.5 * colour + 0.7 * sum(x.mean() for x in back) + moves,
                back[-1][..., :2].mean() / length)


def motion_since(batch, frames):
    """Translation and the vector of the quaternion of each later frame's camera against that of the frame given for it:
    [B, S - 1, 6]."""
    rotation, translation = batch["rotation"], batch["translation"]
    turn = rotation[:, 1:] @ rotation[:, frames].mT
    shift = translation[:, 1:] - (turn @ translation[:, frames, :, None])[..., 0]
    return torch.cat([shift, torch.from_numpy(scenes.quaternions(turn.numpy())[..., :3])], -1).float()


def ways_back(batch, step, frames):
    """From the middle of each patch of a later frame to where it was in the frame given for it, in patches: [B, S - 1, h * w, 2]."""
    B, S, H, W = batch["depth"].shape
    h, w = H // step, W // step
    points = cells(batch["points"].permute(0, 1, 4, 2, 3), step).permute(0, 1, 3, 4, 2)[:, 1:]
    rotation, translation = batch["rotation"][:, frames].float(), batch["translation"][:, frames].float()
    points = torch.einsum("bsij,bshwj->bshwi", rotation, points) + translation[:, :, None, None]
    tangent = (batch["pose"][:, :1, None, None, 7:9] / 2).tan().flip(-1)  # width, height
    where = points[..., :2] / points[..., 2:].clamp(min=0.05) / tangent
    u, v = ((torch.arange(n) + 0.5) / n * 2 - 1 for n in (w, h))
    here = torch.stack(torch.broadcast_tensors(u[None, :], v[:, None]), -1)
    return ((where - here) * torch.tensor([w / 2, h / 2])).clamp(-FARTHEST, FARTHEST).view(B, S - 1, h * w, 2)
