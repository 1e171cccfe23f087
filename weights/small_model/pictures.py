# SPDX-License-Identifier: Apache-2.0
"""PNG files of 8-bit RGB, and resizing as the engine's preprocessing does it, with NumPy and PyTorch only."""
import struct
import zlib

import numpy as np
import torch
import torch.nn.functional as F


def read_png(path):
    """[H, W, 3] bytes; 8-bit RGB without interlace."""
    data = open(path, "rb").read()
    if data[:8] != b"\x89PNG\r\n\x1a\n":
        raise ValueError(f"{path}: not a PNG file")
    at, packed, header = 8, b"", None
    while at < len(data):
        size, kind = struct.unpack(">I4s", data[at:at + 8])
        body = data[at + 8:at + 8 + size]
        if kind == b"IHDR":
            header = struct.unpack(">IIBBBBB", body)
        elif kind == b"IDAT":
            packed += body
        at += 12 + size
    width, height, bits, color, _, _, interlace = header
    if (bits, color, interlace) != (8, 2, 0):
        raise ValueError(f"{path}: only 8-bit RGB without interlace is read")
    lines = np.frombuffer(zlib.decompress(packed), np.uint8).reshape(height, 1 + 3 * width)
    out = np.zeros((height, width, 3), np.int32)
    above = np.zeros((width, 3), np.int32)
    for y in range(height):
        out[y] = above = unfilter(int(lines[y, 0]), lines[y, 1:].reshape(width, 3).astype(np.int32), above)
    return out.astype(np.uint8)


def unfilter(kind, line, above):
    if kind == 0:
        return line
    if kind == 1:
        return np.cumsum(line, 0) & 255
    if kind == 2:
        return (line + above) & 255
    out = np.zeros_like(line)
    left = corner = np.zeros(3, np.int32)
    for x in range(len(line)):
        up = above[x]
        if kind == 3:
            guess = (left + up) // 2
        else:
            p = left + up - corner
            a, b, c = abs(p - left), abs(p - up), abs(p - corner)
            guess = np.where((a <= b) & (a <= c), left, np.where(b <= c, up, corner))
        left, corner = (line[x] + guess) & 255, up
        out[x] = left
    return out


def write_png(path, image):
    """image: [H, W, 3] bytes"""
    height, width = image.shape[:2]
    lines = np.concatenate([np.zeros((height, 1), np.uint8), image.reshape(height, -1)], 1).tobytes()

    def chunk(kind, body):
        return struct.pack(">I", len(body)) + kind + body + struct.pack(">I", zlib.crc32(kind + body))

    with open(path, "wb") as file:
        file.write(b"\x89PNG\r\n\x1a\n" + chunk(b"IHDR", struct.pack(">IIBBBBB", width, height, 8, 2, 0, 0, 0))
                   + chunk(b"IDAT", zlib.compress(lines)) + chunk(b"IEND", b""))


def resized(image, height, width):
    """[H, W, 3] bytes -> [3, height, width] in [0, 1], every value k / 255."""
    x = torch.from_numpy(image).permute(2, 0, 1)[None].float()
    x = F.interpolate(x, (height, width), mode="bicubic", antialias=True)
    return (x.round().clamp(0, 255) / 255)[0].numpy()
