"""Options of holds and of the reserve, and the settings of stability that they give."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Annotated, Any, ClassVar, Literal

from tyro.conf import arg

from falsework.cli.arguments import parse_limits
from falsework.cli.command import UNSET
from falsework.errors import InputError

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.robots.model.cell_holds import CellScale
    from falsework.search.plans.plan import Plan
    from falsework.stability.criterion import Cone
    from falsework.stability.settings import SolverName, StabilitySettings
    from falsework.stability.verdict import Criterion


@dataclass(frozen=True, kw_only=True)
class HoldOptions:
    """What robots that hold parts can do, and the reserve that a plan keeps; under the criterion `contact`."""

    rare: ClassVar[tuple[str, ...]] = ("hold_force", "hold_stiffness", "no_press", "reserve")

    hold_force: Annotated[str | None, arg(metavar="FORCE", help_behavior_hint="(default: 50 weights)")] = None
    """Largest force of a robot on a part that it holds, such as 300N or 1.5kN; by default fifty weights of the heaviest
    part. With 0 robots never press, and bear any force."""
    hold_stiffness: Annotated[float | None, arg(metavar="N/m", help_behavior_hint="(default: inf)")] = None
    """Stiffness of a robot at its gripper, N/m, where its controller does not keep the pose of the part that it holds.
    An industrial arm has 1e6 to 1e8."""
    hold_moment: Annotated[str | None, arg(metavar="MOMENT", help_behavior_hint=UNSET)] = None
    """Largest moment of a robot about the centre of mass of a part that it holds, such as 40Nm; by default twice the
    largest force times the largest radius of gyration of a part."""
    press_mode: Annotated[Literal["force", "hybrid"] | None, arg(help_behavior_hint="(default: hybrid)")] = None
    """What a robot controls that presses on a part while another part is released: its force in all directions, or
    along one direction only, with the position of the part across it."""
    no_press: bool = False
    """Robots only hold; they do not press on parts while another part is released."""
    reserve: Annotated[float | None, arg(metavar="FACTOR", help_behavior_hint="(default: 1.1)")] = None
    """Number by which friction is divided: every state must come to rest with that friction, and with the true one."""

    def settings(self, criterion: Criterion, cone: Cone | None = None, solver: SolverName = "cpu") -> StabilitySettings:
        """Return the settings of stability."""
        from falsework.search.find import RESERVES
        from falsework.stability.holds import HoldSettings
        from falsework.stability.settings import StabilitySettings

        given = self._given()
        if criterion == "equilibrium" and given:
            raise InputError("under equilibrium robots hold with any force; leave out the options of holds")
        if self.reserve is not None and not self.reserve >= 1:
            raise InputError(f"--reserve is {self.reserve:g}; give 1 for none, or more")
        reserve = self.reserve or RESERVES[criterion]
        holds = HoldSettings(**given)
        return StabilitySettings(criterion=criterion, cone=cone, solver=solver, reserve=reserve, holds=holds)

    def settings_from(
        self,
        plan: Plan | None,
        assembly: Assembly,
        criterion: Criterion | None,
        solver: SolverName = "cpu",
        scale: CellScale | None = None,
    ) -> StabilitySettings:
        """Return the settings of a plan that is carried out, with those that are given in place of its own.

        Args:
            scale: from the units of the structure, in which a plan is, to those of the options and of the settings
                returned, if they differ.
        """
        from falsework.stability.settings import StabilitySettings

        if plan is None:
            return self.settings(criterion or "contact", solver=solver)
        own = StabilitySettings.from_claim(plan.claim, criterion)
        asked = self.settings(own.criterion, solver=solver)
        if own.criterion != plan.claim.criterion:
            return replace(own, solver=solver, reserve=asked.reserve, holds=asked.holds)
        given = asked.holds if scale is None else scale.inverse.holds(asked.holds)
        holds = own.holds.changed(assembly, own.gravity, **{name: getattr(given, name) for name in self._given()})
        holds = holds if scale is None else scale.holds(holds)
        return replace(own, solver=solver, reserve=self.reserve or own.reserve, holds=holds)

    def _given(self) -> dict[str, Any]:
        """Return what the options say of holds, by the names of `HoldSettings`."""
        from falsework.stability.holds import HoldMode

        if self.no_press and self.press_mode is not None:
            raise InputError("--press-mode is for robots that press; leave out one of --press-mode and --no-press")
        force, moment = parse_limits(self.hold_force, self.hold_moment)
        mode = HoldMode.LOCKED if self.no_press else self.press_mode and HoldMode(self.press_mode)
        options = {"stiffness": self.hold_stiffness, "force": force, "moment": moment, "mode": mode}
        return {name: value for name, value in options.items() if value is not None}
