"""Repair of contact forces near a change: what it finds is a proof, and what it leaves is decided as before."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, Verdict, verify_certificates
from falsework.assembly import HELD, INSTALLED, REMOVED, complete_state
from falsework.stability.cpu.neighbourhood import extend_region, freeze_outside_ball, freeze_outside_corridor
from falsework.stability.cpu.repair import repair_range
from falsework.stability.cpu.solver import CpuSolver, kernel_options
from falsework.stability.problem import build_problem
from falsework.stability.settings import EQUILIBRIUM


@pytest.mark.parametrize("interior", [True, False])
@pytest.mark.parametrize("reach", [2, 1, 0])
def test_repaired_forces_prove_the_state(
    vault: Assembly, released: tuple[NDArray, NDArray], reach: int, interior: bool
) -> None:
    """Whether they change around the difference, along ways from there to a support, or everywhere."""
    states, before = released
    solver = CpuSolver(build_problem(vault))
    known = solver.check(before)
    verdict, residual = np.zeros(len(states), np.int8), np.full(len(states), np.nan)
    counts = np.zeros(len(states), np.int32)
    assert known.forces is not None
    forces = known.forces.copy()
    kernel = (
        solver.structure,
        states,
        before,
        known.stable,
        reach,
        interior,
        kernel_options(EQUILIBRIUM),
    )
    left = repair_range(*kernel, forces, verdict, residual, counts)
    good = np.flatnonzero(verdict == Verdict.STABLE)
    assert len(good) == len(states) - left > 0
    checked = solver.check(states)[good]
    assert checked.forces is not None
    checked.forces[:] = forces[good]
    assert verify_certificates(vault, states[good], checked, EQUILIBRIUM.claim).all()
    changed = (forces[good] != known.forces[good]).any(axis=2)
    if reach:
        assert (changed.sum(axis=1) < changed.shape[1]).any()  # forces farther away are those of before


@pytest.mark.usefixtures("interpreted")
def test_corridors_lead_from_the_change_to_a_support(vault: Assembly, released: tuple[NDArray, NDArray]) -> None:
    states, before = released
    structure, near = CpuSolver(build_problem(vault)).structure, np.empty(states.shape[1], np.uint8)
    links = [set[int]() for _ in near]
    for a, b in structure.pair_parts.tolist():
        links[a].add(b)
        links[b].add(a)
    for state, parent in zip(states, before, strict=True):
        kept, free = freeze_outside_corridor(structure, state, parent, 0, near)
        assert free == (state == INSTALLED).sum()
        corridor = set(np.flatnonzero(near == INSTALLED).tolist())
        assert len(corridor) == kept
        ahead = reached = set(np.flatnonzero(state != parent).tolist())
        while ahead:
            ahead = {other for part in ahead for other in links[part] & corridor} - reached
            reached = reached | ahead
        assert reached == corridor
        assert any(vault.boundary[other] for part in reached for other in links[part])


@pytest.mark.usefixtures("interpreted")
def test_the_last_region_is_what_the_other_solvers_decide_on(
    vault: Assembly, released: tuple[NDArray, NDArray]
) -> None:
    states, before = (some.copy() for some in released)
    problem = build_problem(vault)
    structure, near = CpuSolver(problem).structure, np.empty(states.shape[1], np.uint8)
    rows = np.flatnonzero(~vault.boundary)[::3]  # held, these divide the others into pieces
    for some in (states, before):
        some[:, rows] = np.where(some[:, rows] == INSTALLED, HELD, some[:, rows])
    apart = problem.hold_apart(states, before)
    assert (apart != states).any()
    for state, parent, expected in zip(states, before, apart, strict=True):
        if (state != parent).any():
            freeze_outside_ball(structure, state, parent, len(state), near)
            np.testing.assert_array_equal(near, expected)


def test_regions_are_extended_where_they_press(
    vault: Assembly, released: tuple[NDArray, NDArray], request: pytest.FixtureRequest
) -> None:
    states, before = released
    solver = CpuSolver(build_problem(vault))
    structure, forces = solver.structure, solver.check(before).forces
    assert forces is not None
    request.getfixturevalue("interpreted")
    region, near, wider = np.empty((3, states.shape[1]), np.uint8)
    velocity = np.zeros((len(structure.elimination.order), 6))
    velocity[:, 2] = -1.0
    for state, parent, force in zip(states, before, forces, strict=True):
        kept, _ = freeze_outside_corridor(structure, state, parent, 0, region)
        near[:], wider[:] = region, region
        more = extend_region(structure, state, near, velocity, force, 1)
        assert more == (near == INSTALLED).sum() >= kept
        assert ((near == region) | ((near == INSTALLED) & (state == INSTALLED))).all()
        assert (wider == region).all()
        assert extend_region(structure, state, wider, velocity, force, 2) >= more
        assert (near != INSTALLED)[wider != INSTALLED].all()
        pairs = structure.pair_parts
        inside, added = region[pairs] == INSTALLED, (near != region)[pairs]
        assert set(pairs[added & inside[:, ::-1]]) == set(np.flatnonzero(near != region))
        assert extend_region(structure, state, region, velocity, 0.0 * force, 1) == kept  # nothing is pressed


@pytest.mark.usefixtures("interpreted")
@pytest.mark.usefixtures("interpreted")
def test_corridors_lead_to_a_held_part_where_none_leads_to_a_support(vault: Assembly) -> None:
    structure, near = CpuSolver(build_problem(vault)).structure, np.empty(vault.part_count, np.uint8)
    parent = complete_state(vault.boundary)
    loose = ~vault.boundary
    at_supports = np.zeros(vault.part_count, dtype=bool)
    for a, b in structure.pair_parts.tolist():
        at_supports[[a, b]] |= vault.boundary[[b, a]]
    parent[at_supports & loose] = REMOVED
    carried, held = np.flatnonzero(parent == INSTALLED)[[0, -1]]
    parent[[carried, held]] = HELD
    state = parent.copy()
    state[carried] = INSTALLED
    kept, free = freeze_outside_corridor(structure, state, parent, 0, near)
    assert 0 < kept < free
    pairs = structure.pair_parts
    inside = near[pairs] == INSTALLED
    assert ((pairs == held) & inside[:, ::-1]).any()


def test_forces_of_another_state_do_not_mislead(vault: Assembly, released: tuple[NDArray, NDArray]) -> None:
    states, before = released
    oracle = StabilityOracle(vault, EQUILIBRIUM)
    oracle.verdicts(before, require_certificate=True)
    found = oracle.verdicts(states, near=before[::-1].copy(), require_certificate=True)
    assert (
        found.verdict == StabilityOracle(vault, EQUILIBRIUM).verdicts(states, require_certificate=True).verdict
    ).all()
    assert verify_certificates(vault, states, found, EQUILIBRIUM.claim).all()


def test_forces_are_passed_on_by_holds(vault: Assembly) -> None:
    oracle, complete = StabilityOracle(vault, EQUILIBRIUM), complete_state(vault.boundary)
    held = np.repeat(complete[None], 3, axis=0)
    parts = np.flatnonzero(complete == INSTALLED)[[0, 5, 9]]
    for row in range(3):
        held[row, parts[: row + 1]] = HELD
    assert oracle.verdicts(complete[None], near=complete[None]).stable.all()
    found = oracle.verdicts(held, near=held, require_certificate=True)
    assert found.stable.all()
    assert (found.iterations == 0).all()


def test_forces_are_kept_as_they_were_accepted(vault: Assembly) -> None:
    oracle, complete = StabilityOracle(vault, EQUILIBRIUM), complete_state(vault.boundary)
    assert oracle.verdicts(complete[None], near=complete[None]).stable.all()
    kept = oracle.guesses.memory.get(complete.tobytes())
    assert kept is not None
    assert (kept != kept.astype(np.float32)).any()  # rounded, they may leave parts out of balance
    again = oracle.verdicts(complete, near=complete, require_certificate=True)
    assert again.forces is not None
    assert again.iterations[0] == 0
    assert np.abs(again.forces[0] - kept).max() <= 1e-12 * np.abs(kept).max()


def test_parts_that_touch_nothing_present_are_left_open(vault: Assembly) -> None:
    """A guess for a state whose free part has no neighbour left: no force can balance it, and nothing fails."""
    state = np.where(vault.boundary, HELD, REMOVED).astype(np.uint8)
    inside = ~vault.boundary
    for pair in vault.contacts.parts[vault.boundary[vault.contacts.parts].any(axis=1)]:
        inside[pair] = False
    state[np.flatnonzero(inside)[0]] = INSTALLED
    solver = CpuSolver(build_problem(vault))
    guess = np.ones((1, solver.problem.points, 3))
    parent = np.where(state == INSTALLED, HELD, state).astype(np.uint8)
    found = solver.check(state[None], certificates=False, parents=parent[None], guess=guess)
    assert not found.stable[0]
    assert StabilityOracle(vault, EQUILIBRIUM).verdicts(state, require_certificate=True).unstable[0]
