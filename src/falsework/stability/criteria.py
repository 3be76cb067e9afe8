"""The two criteria, as objects of one protocol: how states are decided, built step by step, and asked for margins."""

from __future__ import annotations

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.margins.contact_prober import ContactProber
from falsework.stability.margins.prober import Prober
from falsework.stability.problem import Problem
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Criterion


class EquilibriumCriterion(CpuSolver):
    """Criterion `equilibrium` of one structure."""

    def __init__(self, assembly: Assembly, problem: Problem, settings: StabilitySettings) -> None:
        """Lay out the structure.

        Raises:
            InputError: joints that set.
        """
        if assembly.joints is not None and assembly.joints.setting:
            raise InputError("joints that set need the criterion contact; equilibrium has no steps")
        super().__init__(problem, settings)
        self.assembly = assembly

    def replayer(self) -> Replayer | None:
        """Return None: states have no history."""
        return None

    def prober(self) -> Prober:
        """Return the solver of single states under other friction and loads."""
        return Prober(self.assembly, self)


class ContactCriterion(ContactSolver):
    """Criterion `contact` of one structure."""

    def replayer(self) -> Replayer | None:
        """Return the replayer of states, which may replay under changed settings too."""
        return Replayer(self.assembly, self.settings, solver=self, varies=True)

    def prober(self) -> Prober:
        """Return the solver of single states under other friction and loads."""
        return ContactProber(self.assembly, self)


CRITERIA: dict[Criterion, type[EquilibriumCriterion | ContactCriterion]] = {
    "equilibrium": EquilibriumCriterion,
    "contact": ContactCriterion,
}
"""The criteria by name."""
