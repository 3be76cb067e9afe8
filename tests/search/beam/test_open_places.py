"""Parts that do not stand where they come last, and the places that beams leave open for them."""

from __future__ import annotations

from itertools import product
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from falsework.assembly import Assembly, load_structure
from falsework.assembly.state import States
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.search import Direction, Task
from falsework.search.beam.beam import BeamSearch
from falsework.search.beam.frontier import expand
from falsework.search.beam.open_places import OpenPlaces, cannot_come_last
from falsework.search.beam.settings import BeamSettings
from falsework.search.find import task_of
from falsework.search.problem.hashing import StateHash
from falsework.stability import Stability, StabilitySettings
from falsework.stability.contact.replay import History, Replay, Replayer

_RING = [(1, 2), (2, 3), (3, 4), (4, 1), (5, 1), (5, 2), (5, 3)]
"""Part 5 touches three of a ring of four parts; part 0 is the ground."""
_FACES = [
    *[(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)],
    *[(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)],
]
"""Triangles of a box whose corners are counted in binary."""


def parts_of(assembly: Assembly, robots: int = 2) -> list[int]:
    oracle = Stability(assembly)
    assert oracle.replayer is not None
    return cannot_come_last(task_of(assembly, robots), oracle, oracle.replayer.problem).tolist()


def row_of_boxes() -> Assembly:
    """A box between two others, above the ground: nothing presses on it."""
    lows = {"ground": (-2.0, 0.0, -1.0), "left": (-1.0, 0.0, 0.0), "between": (0.0, 0.0, 0.5), "right": (1.0, 0.0, 0.0)}
    sizes = {"ground": (5.0, 1.0, 1.0), "between": (1.0, 1.0, 0.5)}
    corners = np.array(list(product((0.0, 1.0), repeat=3)))
    meshes = [
        TriangleMesh.from_arrays(name, low + corners * sizes.get(name, (1.0, 1.0, 1.0)), _FACES)
        for name, low in lows.items()
    ]
    return Assembly.from_meshes(meshes, boundary=[0])


def test_what_hangs_between_parts_that_do_not_press_on_it_cannot_come_last() -> None:
    assert parts_of(row_of_boxes()) == [2]


def test_the_replay_agrees_where_the_neighbours_are_held() -> None:
    assembly = load_structure("vault")
    replayer, released = Replayer(assembly), []
    for part in np.flatnonzero(~assembly.boundary).tolist():
        states = np.full((2, assembly.part_count), 2, dtype=np.uint8)
        states[1, part] = 1
        if not replayer.replay(states).good:
            released.append(part)
    assert released
    assert parts_of(assembly) == released


def test_structures_with_rows_behind_free_arches_are_left_out() -> None:
    assert parts_of(load_structure("vault:parts=125"), 3) == []


def frontier_of(state: list[int], robots: int = 3) -> Any:
    task = Task.create([True, *[False] * 5], robots, contacts=_RING)
    level = np.array([state], dtype=np.uint8)
    return task, expand(task, Direction.ASSEMBLY, level, StateHash.for_parts(6))


@pytest.mark.parametrize("value", [1, 2])
def test_the_last_place_beside_an_absent_part_stays_open(value: int) -> None:
    task, frontier = frontier_of([2, value, 1, 0, 0, 0])
    assert OpenPlaces(task.neighbours, np.array([5])).keep(frontier)
    fixed = frontier.part(np.flatnonzero(frontier.fixing)).tolist()
    assert sorted(fixed) == [4, 5]
    assert sorted(frontier.part(frontier.candidates())) == sorted(fixed + [1] * (value == 2))


@pytest.mark.parametrize("state", [[2, 1, 0, 0, 0, 0], [2, 1, 1, 0, 0, 1], [2, 1, 1, 0, 0, 2], [2, 1, 1, 1, 0, 0]])
def test_nothing_is_left_out_where_no_place_is_closed(state: list[int]) -> None:
    task, frontier = frontier_of(state)
    before = frontier.moves.copy(), frontier.fixing.copy()
    assert not OpenPlaces(task.neighbours, np.array([5])).keep(frontier)
    assert np.array_equal(frontier.moves, before[0])
    assert np.array_equal(frontier.fixing, before[1])


def test_places_are_closed_where_no_other_part_can_be_fixed() -> None:
    # Parts 3 and 5 are left; each closes the place of the other.
    task, frontier = frontier_of([2, 1, 1, 0, 1, 0])
    before = frontier.moves.copy()
    assert not OpenPlaces(task.neighbours, np.array([3, 5])).keep(frontier)
    assert np.array_equal(frontier.moves, before)


class LastPartReplayer:
    """Part 5 falls when a robot lets go of it, if it was inserted after all parts beside it."""

    problem: Any = SimpleNamespace(parts=1, points=1, part_a=np.array([0]), part_b=np.array([1]))
    settings = StabilitySettings()

    def replay(self, states: Any, history: History | None = None) -> Replay:
        zeros = np.zeros(1)
        return Replay(np.ones(1, np.int8), zeros, zeros.astype(np.int32), zeros, 1.0, (self.history(0.0),))

    def step(self, history: History, before: States, after: States) -> tuple[bool, History]:
        last = history.moved
        if before[5] == 0 and after[5] == 2:
            last = float((after[[1, 2, 3]] > 0).all())
        return not (after[5] == 1 and last > 0), self.history(last)

    @staticmethod
    def history(last: float) -> History:
        return History(np.zeros((1, 6)), np.zeros((1, 3)), np.zeros(1, bool), np.zeros(1, np.int32), last, 0)


def test_a_beam_inserts_such_a_part_before_its_last_neighbour(rules: Any) -> None:
    oracle, _ = rules.random(3, 6)
    oracle.stands = lambda state: not (state[5] == 1 and all(value == 2 for value in state[:5]))
    oracle.replayer = LastPartReplayer()
    task = Task.create(rules.ground(6), 2, contacts=_RING)

    def last_of_all(states: States, actions: Any, direction: Direction) -> Any:
        return np.tile(np.where(np.arange(12) % 6 == 5, -1.0, 0.0), (len(states), 1))

    search = BeamSearch(
        task, oracle, BeamSettings(width=1, diversity="none", lookahead=4, commit=True, retries=0), guide=last_of_all
    )
    result = search.run()
    assert result.found
    inserted = (result.routes[0].states[::-1] > 0).argmax(axis=0)
    assert inserted[5] < max(inserted[[1, 2, 3]])
    assert not search.exhaustive
