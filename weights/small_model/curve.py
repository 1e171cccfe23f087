#!/usr/bin/env python3
# SPDX-License-Identifier: Apache-2.0
"""Draws a training's curve from its log: curve.py RUN/log.jsonl OUT.svg"""
import json
import sys

WIDTH, HEIGHT, MARGIN = 720, 320, 48


def path(points, color, x_end, y_end, wide):
    def place(x, y):
        return (f"{MARGIN + (WIDTH - 2 * MARGIN) * x / x_end:.1f} "
                f"{HEIGHT - MARGIN - (HEIGHT - 2 * MARGIN) * min(y, y_end) / y_end:.1f}")

    line = " L ".join(place(x, y) for x, y in points)
    return f'<path d="M {line}" fill="none" stroke="{color}" stroke-width="{wide}"/>'


def text(x, y, words, anchor="middle", color="#333"):
    return f'<text x="{x}" y="{y}" font-family="sans-serif" font-size="12" text-anchor="{anchor}" fill="{color}">{words}</text>'


def main():
    if len(sys.argv) != 3:
        sys.exit(__doc__)
    entries = [json.loads(line) for line in open(sys.argv[1])]
    trained = [(e["step"], e["depth"]) for e in entries if "depth" in e]
    held_out = [(e["step"], e["held_out"]["log_depth"]) for e in entries if "held_out" in e]
    stages = {}
    for e in entries:
        if "stage" in e:
            stages.setdefault(e["stage"], e["step"])
    x_end, y_end = max(x for x, _ in trained + held_out), 0.5
    parts = [f'<svg xmlns="http://www.w3.org/2000/svg" width="{WIDTH}" height="{HEIGHT}">',
             f'<rect width="{WIDTH}" height="{HEIGHT}" fill="white"/>']
    for tenth in range(6):
        y = HEIGHT - MARGIN - (HEIGHT - 2 * MARGIN) * tenth / 5
        parts.append(f'<path d="M {MARGIN} {y} H {WIDTH - MARGIN}" stroke="#ddd"/>')
        parts.append(text(MARGIN - 6, y + 4, f"{tenth / 10:.1f}", "end"))
    for first in list(stages.values())[1:]:
        x = MARGIN + (WIDTH - 2 * MARGIN) * first / x_end
        parts.append(f'<path d="M {x:.1f} {MARGIN} V {HEIGHT - MARGIN}" stroke="#999" stroke-dasharray="4 4"/>')
    parts += [path(trained, "#9bc", x_end, y_end, 1), path(held_out, "#c33", x_end, y_end, 2) if held_out else "",
              text(MARGIN, HEIGHT - MARGIN + 16, "0"), text(WIDTH - MARGIN, HEIGHT - MARGIN + 16, f"{x_end} steps"),
              text(WIDTH / 2, 24, "mean |log depth error|"), text(WIDTH - MARGIN, 24, "in training, as the loss weighs it", "end", "#69a"),
              text(WIDTH - MARGIN, 40, "unseen scenes, averaged weights", "end", "#c33"), "</svg>"]
    open(sys.argv[2], "w").write("\n".join(parts) + "\n")


if __name__ == "__main__":
    main()
