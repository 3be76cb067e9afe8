"""Options of what a plan has to claim, and the settings that check it."""

from __future__ import annotations

from dataclasses import dataclass
from typing import TYPE_CHECKING, Annotated, Any, ClassVar

from tyro.conf import arg

from falsework.cli.command import ConeOption, CriterionOption

if TYPE_CHECKING:
    from falsework.search.margins.demands import Demands
    from falsework.stability.settings import StabilitySettings


@dataclass(frozen=True, kw_only=True)
class ClaimOptions:
    """Criterion that states must satisfy; a plan that claims less is refused."""

    rare: ClassVar[tuple[str, ...]] = ("cone", "tolerance", "gravity", "force_bound", "reserve", "margin")

    criterion: CriterionOption = "contact"
    cone: ConeOption = None
    tolerance: float = 1e-4
    """Largest acceleration of a part in a stable state, as a share of gravity."""
    gravity: float = 9.81
    """m/s2."""
    force_bound: float = 1e3
    """Bound on the sum of all normal forces, in weights of the structure."""
    reserve: Annotated[float, arg(metavar="FACTOR")] = 1.0
    """Least reserve of the plan: number by which it divides friction."""
    margin: Annotated[str | None, arg(metavar="MARGINS", help_behavior_hint="(default: those of the plan)")] = None
    """Margins that every state must keep, such as friction=1.25,tilt=2deg,push=20N; see `falsework plan --help`."""

    def settings(self, **more: Any) -> StabilitySettings:
        """Return the settings of a check, with further fields of `StabilitySettings`."""
        from falsework.stability.settings import StabilitySettings

        return StabilitySettings(
            criterion=self.criterion,
            cone=self.cone,
            tolerance=self.tolerance,
            gravity=self.gravity,
            force_bound=self.force_bound,
            reserve=self.reserve,
            **more,
        )

    def demands(self) -> Demands | None:
        """Return the margins that were given; None if those of the plan count."""
        from falsework.search.margins.demands import Demands

        return None if self.margin is None else Demands.from_text(self.margin)
