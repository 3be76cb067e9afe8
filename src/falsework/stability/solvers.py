"""Solvers of each criterion, what their proofs mean for other states, and solvers that need optional packages."""

from __future__ import annotations

from functools import cached_property
from typing import TYPE_CHECKING, Protocol

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import Mask, States
from falsework.errors import InputError
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.contact.varied_replay import EnsembleReplayer
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.gpu.solver import GpuSolver
from falsework.stability.problem import Problem
from falsework.stability.second_order.growing_motion import SecondOrder
from falsework.stability.settings import StabilitySettings
from falsework.stability.state_memory import StateMemory, WholeMemory, remembered_forces
from falsework.stability.verdict import Verdict, Verdicts, proof_of

if TYPE_CHECKING:
    from falsework.stability.reference.gurobi import GurobiSolver


class CriterionSolver(Protocol):
    """Solver of one criterion, and what its proofs mean."""

    @property
    def holds_keep_stable(self) -> bool:
        """Whether a stable state stays stable when a part is held."""
        ...

    @property
    def cpu(self) -> CpuSolver | ContactSolver | None:
        """Solver on the CPU; None where the exact solver is asked for, or the only one that knows all contacts."""
        ...

    @property
    def replayer(self) -> Replayer | None:
        """Replayer of state sequences, of an ensemble where there is a reserve; None without history."""
        ...

    def all_undecided(self, batch: int) -> Verdicts:
        """Return undecided verdicts with room for certificates."""
        ...

    def no_guess(self, batch: int) -> NDArray[np.float64]:
        """Return guesses for states of which nothing is known, shape (batch, points, 3) or (batch, parts, 6)."""
        ...

    def guess_of(self, verdicts: Verdicts) -> NDArray[np.float64] | None:
        """Return what of the certificates of stable states starts solvers of states near by; None without any."""
        ...

    def memory(self) -> WholeMemory | StateMemory:
        """Return an empty memory for guesses."""
        ...

    def is_locally_unstable(self, states: States, near: States) -> Mask:
        """Return which states have a proven mechanism near where they differ from stable ones, shape (batch,)."""
        ...

    def refine_undecided(self, states: States, verdicts: Verdicts) -> None:
        """Revise verdicts that have a proof, where more is asked of stable states."""
        ...

    def is_left_to_exact(self, verdicts: Verdicts) -> Mask:
        """Return for which of some undecided states the exact solver may know more, shape (batch,)."""
        ...

    def read_exact(self, exact: Verdicts, before: Verdicts) -> None:
        """Turn verdicts of the exact solver, of the equilibrium problem, into verdicts under the criterion."""
        ...


class EquilibriumSolver:
    """Solver of the criterion `equilibrium`: forces are the proof, and may be those of a state with fewer holds."""

    holds_keep_stable = True
    replayer = None

    def __init__(self, assembly: Assembly, problem: Problem, settings: StabilitySettings) -> None:
        if assembly.joints is not None and assembly.joints.setting:
            raise InputError("joints that set need the criterion contact; equilibrium has no steps")
        self._problem = problem
        known = settings.solver in ("auto", "cpu") and not problem.strength.idle.any()
        self.cpu = CpuSolver(problem, settings) if known else None

    def all_undecided(self, batch: int) -> Verdicts:
        """See `CriterionSolver`."""
        return Verdicts.all_undecided(batch, points=self._problem.points, parts=self._problem.parts)

    def no_guess(self, batch: int) -> NDArray[np.float64]:
        """See `CriterionSolver`."""
        return np.zeros((batch, self._problem.points, 3))

    def guess_of(self, verdicts: Verdicts) -> NDArray[np.float64] | None:
        """See `CriterionSolver`."""
        return verdicts.forces

    def memory(self) -> WholeMemory | StateMemory:
        """See `CriterionSolver`."""
        return remembered_forces(self._problem.points, self._problem.parts)

    def is_locally_unstable(self, states: States, near: States) -> Mask:
        """See `CriterionSolver`; only replays ask this, and there are none."""
        return np.zeros(len(states), dtype=bool)

    def refine_undecided(self, states: States, verdicts: Verdicts) -> None:
        """See `CriterionSolver`; balance is all that is asked."""

    def is_left_to_exact(self, verdicts: Verdicts) -> Mask:
        """See `CriterionSolver`."""
        return np.ones(len(verdicts), dtype=bool)

    def read_exact(self, exact: Verdicts, before: Verdicts) -> None:
        """See `CriterionSolver`; the verdicts are its own."""


