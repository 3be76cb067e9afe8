"""Cache of scenes: each query is computed once, and no result is returned for another query."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from falsework import Assembly
from falsework.robots import Cell, KeyframeGraph
from falsework.robots.motion.collision_world import NO_CONTACT, Attached, Scene
from falsework.robots.motion.path_planner import MotionCache, scene_digest


@pytest.fixture(scope="module")
def graph(column: Assembly, cell: Cell) -> KeyframeGraph:
    return KeyframeGraph(column, cell)


def carrying(scene: Scene, robot: int, part: int) -> Scene:
    carried: list[Attached | None] = [None] * len(scene.configurations)
    carried[robot] = Attached(part, np.eye(4))
    return replace(scene, attached=tuple(carried))


def test_scenes_that_differ_are_told_apart(graph: KeyframeGraph, cell: Cell) -> None:
    """By who carries what, in structures with more than 256 parts too, and by what lies elsewhere."""
    home = Scene.at_home(cell, graph.parts)
    lying = [replace(home, elsewhere=((part, np.eye(4)),)) for part in (1, 257)]
    held = [carrying(home, robot, part) for robot in (0, 1) for part in (1, 257)]
    other = home.with_configuration(1, home.configurations[1] + 0.1)
    digests = [scene_digest(scene, 0) for scene in (home, *lying, *held, other, home.with_removed(1))]
    assert len(set(digests)) == len(digests)
    assert scene_digest(home, 0) != scene_digest(home, 1)
    # Where the robot that moves is now says nothing of what it can run into.
    assert scene_digest(home.with_configuration(0, home.configurations[0] + 0.1), 0) == scene_digest(home, 0)


def test_a_view_is_made_once(graph: KeyframeGraph, cell: Cell) -> None:
    kept = MotionCache(graph.world, nodes=100, seed=0)
    home = Scene.at_home(cell, graph.parts)
    first = kept.view(home, 0, NO_CONTACT, 0.01)
    assert kept.view(home.with_configuration(0, home.configurations[0] + 0.1), 0, NO_CONTACT, 0.01) is first
    assert kept.view(carrying(home, 1, 1), 0, NO_CONTACT, 0.01) is not first
    assert kept.view(home, 0, NO_CONTACT, 0.02) is not first
    assert kept.views == 3
