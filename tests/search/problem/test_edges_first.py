"""Rows behind free edges, and the heuristic that closes these first."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from falsework import (
    Assembly,
    Direction,
    StabilityOracle,
    StabilitySettings,
    find_plans,
    load_structure,
    make_task,
)
from falsework.assembly import complete_state
from falsework.search import SupportGuide
from falsework.search.planner import Planner
from falsework.search.problem.guide import edge_rows
from falsework.stability.settings import EQUILIBRIUM

_LENGTH, _COURSES = 12, 13


def _shell(*, supports: tuple[int, ...], closed: bool = False) -> tuple[np.ndarray, np.ndarray]:
    """Return contacts and supports of a shell of staggered courses; `closed` courses are rings."""
    pairs = []
    for course in range(_COURSES):
        for place in range(_LENGTH):
            own = course * _LENGTH + place
            beside = [(course, place + 1), (course + 1, place), (course + 1, place + (1 if course % 2 else -1))]
            for row, column in beside:
                if row < _COURSES and (closed or 0 <= column < _LENGTH):
                    pairs.append((own, row * _LENGTH + column % _LENGTH))
    boundary = np.zeros(_COURSES * _LENGTH, dtype=bool)
    boundary[list(supports)] = True
    return np.array(pairs), boundary


def test_rows_count_contacts_from_the_edges_of_a_shell() -> None:
    corners = (0, _LENGTH - 1, (_COURSES - 1) * _LENGTH, _COURSES * _LENGTH - 1)
    rows = edge_rows(*_shell(supports=corners))
    assert rows is not None
    course, place = np.divmod(np.arange(len(rows)), _LENGTH)
    inner = ~_shell(supports=corners)[1]
    expected = np.minimum.reduce([course, _COURSES - 1 - course, place, _LENGTH - 1 - place])
    assert np.array_equal(rows[inner], expected[inner])


def test_an_edge_between_fewer_than_two_supports_is_no_arch() -> None:
    assert edge_rows(*_shell(supports=(0,))) is None
    assert edge_rows(*_shell(supports=tuple(range(_LENGTH)), closed=True)) is None


def test_a_wall_has_no_rows() -> None:
    arch = load_structure("arch")
    assert edge_rows(*_contacts(arch)) is None


def _contacts(assembly: Assembly) -> tuple[np.ndarray, np.ndarray]:
    return assembly.contacts.parts, assembly.boundary


def _check_rows_in_order(states: np.ndarray, vault: Assembly) -> None:
    placed = (states != 0).argmax(axis=0)
    rows = edge_rows(*_contacts(vault))
    assert rows is not None
    free = ~vault.boundary
    means = [placed[free & (rows == row)].mean() for row in range(rows.max() + 1)]
    assert (np.subtract(means[2:], means[:-2]) > 0).all()  # neighbouring rows may be built together


@pytest.fixture(scope="module")
def vault() -> Assembly:
    return load_structure("vault:parts=80")


def test_parts_at_edges_are_inserted_first_and_removed_last(vault: Assembly) -> None:
    base, task = SupportGuide(vault), make_task(vault, 3)
    guide, rows = base.edges_first(task), edge_rows(*_contacts(vault))
    assert guide is not None
    assert rows is not None
    state = complete_state(vault.boundary)[None]
    actions = np.ones((1, 2 * vault.part_count), dtype=bool)
    added = guide(state, actions, Direction.ASSEMBLY) - base(state, actions, Direction.ASSEMBLY)
    assert np.array_equal(added[0, : vault.part_count], added[0, vault.part_count :])
    assert all(np.unique(added[0, : vault.part_count][rows == row]).size == 1 for row in range(rows.max() + 1))
    assert (np.diff([added[0, np.flatnonzero(rows == row)[0]] for row in range(rows.max() + 1)]) < 0).all()
    back = guide(state, actions, Direction.DISASSEMBLY) - base(state, actions, Direction.DISASSEMBLY)
    assert np.allclose(back, -added, atol=1e-5)


def test_one_robot_and_standing_parts_leave_the_guide_as_it_is(vault: Assembly) -> None:
    guide = SupportGuide(vault)
    assert guide.edges_first(make_task(vault, 1)) is None
    assert guide.edges_first(make_task(vault, 2)) is not None
    target = complete_state(vault.boundary)
    target[np.flatnonzero(~vault.boundary)[3:]] = 0
    assert guide.edges_first(make_task(vault, 3, target=target)) is None


def test_under_equilibrium_most_parts_wait_for_the_rows_before() -> None:
    vault = load_structure("vault:parts=350")
    planning = find_plans(vault, robots=2, oracle=StabilityOracle(vault, EQUILIBRIUM), forces=False)
    assert planning.found
    placed, rows = (planning.plans[0].states != 0).argmax(axis=0), edge_rows(*_contacts(vault))
    assert rows is not None
    free = np.flatnonzero(~vault.boundary)
    order = rows[free[np.argsort(placed[free])]]
    behind = np.maximum.accumulate(order) - order
    assert (behind <= 1).mean() > 0.6  # 0.4 with four times as many states ahead


@pytest.mark.parametrize("robots", [2, 3])
def test_resuming_a_search_from_the_edges_changes_nothing(vault: Assembly, robots: int, tmp_path: Path) -> None:
    """With three robots the replay is part of the search, and the vault is built row by row."""
    oracle = StabilityOracle(vault, EQUILIBRIUM if robots == 2 else StabilitySettings())
    task, guide = make_task(vault, robots).judged_by(oracle), SupportGuide(vault)
    expected = Planner(task, oracle, guide=guide).run()
    assert expected.found
    if robots == 3:
        _check_rows_in_order(expected.routes[0].states[::-1], vault)
    planner, path = Planner(task, oracle, guide=guide), tmp_path / "planner.npz"
    calls = iter(range(60))
    assert planner.run(stop=lambda: next(calls, None) is None).interrupted
    planner.save(path)
    result = Planner.load(path, task, oracle, guide=guide).run()
    assert np.array_equal(result.routes[0].states, expected.routes[0].states)
