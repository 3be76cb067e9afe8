"""Arch of voussoirs, whose first and last are supports."""

from __future__ import annotations

import math

from falsework_client import Block

FACES = [[0, 3, 2, 1], [4, 5, 6, 7], [0, 1, 5, 4], [1, 2, 6, 5], [2, 3, 7, 6], [3, 0, 4, 7]]
CUBE = [[0, 0, 0], [1, 0, 0], [1, 1, 0], [0, 1, 0], [0, 0, 1], [1, 0, 1], [1, 1, 1], [0, 1, 1]]


def arch(voussoirs: int = 7, scale: float = 1.0, thickness: float = 0.3) -> list[Block]:
    """Half a circle of inner radius 1 and depth 0.4, times a scale."""
    blocks = []
    for number in range(voussoirs):
        ring = []
        for y in (0.0, 0.4):
            for radius, turn in (
                (1.0, number),
                (1.0 + thickness, number),
                (1.0 + thickness, number + 1),
                (1.0, number + 1),
            ):
                angle = math.pi * turn / voussoirs
                ring.append([scale * radius * math.cos(angle), scale * y, scale * radius * math.sin(angle)])
        faces = [face[::-1] for face in FACES]
        blocks.append(Block(ring, faces, name=f"v{number}", support=number in (0, voussoirs - 1)))
    return blocks


def pair() -> list[Block]:
    """A block on a support, cubes of 1."""
    upper = [[x, y, z + 1] for x, y, z in CUBE]
    return [Block(upper, FACES, name="top"), Block(CUBE, FACES, name="base", support=True)]
