#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""The Semantic Bridging Decoder and its objective in PyTorch: the same layers under
the same names as in the published checkpoints, so that a state_dict fits either side."""
import torch
import torch.nn as nn
import torch.nn.functional as F


def double_conv(cin, cout):
    layers = []
    for c in (cin, cout):
        layers += [nn.Conv2d(c, cout, 3, padding=1), nn.BatchNorm2d(cout), nn.ReLU(inplace=True)]
    return nn.Sequential(*layers)


class UNetEncoder(nn.Module):
    def __init__(self, features, hidden):
        super().__init__()
        cin = features
        for i in range(1, 5):
            cout = hidden << (i - 1)
            setattr(self, f"down{i}", double_conv(cin, cout))
            if i < 4:
                setattr(self, f"pool{i}", nn.Conv2d(cout, cout, 2, stride=2))
            cin = cout

    def forward(self, x):
        maps = []
        for i in range(1, 5):
            x = getattr(self, f"down{i}")(x)
            maps.append(x)
            if i < 4:
                x = getattr(self, f"pool{i}")(x)
        return maps


class UNetDecoder(nn.Module):
    def __init__(self, hidden, channels):
        super().__init__()
        for k in range(1, 4):
            c = hidden << (3 - k)
            setattr(self, f"up{k}", nn.ConvTranspose2d(2 * c, c, 2, stride=2))
            setattr(self, f"conv{k}", double_conv(2 * c, c))
        self.final_conv = nn.Conv2d(hidden, channels, 3, padding=1)

    def forward(self, maps):
        x = maps[3]
        for k in range(1, 4):
            skip = maps[3 - k]
            up = getattr(self, f"up{k}")(x)
            if up.shape[2:] != skip.shape[2:]:
                up = F.interpolate(up, skip.shape[2:], mode="bilinear", align_corners=False)
            x = getattr(self, f"conv{k}")(torch.cat([up, skip], 1))
        return self.final_conv(x)


class ResidualConvUnit(nn.Module):
    def __init__(self, features):
        super().__init__()
        self.conv1 = nn.Conv2d(features, features, 3, padding=1)
        self.conv2 = nn.Conv2d(features, features, 3, padding=1)

    def forward(self, x):
        r = F.relu(x)  # the release activates in place, so the skip is rectified too
        return self.conv2(F.relu(self.conv1(r), inplace=True)) + r


class FusionBlock(nn.Module):
    early_out_conv = False  # before the resize: the same function, cheaper

    def __init__(self, features, with_skip):
        super().__init__()
        self.out_conv = nn.Conv2d(features, features, 1)
        if with_skip:
            self.resConfUnit1 = ResidualConvUnit(features)
        self.resConfUnit2 = ResidualConvUnit(features)

    def forward(self, x, skip, size):
        if skip is not None:
            x = x + self.resConfUnit1(skip)
        x = self.resConfUnit2(x)
        if self.early_out_conv:
            return F.interpolate(self.out_conv(x), size, mode="bilinear", align_corners=True)
        return self.out_conv(F.interpolate(x, size, mode="bilinear", align_corners=True))


class FeatureExtractor(nn.Module):
    def __init__(self, dim, features, out_channels):
        super().__init__()
        self.norm = nn.LayerNorm(dim, eps=1e-5)
        self.projects = nn.ModuleList(nn.Conv2d(dim, c, 1) for c in out_channels)
        c = out_channels
        self.resize_layers = nn.ModuleList([
            nn.ConvTranspose2d(c[0], c[0], 4, stride=4), nn.ConvTranspose2d(c[1], c[1], 2, stride=2),
            nn.Identity(), nn.Conv2d(c[3], c[3], 3, stride=2, padding=1)])
        self.scratch = nn.Module()
        for i in range(4):
            setattr(self.scratch, f"layer{i + 1}_rn", nn.Conv2d(c[i], features, 3, padding=1, bias=False))
            setattr(self.scratch, f"refinenet{i + 1}", FusionBlock(features, i < 3))
        self.scratch.output_conv1 = nn.Conv2d(features, features, 3, padding=1)

    def placed(self, x, size):
        """x with what it should know of its place in the picture: nothing here."""
        return x

    def forward(self, taps, h, w, size):
        layers = []
        for i, tokens in enumerate(taps):
            x = self.norm(tokens).transpose(1, 2).reshape(tokens.shape[0], -1, h, w)
            x = self.placed(self.projects[i](x).float(), size)
            layers.append(getattr(self.scratch, f"layer{i + 1}_rn")(self.resize_layers[i](x)))
        x = layers[3]
        for i in (3, 2, 1, 0):
            to = layers[i - 1].shape[2:] if i else [2 * s for s in layers[0].shape[2:]]
            x = getattr(self.scratch, f"refinenet{i + 1}")(x, layers[i] if i < 3 else None, to)
        return F.interpolate(self.scratch.output_conv1(x), size, mode="bilinear", align_corners=True)


LEVELS = ("small", "middle", "large")


class Decoder(nn.Module):
    def __init__(self, dim=2048, features=128, out_channels=(256, 512, 1024, 1024), hidden=32, lang_dim=3):
        super().__init__()
        self.feature_extractor = FeatureExtractor(dim, features, out_channels)
        self.lang_encoder = UNetEncoder(features, hidden)
        self.rgb_encoder = UNetEncoder(features, hidden)
        for level in LEVELS:
            setattr(self, f"lang_decoder_{level}", UNetDecoder(hidden, lang_dim))
        self.rgb_decoder = nn.ModuleList([UNetDecoder(hidden, 3)])

    def forward(self, taps, h, w):
        x = self.feature_extractor(taps, h, w, (14 * h, 14 * w))
        maps = self.lang_encoder(x)
        language = torch.stack([getattr(self, f"lang_decoder_{level}")(maps) for level in LEVELS], 1)
        return language, torch.sigmoid(self.rgb_decoder[0](self.rgb_encoder(x)))


def objective(language, rgb, features, mask, images, weights=(0.2, 0.01, 0.5, 0.5), axis=2):
    """language, features: [B, levels, d, H, W]   mask: [B, levels, 1, H, W]"""
    a, b = language * mask, features * mask
    terms = ((a - b).abs().mean(), 1 - F.cosine_similarity(a, b, dim=axis).mean(),
             (rgb - images).abs().mean(), ((rgb - images) ** 2).mean())
    return sum(w * t for w, t in zip(weights, terms)), terms


def optimiser(model, lr, weight_decay=1e-4):
    groups = {True: [], False: []}
    for name, p in model.named_parameters():
        groups[p.ndim > 1 and not name.endswith(".bias")].append(p)
    return torch.optim.AdamW([{"params": groups[True], "weight_decay": weight_decay},
                              {"params": groups[False], "weight_decay": 0.0}],
                             lr=lr, betas=(0.9, 0.95), eps=1e-8)
