"""Criterion, tolerance and bounds that a verdict refers to."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Any, Literal

import numpy as np
from numpy.typing import NDArray

from falsework.stability.holds import HoldSettings
from falsework.stability.stiffness import TANGENTIAL_RATIO
from falsework.stability.verdict import Criterion, Verdicts

Cone = Literal["octagon", "quadratic"]

_RESOLUTION = 1e-3
"""Residual at which verdicts are decided, as a share of the tolerance."""
_WELL_BELOW = 0.1
"""Residual of a stable state, as a share of the tolerance, above which the verdict depends on the tolerance."""


@dataclass(frozen=True, kw_only=True)
class StabilityBounds:
    """Gravity, tolerance, bounds and holds that a verdict refers to."""

    gravity: float = 9.81
    """m/s2 along -z."""
    tolerance: float = 1e-4
    """Largest residual of a stable state: the largest acceleration of a part as a share of gravity, an angular
    acceleration times the part's largest radius of gyration. The paper allows 1e-3 m/s2 (section 4). Solvers go on to
    `resolution`; `Verdicts.on_tolerance` tells where they do not get there."""
    force_bound: float = 1e3
    """Bound on the sum of all normal forces, in weights of the structure; the paper bounds forces too."""
    stiffness_ratio: float = TANGENTIAL_RATIO
    """Ratio of tangential to normal contact stiffness, under the criterion `contact`."""
    reserve: float = 1.0
    """Number by which friction is divided in all verdicts and replays; 1.1 is the default of plans."""
    holds: HoldSettings = field(default_factory=HoldSettings)
    """Stiffness and limits of robots that hold parts, and whether they press, in replays."""

    @property
    def resolution(self) -> float:
        """Residual at which verdicts are decided, a share of gravity."""
        return _RESOLUTION * self.tolerance

    @property
    def under(self) -> str:
        """The friction of verdicts, in words to put after them; empty where it is the true one."""
        return f" with friction divided by {self.reserve:g}" if self.reserve != 1.0 else ""


@dataclass(frozen=True)
class StabilityCriterion(StabilityBounds):
    """Criterion and cone of a verdict, with the bounds that it refers to."""

    cone: Cone = "octagon"
    """Friction cone."""
    criterion: Criterion = "equilibrium"
    """Definition of stability."""

    def to_dict(self) -> dict[str, Any]:
        """Return the criterion as plain JSON values."""
        return vars(self) | {"holds": self.holds.to_dict()}

    @property
    def proves(self) -> str:
        """What it proves of the states of a plan, in words: under `contact` they are stable as the plan builds them."""
        return "stable as built" if self.criterion == "contact" else "stable"

    @property
    def presses(self) -> bool:
        """Whether robots may press: under `contact`, if their holds do."""
        return self.criterion == "contact" and self.holds.presses

    @property
    def well_below(self) -> float:
        """Residual up to which a stable state does not depend on the tolerance, a share of gravity."""
        return _WELL_BELOW * self.tolerance

    def on_tolerance(self, verdicts: Verdicts) -> NDArray[np.bool_]:
        """Return which verdicts depend on the tolerance, shape (batch,); see `Verdicts.on_tolerance`."""
        residual = verdicts.residual
        return (verdicts.stable & (residual > self.well_below)) | (verdicts.unstable & (residual <= self.tolerance))


CONTACT = StabilityCriterion(cone="quadratic", criterion="contact")
"""The default criterion of verdicts, plans and replays."""
