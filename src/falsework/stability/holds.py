"""Holds of robots: their stiffness, their limits, and the wrenches with which robots press.

A robot that holds a part is a spring that carries a wrench, `w = w0 - K u`: `w0` is what it bears where it stopped, `u`
how far the part has moved since then. With infinite `K` the hold is locked: the controller keeps the pose of the part,
whatever slowly changes around it. Finite `K` is an arm under impedance control, or one under position control that does
not see how its joints and links give way. While another part is released, a robot may *press*: it adds a chosen wrench
to `w0` while it is compliant, in all directions (force control) or along the force only (hybrid control). Then it stays
where it is.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cache
from itertools import accumulate
from typing import Annotated, Any

import numpy as np
from msgspec import Meta
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.utils.models import FileModel
from falsework.utils.quantity import format_quantity

Array = NDArray[np.float64]
RobotNames = Callable[[int], str]
"""From the number of a robot, from 0, to its name."""

PRESS_STIFFNESS = 1e6
"""Largest stiffness of a robot while it presses, N/m: a stiffer one would turn errors of position into errors of force.
"""
LEAST_STIFFNESS = 1e-9
"""Smallest stiffness of a robot that is taken, N/m."""
FORCE_WEIGHTS = 50.0
"""Default largest force of a robot, in weights of the heaviest part that it may have to carry. The end of an arch that
is not closed yet presses with the weight of many parts; most plans need far less."""
_OFF_SIZE, _OFF_DIRECTION = 0.1, np.radians(5.0)
"""Share of its size, and angle, by which a robot may miss the force of a press."""
_LEVER = 2.0
"""Default largest moment of a robot: its largest force at this multiple of the largest radius of gyration of a part."""


class HoldMode(StrEnum):
    """What robots that hold parts control while another part is released."""

    LOCKED = "locked"
    """The pose: they never press."""
    FORCE = "force"
    """The wrench: a robot that presses gives way in all directions."""
    HYBRID = "hybrid"
    """The force along one direction, and the pose across it: a robot that presses gives way along that direction only.
    """


@dataclass(frozen=True)
class HoldSettings:
    """What robots that hold parts can do."""

    stiffness: float = np.inf
    """Stiffness of a hold, N/m; against turning it is this times the square of the radius of gyration, N m/rad.
    Infinite: the robot keeps the pose of the part."""
    force: float | None = None
    """Largest force on a held part, N; fifty weights of the heaviest part if not given. With 0 robots never press, and
    what they bear has no limit."""
    moment: float | None = None
    """Largest moment about the centre of mass of a held part, N m, above zero; if not given, twice the largest force
    times the largest radius of gyration."""
    mode: HoldMode = HoldMode.HYBRID
    """What robots control while another part is let go of. Only with `locked` do they never press held parts against
    others."""

    @property
    def presses(self) -> bool:
        """Whether robots press: if they may, and with a force of more than zero."""
        return self.mode is not HoldMode.LOCKED and self.force != 0

    def to_dict(self) -> dict[str, Any]:
        """Return the settings as plain JSON values; null stands for no limit, and for a rigid hold."""
        finite = {name: getattr(self, name) for name in ("stiffness", "force", "moment")}
        return {name: None if value == np.inf else value for name, value in finite.items()} | {"mode": self.mode.value}

    def resolved(self, assembly: Assembly, gravity: float = 9.81) -> HoldSettings:
        """Return the settings with the limits that they mean for a structure."""
        force, moment = limits_of(assembly, self, gravity)
        return replace(self, force=force, moment=moment, mode=self.mode if self.presses else HoldMode.LOCKED)

    def changed(self, assembly: Assembly, gravity: float, **given: Any) -> HoldSettings:
        """Return the settings with some others, where a moment that only followed from the force still does."""
        followed = replace(self, moment=None).resolved(assembly, gravity).moment == self.moment
        return replace(self, **{**({"moment": None} if followed else {}), **given})

    def within(self, others: HoldSettings) -> HoldSettings:
        """Return the settings with no larger force and moment than those of others that give them.

        Robots that never press, which a force of 0 says too, still do not.
        """
        least = {}
        for name in ("force", "moment"):
            mine, theirs = getattr(self, name), getattr(others, name)
            least[name] = min(mine or np.inf, theirs) if theirs else mine
        same = self.presses or not least["force"]
        return replace(self, **least, mode=self.mode if same else HoldMode.LOCKED)

    def __post_init__(self) -> None:
        if self.mode not in tuple(HoldMode):
            raise InputError(f"the mode of holds is {self.mode!r}; give {', '.join(HoldMode)}")
        object.__setattr__(self, "mode", HoldMode(self.mode))
        if not self.stiffness >= LEAST_STIFFNESS:  # far below, it is lost beside rounding, and its inverse is no number
            raise InputError(
                f"the stiffness of holds is {self.stiffness:g} N/m; give {LEAST_STIFFNESS:g} or more, inf for rigid"
            )
        if self.force is not None and not self.force >= 0:
            raise InputError(f"the largest force of holds is {self.force:g} N; give 0 or more")
        # Rounding alone is a moment, so that with none no part could be held.
        if self.moment is not None and not self.moment > 0:
            raise InputError(f"the largest moment of holds is {self.moment:g} N m; give more than 0")


class Press(FileModel, frozen=True):
    """Wrench that a robot adds to a part that it holds while another part is released."""

    part: Annotated[int, Meta(ge=0)]
    """The held part."""
    wrench: Annotated[tuple[float, ...], Meta(min_length=6, max_length=6)]
    """Force in N, and moment about the part's centre of mass in N m; under hybrid control the moment is zero, and the
    part gives way along the force only."""

    @property
    def force(self) -> float:
        """Size of the force, N."""
        return float(np.linalg.norm(self.wrench[:3]))


class HoldLoad(FileModel, frozen=True):
    """What a robot bears for a part that it holds in one state."""

    part: Annotated[int, Meta(ge=0)]
    """The held part."""
    force: Annotated[float, Meta(ge=0)]
    """Size of the force, N."""
    moment: Annotated[float, Meta(ge=0)]
    """Size of the moment about the part's centre of mass, N m."""


