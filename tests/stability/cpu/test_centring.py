"""Forces inside their cones: they change near a difference only, prove states, and mislead no verdict."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, Verdict, verify_certificates
from falsework.assembly import HELD, INSTALLED, REMOVED, Joints, complete_state
from falsework.stability import Verdicts
from falsework.stability.cpu import solver as cpu_solver
from falsework.stability.cpu.repair import repair_range
from falsework.stability.cpu.solver import CpuSolver, kernel_options
from falsework.stability.problem import build_problem
from falsework.stability.settings import EQUILIBRIUM, Cone

Found = tuple[NDArray[np.bool_], NDArray[np.float64]]


def _centre(solver: CpuSolver, states: NDArray, parents: NDArray, forces: NDArray) -> Found:
    verdict, residual = np.zeros(len(states), np.int8), np.full(len(states), np.nan)
    counts, out = np.zeros(len(states), np.int32), forces.copy()
    known = np.ones(len(states), dtype=bool)
    kernel = solver.structure, states, parents, known, solver.reach, True, kernel_options(EQUILIBRIUM)
    repair_range(*kernel, out, verdict, residual, counts)
    return verdict == Verdict.STABLE, out


def _with_forces(vault: Assembly, states: NDArray, forces: NDArray) -> Verdicts:
    checked = StabilityOracle(vault, EQUILIBRIUM).verdicts(states, require_certificate=True)
    assert checked.forces is not None
    checked.forces[:] = forces
    return checked


def test_centred_forces_prove_the_state_and_the_next(
    vault: Assembly, released: tuple[NDArray[np.uint8], NDArray[np.uint8]]
) -> None:
    states, before = released
    solver = CpuSolver(build_problem(vault))
    known = solver.check(before)
    assert known.forces is not None
    good, forces = _centre(solver, states, before, known.forces)
    assert good.any()
    assert verify_certificates(
        vault, states[good], _with_forces(vault, states[good], forces[good]), EQUILIBRIUM.claim
    ).all()
    # They lie inside their cones, on which most of those from ADMM lie.
    friction = solver.structure.friction
    side = np.hypot(forces[good][..., 1], forces[good][..., 2])
    assert (forces[good][..., 0] > 0).mean() > 0.9
    assert (side <= friction * forces[good][..., 0] * (1 + 1e-9)).all()
    # From them, what follows when a part is taken away is often local.
    state = states[np.flatnonzero(good)[0]]
    parts = np.flatnonzero(state == INSTALLED)
    parents = np.repeat(state[None], len(parts), axis=0)
    after = parents.copy()
    after[np.arange(len(parts)), parts] = REMOVED
    start = np.repeat(forces[good][:1], len(parts), axis=0)
    stands, moved = _centre(solver, after, parents, start)
    assert stands.any()
    assert (
        StabilityOracle(vault, EQUILIBRIUM).verdicts(after, require_certificate=True).verdict[stands] == Verdict.STABLE
    ).all()
    assert ((moved != start).any(axis=2)[stands].mean(axis=1) < 0.5).any()


@pytest.mark.parametrize("cone", ["octagon", "quadratic"])
@pytest.mark.parametrize("glued", [True, False])
def test_verdicts_along_random_orders_are_the_same(vault: Assembly, cone: Cone, glued: bool) -> None:
    """Also where contacts pull, so that forces are not kept inside their cones."""
    vault = vault.replace(joints=Joints.from_arrays(vault.contacts, tension=1.0)) if glued else vault
    settings = replace(EQUILIBRIUM, cone=cone)
    plain, centred = StabilityOracle(vault, settings), StabilityOracle(vault, settings)
    rng = np.random.default_rng(0)
    seen = []
    for _ in range(2):
        state = complete_state(vault.boundary)
        assert centred.verdicts(state[None], near=state[None]).stable.all()
        for part in rng.permutation(np.flatnonzero(state == INSTALLED)):
            held, after = state.copy(), state.copy()
            held[part], after[part] = HELD, REMOVED
            next_states, parents = np.stack([held, after, state]), np.stack([state, state, held])
            found = centred.verdicts(next_states, near=parents)
            assert (found.verdict == plain.verdicts(next_states).verdict).all()
            seen.append(found.stable[1])
            if not found.stable[1]:
                state = held if (held == HELD).sum() < (vault.boundary.sum() + 3) else state
            else:
                state = after
    assert any(seen)
    assert not all(seen)


def test_what_repairs_leave_open_is_decided_on_the_whole(vault: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(cpu_solver, "local_instability_range", lambda *arguments: len(arguments[1]))
    monkeypatch.setattr(cpu_solver, "repair_range", lambda *arguments: len(arguments[1]))
    parent = complete_state(vault.boundary)
    states = np.repeat(parent[None], 2, axis=0)
    states[:, np.flatnonzero(parent == INSTALLED)[:2]] = HELD
    known = CpuSolver(build_problem(vault)).check(states).forces
    assert known is not None
    parents = np.repeat(parent[None], 2, axis=0)
    found = CpuSolver(build_problem(vault)).check(states, certificates=False, parents=parents, guess=known.copy())
    assert found.stable.all()
