"""Chord steps: what they find is a proof, one factorization serves many states, and verdicts stay the same."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework.assembly import library
from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, INSTALLED, REMOVED, complete_state
from falsework.stability import Stability, Verdict, verify_certificates
from falsework.stability.cpu import chord
from falsework.stability.cpu import solver as cpu_solver
from falsework.stability.cpu.chord import FactoredState
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.problem import build_problem
from falsework.stability.settings import EQUILIBRIUM


@pytest.fixture(scope="module")
def shell() -> Assembly:
    return library.build("vault:parts=120")


def _releases(shell: Assembly) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    complete = complete_state(shell.boundary)
    parts = np.flatnonzero(complete == INSTALLED)[::4]
    before = np.repeat(complete[None], len(parts), axis=0)
    before[np.arange(len(parts)), parts] = HELD
    return np.repeat(complete[None], len(parts), axis=0), before


def test_chord_steps_prove_states_with_the_factors_of_one(shell: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    states, before = _releases(shell)
    solver = CpuSolver(build_problem(shell))
    known = solver.check(before)
    assert known.forces is not None
    factored = FactoredState(solver.structure, solver._options)
    real, calls = chord.factor_state, []
    monkeypatch.setattr(chord, "factor_state", lambda *given: calls.append(1) or real(*given))
    assert factored.prepare(states, before, known.forces)
    assert factored.prepare(states[3:], before[3:], known.forces[3:])
    assert len(calls) == 1
    verdict, residual = np.zeros(len(states), np.int8), np.full(len(states), np.nan)
    forces, steps = known.forces.copy(), np.zeros(len(states), np.int32)
    left = factored.balance(states, before, known.stable, forces, verdict, residual, steps)
    good = np.flatnonzero(verdict == Verdict.STABLE)
    assert len(good) == len(states) - left
    assert len(good) > len(states) // 2
    assert (residual[good] < EQUILIBRIUM.tolerance).all()
    checked = Stability(shell, EQUILIBRIUM).check(states[good])
    assert checked.forces is not None
    checked.forces[:] = forces[good]
    assert verify_certificates(shell, states[good], checked, EQUILIBRIUM.claim).all()
    open_rows = np.flatnonzero(verdict == Verdict.UNDECIDED)
    assert (forces[open_rows] == known.forces[open_rows]).all()


def test_states_that_lack_a_part_of_the_factored_one_are_left(shell: Assembly) -> None:
    states, before = _releases(shell)
    solver = CpuSolver(build_problem(shell))
    known = solver.check(before[:2])
    assert known.forces is not None
    factored = FactoredState(solver.structure, solver._options)
    fewer = states[:2].copy()
    fewer[:, np.flatnonzero(states[0] == INSTALLED)[1]] = REMOVED
    assert not factored.prepare(fewer, before[:2], known.forces)
    assert factored.prepare(states[:2], before[:2], known.forces)
    assert not factored.prepare(fewer, before[:2], known.forces)
    factored.forget()
    assert factored.prepare(states[:2], before[:2], known.forces)


def test_verdicts_in_the_order_of_assembly_are_the_same(shell: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    plain = Stability(shell, EQUILIBRIUM)
    for name in ("_LARGE", "_LARGER", "_CENTRED"):
        monkeypatch.setattr(cpu_solver, name, 0)
    centred = Stability(shell, EQUILIBRIUM)
    balanced = []
    real = FactoredState.balance

    def counted(self: FactoredState, *given: NDArray) -> int:
        left = real(self, *given)
        balanced.append(len(given[0]) - left)
        return left

    monkeypatch.setattr(FactoredState, "balance", counted)
    rng, state = np.random.default_rng(0), complete_state(shell.boundary)
    held = np.where(shell.boundary, state, np.uint8(HELD))
    assert centred.judge(held[None], parents=held[None]).stable.all()
    state = held
    # Parts that robots hold are let go of in a random order; what falls is held again.
    for part in rng.permutation(np.flatnonzero(~shell.boundary)):
        after = state.copy()
        after[part] = INSTALLED
        found, expected = centred.judge(after[None], parents=state[None]), plain.judge(after[None])
        assert found.undecided.all() or (found.verdict == expected.verdict).all()
        if found.stable.all():
            state = after
    assert (state == INSTALLED).sum() > 50
    assert sum(balanced) > 3
