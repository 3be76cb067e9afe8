"""Solvers of each criterion, what their proofs mean for other states, and solvers that need optional packages."""

from __future__ import annotations

from functools import cached_property

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
from falsework.stability.verdict import Verdict, Verdicts, proof_of


class EquilibriumSolver:
    """Solver of a criterion, and what its proofs mean; here of `equilibrium`.

    Forces are the proof, and may be those of a state with fewer holds.
    """

    holds_keep_stable = True
    """Whether a stable state stays stable when a part is held."""
    cpu: CpuSolver | ContactSolver | None
    """Solver on the CPU; None where the exact solver is asked for, or the only one that knows all contacts."""

    def __init__(self, assembly: Assembly, problem: Problem, settings: StabilitySettings) -> None:
        if assembly.joints is not None and assembly.joints.setting:
            raise InputError("joints that set need the criterion contact; equilibrium has no steps")
        self._problem = problem
        known = settings.solver in ("auto", "cpu") and not problem.strength.idle.any()
        self.cpu = CpuSolver(problem, settings) if known else None

    @cached_property
    def replayer(self) -> Replayer | None:
        """Replayer of state sequences, of an ensemble where there is a reserve; None without history."""
        return None

    def all_undecided(self, batch: int) -> Verdicts:
        """Return undecided verdicts with room for certificates."""
        return Verdicts.all_undecided(batch, points=self._problem.points, parts=self._problem.parts)

    def no_guess(self, batch: int) -> NDArray[np.float64]:
        """Return guesses for states of which nothing is known, shape (batch, points, 3) or (batch, parts, 6)."""
        return np.zeros((batch, self._problem.points, 3))

    def guess_of(self, verdicts: Verdicts) -> NDArray[np.float64] | None:
        """Return what of the certificates of stable states starts solvers of states near by; None without any."""
        return verdicts.forces

    def is_locally_unstable(self, states: States, near: States) -> Mask:
        """Return which states have a proven mechanism near where they differ from stable ones, shape (batch,)."""
        return np.zeros(len(states), dtype=bool)  # only replays ask this, and there are none

    def refine_undecided(self, states: States, verdicts: Verdicts) -> None:
        """Revise verdicts that have a proof, where more is asked of stable states than balance."""

    def is_left_to_exact(self, verdicts: Verdicts) -> Mask:
        """Return for which of some undecided states the exact solver may know more, shape (batch,)."""
        return np.ones(len(verdicts), dtype=bool)

    def read_exact(self, exact: Verdicts, before: Verdicts) -> None:
        """Turn verdicts of the exact solver, of the equilibrium problem, into verdicts under the criterion."""


class RestSolver(EquilibriumSolver):
    """Solver of the criterion `contact`: displacements are the proof, and another hold may take one away."""

    holds_keep_stable = False

    def __init__(self, assembly: Assembly, problem: Problem, settings: StabilitySettings) -> None:
        self._assembly, self._problem, self._settings = assembly, problem, settings
        self.cpu = self._solver = ContactSolver(assembly, problem, settings)
        self._second_order = SecondOrder(assembly, settings.claim)

    @cached_property
    def replayer(self) -> Replayer | None:
        """Replayer of state sequences, of an ensemble where there is a reserve."""
        kind = EnsembleReplayer if self._settings.reserve > 1.0 else Replayer
        return kind(self._assembly, self._settings, solver=self._solver)

    def all_undecided(self, batch: int) -> Verdicts:
        """Return undecided verdicts with room for displacements too."""
        return Verdicts.all_undecided(batch, points=self._problem.points, parts=self._problem.parts, displaced=True)

    def no_guess(self, batch: int) -> NDArray[np.float64]:
        """Return unknown displacements, shape (batch, parts, 6)."""
        return np.full((batch, self._problem.parts, 6), np.nan)

    def guess_of(self, verdicts: Verdicts) -> NDArray[np.float64] | None:
        """Return the displacements at rest."""
        return verdicts.displacement

    def is_locally_unstable(self, states: States, near: States) -> Mask:
        """Return which states have a proven mechanism near where they differ from stable ones, shape (batch,)."""
        return self._solver.falls(states, near)

    def refine_undecided(self, states: States, verdicts: Verdicts) -> None:
        """Revise verdicts on rest positions that a small motion leaves: these states are not stable."""
        self._second_order.revise(states, verdicts)

    def is_left_to_exact(self, verdicts: Verdicts) -> Mask:
        """Return where no equilibrium is proven: where it is and no rest position was found, nothing can be added."""
        return ~(verdicts.undecided & (verdicts.residual <= self._settings.tolerance))

    def read_exact(self, exact: Verdicts, before: Verdicts) -> None:
        """Turn equilibrium into sliding where parts move away; else it does not imply stability, and is undecided."""
        slides = exact.stable & (before.slides | np.isposinf(before.residual))
        exact.verdict[exact.stable & ~slides] = Verdict.UNDECIDED
        exact.verdict[slides] = Verdict.SLIDES
        exact.proof[:] = proof_of(exact.verdict, "contact")


def criterion_solver(assembly: Assembly, problem: Problem, settings: StabilitySettings) -> EquilibriumSolver:
    """Return the solver of the criterion of some settings.

    Raises:
        InputError: joints that set, under `equilibrium`.
    """
    return {"equilibrium": EquilibriumSolver, "contact": RestSolver}[settings.criterion](assembly, problem, settings)


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