class RestSolver:
    """Solver of the criterion `contact`: displacements are the proof, and another hold may take one away."""

    holds_keep_stable = False

    def __init__(self, assembly: Assembly, problem: Problem, settings: StabilitySettings) -> None:
        self._assembly, self._problem, self._settings = assembly, problem, settings
        self.cpu = ContactSolver(assembly, problem, settings)
        self._second_order = SecondOrder(assembly, settings.claim)

    @cached_property
    def replayer(self) -> Replayer | None:
        """See `CriterionSolver`."""
        kind = EnsembleReplayer if self._settings.reserve > 1.0 else Replayer
        return kind(self._assembly, self._settings, solver=self.cpu)

    def all_undecided(self, batch: int) -> Verdicts:
        """See `CriterionSolver`."""
        return Verdicts.all_undecided(batch, points=self._problem.points, parts=self._problem.parts, displaced=True)

    def no_guess(self, batch: int) -> NDArray[np.float64]:
        """See `CriterionSolver`."""
        return np.full((batch, self._problem.parts, 6), np.nan)

    def guess_of(self, verdicts: Verdicts) -> NDArray[np.float64] | None:
        """See `CriterionSolver`."""
        return verdicts.displacement

    def memory(self) -> WholeMemory | StateMemory:
        """See `CriterionSolver`."""
        return WholeMemory(8 * 6 * self._problem.parts)

    def is_locally_unstable(self, states: States, near: States) -> Mask:
        """See `CriterionSolver`."""
        return self.cpu.falls(states, near)

    def refine_undecided(self, states: States, verdicts: Verdicts) -> None:
        """See `CriterionSolver`; a rest position that a small motion leaves is no stable state."""
        self._second_order.revise(states, verdicts)

    def is_left_to_exact(self, verdicts: Verdicts) -> Mask:
        """See `CriterionSolver`; where equilibrium is proven and no rest position was found, it has nothing to add."""
        return ~(verdicts.undecided & (verdicts.residual <= self._settings.tolerance))

    def read_exact(self, exact: Verdicts, before: Verdicts) -> None:
        """See `CriterionSolver`; equilibrium does not imply stability, so other states stay undecided."""
        slides = exact.stable & (before.slides | np.isposinf(before.residual))
        exact.verdict[exact.stable & ~slides] = Verdict.UNDECIDED
        exact.verdict[slides] = Verdict.SLIDES
        exact.proof[:] = proof_of(exact.verdict, "contact")


def criterion_solver(assembly: Assembly, problem: Problem, settings: StabilitySettings) -> CriterionSolver:
    """Return the solver of the criterion of some settings.

    Raises:
        InputError: joints that set, under `equilibrium`.
    """
    solvers: dict[str, type[EquilibriumSolver | RestSolver]] = {"equilibrium": EquilibriumSolver, "contact": RestSolver}
    return solvers[settings.criterion](assembly, problem, settings)


def gurobi_solver(assembly: Assembly, settings: StabilitySettings, problem: Problem) -> GurobiSolver | None:
    """Return the Gurobi solver if the settings ask for it."""
    if settings.solver != "gurobi":
        return None
    from falsework.stability.reference.gurobi import GurobiSolver

    return GurobiSolver(assembly, settings, problem)


def gpu_solver(assembly: Assembly, settings: StabilitySettings, problem: Problem) -> GpuSolver | None:
    """Return the GPU solver if the settings ask for it; with `auto`, only where there is a GPU."""
    if settings.solver not in ("auto", "gpu"):
        return None
    try:
        return GpuSolver(assembly, problem, settings)
    except InputError:  # no torch, no bindings or no device
        if settings.solver == "gpu":
            raise
        return None
