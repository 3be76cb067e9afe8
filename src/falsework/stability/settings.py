"""Settings of a stability check."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Literal, get_args

import numpy as np

from falsework.errors import InputError
from falsework.stability.criterion import StabilityCriterion
from falsework.stability.holds import HoldSettings
from falsework.stability.problem import TOLERANCE, Cone
from falsework.stability.stiffness import TANGENTIAL_RATIO
from falsework.stability.strength import FORCE_BOUND
from falsework.stability.verdict import Criterion

SolverName = Literal["auto", "cpu", "gpu", "exact"]


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
    interior_steps: int = 50
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
        for name in ("rho", "first_step", "warm_first_step"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value}; give a positive number")
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
class StabilitySettings:
    """Stability criterion and choice of solver."""

    criterion: Criterion = "contact"
    """`contact`: parts come to rest on compliant contacts without prestress. `equilibrium`: balancing forces exist,
    the criterion of the paper."""
    cone: Cone | None = None
    """Friction cone: the paper's octagon, or Coulomb's quadratic cone. None: quadratic under `contact`, where the
    octagon would make verdicts depend on the orientation of contact frames, and octagon under `equilibrium`."""
    gravity: float = 9.81
    """m/s2 along -z."""
    tolerance: float = TOLERANCE
    """Largest residual of a stable state: the largest acceleration of a part as a share of gravity, an angular
    acceleration times the part's largest radius of gyration. The paper allows 1e-3 m/s2 (section 4). Solvers go on to
    `resolution`; `Verdicts.on_tolerance` tells where they do not get there."""
    force_bound: float = FORCE_BOUND
    """Bound on the sum of all normal forces, in weights of the structure."""
    stiffness_ratio: float = TANGENTIAL_RATIO
    """Ratio of tangential to normal contact stiffness, under the criterion `contact`."""
    reserve: float = 1.0
    """Number by which friction is divided in all verdicts and replays; 1.1 is the default of plans."""
    holds: HoldSettings = field(default_factory=HoldSettings)
    """Stiffness and limits of robots that hold parts, and whether they press, in replays."""
    solver: SolverName = "cpu"
    """First solver; states that it leaves undecided go to the exact solver. `auto` takes the GPU, where there is
    one, for batches on which it is faster than the CPU."""
    numerics: NumericalSettings = NumericalSettings()

    def __post_init__(self) -> None:
        if self.criterion not in get_args(Criterion):
            raise InputError(f"unknown criterion {self.criterion!r}; choose {' or '.join(get_args(Criterion))}")
        for name in ("gravity", "tolerance", "force_bound", "stiffness_ratio", "reserve"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0):
                raise InputError(f"{name} is {value}; give a positive number")
        if self.reserve < 1:
            raise InputError(f"reserve is {self.reserve:g}, which would raise friction; give 1 for none, or more")
        if self.cone is not None and self.cone not in get_args(Cone):
            raise InputError(f"unknown friction cone {self.cone!r}; choose {' or '.join(get_args(Cone))}")
        if self.solver not in get_args(SolverName):
            raise InputError(f"unknown solver {self.solver!r}; choose {', '.join(get_args(SolverName))}")

    @property
    def friction_cone(self) -> Cone:
        """The friction cone in force."""
        return self.cone or ("quadratic" if self.criterion == "contact" else "octagon")

    @property
    def resolution(self) -> float:
        """Residual at which verdicts are decided, a share of gravity."""
        return self.claim.resolution

    @property
    def claim(self) -> StabilityCriterion:
        """Criterion and bounds for the certificate checker."""
        return StabilityCriterion(
            self.friction_cone,
            self.gravity,
            self.tolerance,
            self.force_bound,
            self.criterion,
            self.stiffness_ratio,
            self.reserve,
            self.holds,
        )


EQUILIBRIUM = StabilitySettings(criterion="equilibrium")
"""The paper's criterion, all other settings default: input of the solvers of the equilibrium problem."""