def limits_of(assembly: Assembly, settings: HoldSettings, gravity: float = 9.81) -> tuple[float, float]:
    """Return the largest force of a robot on a part, N, and the largest moment about its centre of mass, N m.

    Raises:
        InputError: a robot cannot carry a part; the message names the heaviest one.
    """
    weight = gravity * assembly.mass.mass
    movable = ~assembly.immovable
    heaviest = float(weight[movable].max(initial=0.0))
    force = FORCE_WEIGHTS * heaviest if settings.force is None else settings.force
    if settings.force and settings.force < heaviest:
        part = int(np.flatnonzero(movable)[np.argmax(weight[movable])])
        raise InputError(
            f"robots that hold with at most {format_quantity(force, 'force')} cannot carry part "
            f"{assembly.names[part]}, which weighs {format_quantity(heaviest, 'force')}; raise the largest force of "
            "holds"
        )
    reach = float(assembly.mass.gyration[movable].max(initial=0.0))
    moment = _LEVER * force * reach if settings.moment is None else settings.moment
    return float(force) or np.inf, float(moment) or np.inf


def robot_number(robot: int) -> str:
    """Return the name of a robot that has none, such as `R2`; robots are counted from 0."""
    return f"R{robot + 1}"


def describe_loads(
    loads: Sequence[HoldLoad], parts: Sequence[str], who: NDArray[np.int64], robots: RobotNames = robot_number
) -> str:
    """Describe what robots bear in a state, such as `R1 bears 1.2 kN for block-25`; empty if they hold nothing.

    Args:
        loads: in the state.
        who: robot that holds each part, shape (parts,).
        robots: names of the robots.
    """
    return ", ".join(
        f"{robots(int(who[load.part]))} bears {format_quantity(load.force, 'force')} for {parts[load.part]}"
        for load in loads
    )


def pack_presses(presses: Sequence[Sequence[Press]]) -> tuple[NDArray[np.int32], NDArray[np.int32], Array]:
    """Return presses in the layout of the kernel.

    Args:
        presses: those of the step that leads to each state, one entry a state.

    Returns:
        First entry of each state and one past the last, shape (states + 1,); parts, shape (presses,); wrenches, shape
        (presses, 6).
    """
    start = np.array([0, *accumulate(map(len, presses))], dtype=np.int32)
    flat = [press for some in presses for press in some]
    parts = np.array([press.part for press in flat], dtype=np.int32)
    return start, parts, np.array([press.wrench for press in flat], dtype=np.float64).reshape(-1, 6)


@cache
def inexact_wrenches() -> Array:
    """Return the maps from a wrench to those that a robot may exert instead: itself, and some that are off.

    Each of these is 10 % too small or too large and turned by 5 degrees about one of the four diagonals of a cube. They
    turn a wrench of any direction to all sides: those along one diagonal are turned by the other three.

    Shape (errors, 6, 6), the identity first.
    """
    from scipy.spatial.transform import Rotation  # few structures need it

    diagonals = np.array([[1, 1, 1], [1, -1, -1], [-1, 1, -1], [-1, -1, 1]]) / np.sqrt(3)
    turns = Rotation.from_rotvec(_OFF_DIRECTION * diagonals).as_matrix()
    sizes = 1 + _OFF_SIZE * np.array([-1, 1, -1, 1])
    return np.stack([np.eye(6), *(size * np.kron(np.eye(2), turn) for size, turn in zip(sizes, turns, strict=True))])


def inexact_presses(presses: Sequence[Press]) -> list[tuple[Press, ...]]:
    """Return presses as robots may carry them out: 10 % off in size, and 5 degrees in direction."""
    return [
        tuple(Press(press.part, tuple((error @ press.wrench).tolist())) for press in presses)
        for error in inexact_wrenches()[1:]
    ]
