"""Motions in plain words."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from falsework.cli.velocity_text import describe, motions

CUBE = np.array([[x, y, z] for x in (-1, 1) for y in (-1, 1) for z in (-1, 1)], dtype=float)


def cubes(count: int) -> Any:
    centers = 4.0 * np.arange(count)[:, None] * np.array([1.0, 0.0, 0.0])
    meshes = tuple(SimpleNamespace(vertices=CUBE + center) for center in centers)
    names = tuple(str(part) for part in range(count))
    return SimpleNamespace(meshes=meshes, names=names, mass=SimpleNamespace(center=centers))


@pytest.mark.parametrize(
    ("velocity", "words"),
    [
        ((0, 0, -1, 0, 0, 0), "falls"),
        ((0, 0, 2, 0, 0, 0), "lifts"),
        ((1, 0, 0, 0, 0, 0), "slides towards +x"),
        ((0, -3, 0, 0, 0, 0), "slides towards -y"),
        ((1, 0, -1, 0, 0, 0), "slides down and towards +x"),
        ((1, -1, 0, 0, 0, 0), "slides towards +x and -y"),
        ((0, 0, 0, 0, 2, 0), "turns about +y"),
        ((0, 0, 0, 0, 0, -1), "turns about -z"),
        ((0, 0, -1, 0, 1, 0), "falls, turning about +y"),
        ((0, 0, -1, 0, 0.01, 0), "falls"),
        ((0, 0, -0.01, 1, 0, 1), "turns about the axis (+0.71, +0.00, +0.71)"),
    ],
)
def test_words(velocity: tuple[float, ...], words: str) -> None:
    (motion,) = motions(cubes(1), np.array([velocity], dtype=float))
    assert motion.words == words
    assert motion.speed == 1.0


def test_scale_does_not_matter() -> None:
    velocity = np.random.default_rng(0).standard_normal((3, 6))
    small, large = (describe(cubes(3), motions(cubes(3), scale * velocity)) for scale in (1e-9, 1e9))
    assert small == large


def test_parts_that_hardly_move_are_left_out_and_the_fastest_comes_first() -> None:
    velocity = np.zeros((4, 6))
    velocity[:, 2] = (-0.5, -0.001, 0.0, -1.0)
    assert [motion.part for motion in motions(cubes(4), velocity)] == [3, 0]


def test_nothing_moves() -> None:
    assert motions(cubes(2), np.zeros((2, 6))) == []


def test_long_lists_are_cut() -> None:
    velocity = np.tile([0, 0, -1.0, 0, 0, 0], (9, 1))
    text = describe(cubes(9), motions(cubes(9), velocity), limit=2)
    assert text == "part 0 falls; part 1 falls; and 7 more"
