"""Long computations of plans with ways in several moves: each asks often enough whether it is to end."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from functools import cache
from itertools import zip_longest
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, PlannerSettings, StabilityOracle, StabilitySettings, find_plans, make_task
from falsework.geometry.clearance.table import StraightWays
from falsework.geometry.paths.path_search import PathSearch
from falsework.search.problem.deadline import DeadlineExceeded
from falsework.search.problem.task import Direction
from falsework.utils.interruption import interrupted_by
from tests.geometry.test_burrs import pelikan
from tests.geometry.test_exit_paths import motions_of, solid, structure
from tests.search.test_exit_paths import bolt
from tests.search.test_waiting import dodge

GAP = 0.5
"""Seconds of the processor between two questions at most, once kernels are compiled: numba cannot be interrupted."""
LONG = 1.0
"""Seconds of the processor after which a computation is ended here."""
RUNS = 4
"""Runs in which the same gap must be long: one in which a kernel is compiled, others on a busy machine."""
SETTINGS = StabilitySettings(criterion="equilibrium")


def burr(pieces: int = 7) -> Assembly:
    return structure(*(solid(cells, fixed=piece == 0) for piece, cells in enumerate(pelikan()[:pieces])))


@cache
def burr_with_ways() -> Assembly:
    """Six pieces of the burr with their table of straight ways."""
    assembly = burr(6)
    assembly.straight_ways.prepare()
    return assembly


def straight_ways() -> Callable[[], Any]:
    assembly = burr()
    return lambda: StraightWays(assembly.meshes, assembly.contacts, tolerance=1e-4).table


def pieces(turn: float, *, turns: bool = False) -> Callable[[], Any]:
    """A search for the way of a piece past the others that are held: by cells, or where these are turned by poses."""
    motions = motions_of(*map(solid, pelikan()), turn=turn)
    search = PathSearch(motions, (3,), np.arange(7) == 0, () if turns else (1, 2, 4, 5, 6))
    return lambda: search.run(99, turns=turns)


def screw() -> Callable[[], Any]:
    task = make_task(bolt(), 1, turns=True)
    assert task.clearance is not None
    task.clearance.prepare()
    return lambda: task.clearance and task.clearance.can_leave(task.start[None])


def waiting() -> Callable[[], Any]:
    assembly = dodge()
    task = make_task(assembly, 1, moves=4, waiting=True).judged_by(StabilityOracle(assembly, SETTINGS))
    assert task.clearance is not None
    task.clearance.prepare()
    return lambda: task.clearance and task.clearance.can_leave(np.array([[2, 1, 2]], dtype=np.uint8))


def sets() -> Callable[[], Any]:
    assembly = burr_with_ways()
    clearance = assembly.clearance_of_sets

    def ask() -> None:
        for parts in clearance.sets(~assembly.boundary, 3):
            clearance.leave_together(parts, np.ones((1, assembly.part_count), dtype=np.uint8), apart=True)

    return ask


KINDS = {
    "straight ways": straight_ways,
    "cells": lambda: pieces(0.0),
    "rigid poses": lambda: pieces(0.3),
    "turns of a piece": lambda: pieces(0.3, turns=True),
    "screw": screw,
    "waiting": waiting,
    "sets": sets,
}


def gaps(run: Callable[[], Any]) -> list[float]:
    """Seconds of the processor between the questions of a computation, which is ended where it is long."""
    times = [time.process_time()]

    def ask() -> None:
        times.append(time.process_time())
        if times[-1] - times[0] > LONG:
            raise DeadlineExceeded

    with interrupted_by(ask), suppress(DeadlineExceeded):
        run()
    return np.diff([*times, time.process_time()]).tolist()


@pytest.mark.parametrize("kind", KINDS)
def test_long_computations_ask_often_whether_they_are_to_end(kind: str) -> None:
    """Each run asks the same questions, so that a gap is as short as in its shortest run."""
    least: list[float] = []
    for _ in range(RUNS):
        least = list(map(min, zip_longest(least, gaps(KINDS[kind]()), fillvalue=np.inf)))
        if max(least) < GAP:
            return
    pytest.fail(f"{max(least):.2g} s of the processor after {int(np.argmax(least))} questions")


def test_a_deadline_ends_the_table_of_straight_ways_which_then_goes_on() -> None:
    """The search says that the deadline ended it; what the table has found by then is kept."""
    found = find_plans(burr(), robots=6, moves=99, stability=SETTINGS, start=np.full(7, 2), deadline=0.2)
    assert found.deadline_passed
    assert not found.found
    whole, assembly, asked, ended = burr(4).clearance, burr(4), 0, 0

    def ask() -> None:
        nonlocal asked, ended
        asked += 1
        if asked % 300 == 0:
            ended += 1
            raise DeadlineExceeded

    for _ in range(20):
        with interrupted_by(ask), suppress(DeadlineExceeded):
            assembly.straight_ways.prepare()
            break
    assert ended > 1
    np.testing.assert_array_equal(assembly.clearance.directions, whole.directions)
    np.testing.assert_array_equal(assembly.clearance.blockers, whole.blockers)


@pytest.mark.parametrize("moves", [1, 300])
def test_the_keyboard_ends_a_search_that_has_one_strategy(moves: int) -> None:
    """In the table of straight ways, and in a search for a way that is longer than a turn."""
    asked, assembly = 0, burr_with_ways() if moves > 1 else burr()

    def interrupt() -> None:
        nonlocal asked
        asked += 1
        if asked == moves:
            raise KeyboardInterrupt

    given: Any = {"settings": PlannerSettings(directions=(Direction.DISASSEMBLY,)), "stability": SETTINGS}
    with interrupted_by(interrupt, large=moves > 1):
        found = find_plans(assembly, robots=6, moves=99, start=np.full(assembly.part_count, 2), **given)
    assert asked == moves
    assert found.result.interrupted
    assert not found.deadline_passed
