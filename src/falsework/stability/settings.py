"""Settings of a stability check."""

from __future__ import annotations

from dataclasses import dataclass, fields, replace
from typing import Literal, get_args

from falsework.errors import InputError
from falsework.stability.criterion import Cone, StabilityBounds, StabilityCriterion
from falsework.stability.holds import HoldSettings
from falsework.stability.verdict import Criterion
from falsework.utils.quantity import check_positive

SolverName = Literal["auto", "cpu", "gpu", "exact"]

MOST_GRAVITY = 1e9
"""Largest acceleration of gravity that is taken, m/s2; the smallest is its inverse."""


@dataclass(frozen=True)
class NumericalSettings:
    """Numerical settings of the solvers; the defaults were tuned on the paper's nine structures."""

    rho: float = 1e-3
    """Penalty of ADMM, relative to the scaled problem."""
    relaxation: float = 1.3
    """Over-relaxation of ADMM, between 1 and 2."""
    iterations: int = 60
    """ADMM iterations before the interior point method takes over."""
    check_every: int = 5
    """Iterations between two termination tests."""
    interior_steps: int = 60
    """Iterations of the interior point method before a state is left to the exact solver."""
    contact_steps: int = 400
    """Newton iterations under the criterion `contact` before a state is left undecided, and in replays an increment."""
    warm_steps: int = 64
    """The same from the displacement of a neighbour, before a state is tested for equilibrium; if it is, they continue,
    by as many where no certificate is requested: a search has other states to try. Before them come half as many of
    the parts near the difference alone. Checked on recorded searches."""
    first_step: float = 30.0
    """First time step of these iterations from rest, in units in which the median contact stiffness is 1: longer means
    lower viscosity. With much longer ones iterations may jump to an equilibrium that parts would not reach as they
    settle into their contacts."""
    warm_first_step: float = 1e4
    """The same from the displacement of a neighbour, which is closer to the solution."""
    gpu_states: int = 8
    """States from which the solver `auto` uses the GPU: a launch costs as much as a few states on the CPU."""
    gpu_bytes: int = 2 << 30
    """Device memory for the forces and velocities of one chunk of states."""
    threads: int | None = None
    """Worker threads on the CPU; all cores by default."""

    def __post_init__(self) -> None:
        check_positive(self, "rho", "first_step", "warm_first_step")
        if not 0 < self.relaxation < 2:
            raise InputError(f"relaxation is {self.relaxation}; give a number between 0 and 2")
        for name, least in (
            ("iterations", 0),
            ("check_every", 1),
            ("interior_steps", 0),
            ("contact_steps", 1),
            ("warm_steps", 1),
            ("gpu_states", 1),
            ("gpu_bytes", 1),
            ("threads", 1),
        ):
            value = getattr(self, name)
            if value is not None and value < least:
                raise InputError(f"{name} is {value}; give a whole number from {least} up")


@dataclass(frozen=True)
class StabilitySettings(StabilityBounds):
    """Stability criterion, its bounds, and choice of solver."""

    criterion: Criterion = "contact"
    """`contact`: parts come to rest on compliant contacts without prestress. `equilibrium`: balancing forces exist,
    the criterion of the paper."""
    cone: Cone | None = None
    """Friction cone: the paper's octagon, or Coulomb's quadratic cone. None: quadratic under `contact`, where the
    octagon would make verdicts depend on the orientation of contact frames, and octagon under `equilibrium`."""
    solver: SolverName = "cpu"
    """First solver; states that it leaves undecided go to the exact solver. `auto` takes the GPU, where there is
    one, for batches on which it is faster than the CPU."""
    numerics: NumericalSettings = NumericalSettings()

    def __post_init__(self) -> None:
        if self.criterion not in get_args(Criterion):
            raise InputError(f"unknown criterion {self.criterion!r}; choose {' or '.join(get_args(Criterion))}")
        check_positive(self, "gravity", "tolerance", "force_bound", "stiffness_ratio", "reserve")
        if not 1 / MOST_GRAVITY <= self.gravity <= MOST_GRAVITY:  # beyond, squares of forces are no numbers any more
            raise InputError(f"gravity is {self.gravity:g} m/s2; give {1 / MOST_GRAVITY:g} to {MOST_GRAVITY:g}")
        if self.tolerance >= 1:  # a part in free fall would be stable
            raise InputError(f"tolerance is {self.tolerance:g} of gravity; give less than 1")
        if not isinstance(self.holds, HoldSettings):
            raise InputError(f"holds are {self.holds!r}; give HoldSettings")
        if self.reserve < 1:
            raise InputError(f"reserve is {self.reserve:g}, which would raise friction; give 1 for none, or more")
        if self.cone is not None and self.cone not in get_args(Cone):
            raise InputError(f"unknown friction cone {self.cone!r}; choose {' or '.join(get_args(Cone))}")
        if self.solver not in get_args(SolverName):
            raise InputError(f"unknown solver {self.solver!r}; choose {', '.join(get_args(SolverName))}")

    @classmethod
    def from_claim(cls, claim: StabilityCriterion, criterion: Criterion | None = None) -> StabilitySettings:
        """Return the settings under which a claim is made.

        Args:
            criterion: another criterion, to which cone, reserve and holds of the claim do not apply.
        """
        given = vars(claim)
        if criterion is not None and criterion != claim.criterion:
            given = {name: value for name, value in given.items() if name not in ("cone", "reserve", "holds")}
            given["criterion"] = criterion
        return cls(**given)

    def under_gravity_of(self, claim: StabilityCriterion | None) -> StabilitySettings:
        """Return the same settings under the gravity of the claim of a plan, if there is one."""
        return self if claim is None else replace(self, gravity=claim.gravity)

    @property
    def friction_cone(self) -> Cone:
        """The friction cone in force."""
        return self.cone or ("quadratic" if self.criterion == "contact" else "octagon")

    @property
    def claim(self) -> StabilityCriterion:
        """Criterion and bounds for the certificate checker."""
        bounds = {field.name: getattr(self, field.name) for field in fields(StabilityBounds)}
        return StabilityCriterion(**bounds, criterion=self.criterion, cone=self.friction_cone)


EQUILIBRIUM = StabilitySettings(criterion="equilibrium")
"""The paper's criterion, all other settings default: input of the solvers of the equilibrium problem."""
