"""The heuristic that prefers parts beside those that robots hold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from falsework import Direction, StabilityOracle, load_structure, make_task
from falsework.search import SupportGuide
from falsework.search.planner import Planner
from falsework.stability.settings import EQUILIBRIUM


def test_parts_beside_held_ones_come_first_in_assembly_only() -> None:
    assembly = load_structure("vault")
    base, task = SupportGuide(assembly), make_task(assembly, 3)
    guide = base.held_neighbours(task)
    assert guide is not None
    assert task.neighbours is not None
    movable = np.flatnonzero(~assembly.boundary)
    states = np.repeat(task.target[None], 3, axis=0)
    states[1, movable[4]] = states[2, movable[[4, 30]]] = 2
    actions = np.ones((3, 2 * assembly.part_count), dtype=bool)
    added = guide(states, actions, Direction.ASSEMBLY) - base(states, actions, Direction.ASSEMBLY)
    assert not added[:, : assembly.part_count].any()  # letting go of a part is not preferred
    beside = [added[row, assembly.part_count :] > 0 for row in range(3)]
    assert not beside[0].any()
    assert np.array_equal(beside[1], task.neighbours[movable[4]])
    assert np.array_equal(beside[2], task.neighbours[movable[[4, 30]]].any(axis=0))
    assert np.unique(added[added > 0].round(4)).size == 1
    down = Direction.DISASSEMBLY
    assert np.array_equal(guide(states, actions, down), base(states, actions, down))


def test_rows_and_unknown_contacts_leave_the_guide_as_it_is() -> None:
    rows = load_structure("vault:parts=125")
    assert SupportGuide(rows).held_neighbours(make_task(rows, 2)) is None
    arch = load_structure("arch")
    assert SupportGuide(arch).held_neighbours(replace(make_task(arch, 2), neighbours=None)) is None


def test_the_planner_uses_it_where_contact_histories_matter() -> None:
    arch = load_structure("arch")
    guide, task = SupportGuide(arch), make_task(arch, 2)
    state = task.target[None].copy()
    state[0, np.flatnonzero(~arch.boundary)[0]] = 2
    actions = np.ones((1, 2 * arch.part_count), dtype=bool)

    def differs(oracle: StabilityOracle) -> bool:
        used = Planner(task, oracle, guide=guide).beam_guide("assembly")
        assert used is not None
        return not np.array_equal(used(state, actions, Direction.ASSEMBLY), guide(state, actions, Direction.ASSEMBLY))

    assert differs(StabilityOracle(arch))
    assert not differs(StabilityOracle(arch, EQUILIBRIUM))
