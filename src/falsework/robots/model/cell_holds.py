"""Holds in a cell: how large forces of the structure are there, and what its robots can do in the structure's units."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.errors import CellError
from falsework.robots.model.cell import Cell
from falsework.stability.settings import StabilitySettings
from falsework.utils.quantity import format_quantity


@dataclass(frozen=True)
class CellScale:
    """Factors from a structure's own lengths and forces to those in a cell, which may scale it and change its density.

    Moments grow with the product of both, stiffness with their ratio.
    """

    length: float
    force: float

    @classmethod
    def from_cell(cls, assembly: Assembly, cell: Cell) -> CellScale:
        """Return the factors for a structure; of parts that become heavier by different factors the largest counts."""
        placement, own = cell.placement, assembly.mass.mass
        placed = own if placement.density is None else assembly.replace(density=placement.density).mass.mass
        return cls(placement.scale, placement.scale**3 * float((placed / own).max()))

    @property
    def moment(self) -> float:
        """Factor of moments."""
        return self.force * self.length

    @property
    def stiffness(self) -> float:
        """Factor of stiffness."""
        return self.force / self.length


def boundless(cell: Cell) -> str:
    """Return in words what planning assumes of grippers without limits; empty where all have them."""
    names = sorted({robot.gripper.name for robot in cell.robots if not robot.gripper.has_limits})
    if not names:
        return ""
    return f"grippers without force and moment bear fifty weights of the heaviest part in planning: {', '.join(names)}"


def stability_in(cell: Cell, assembly: Assembly, settings: StabilitySettings) -> StabilitySettings:
    """Return settings of stability with robots that can do no more than those of a cell, in the structure's units.

    The least force and moment that a gripper of the cell bears limit those of all holds: which robot holds which part
    is open when states are judged. CellError if a gripper bears less than the weight of a part.
    """
    scale, holds = CellScale.from_cell(assembly, cell), settings.holds
    weight = scale.force * settings.gravity * assembly.mass.mass * ~assembly.immovable
    heaviest = int(weight.argmax())
    weakest = min(cell.robots, key=lambda robot: robot.gripper.force)
    if weakest.gripper.force < weight[heaviest]:
        raise CellError(
            f"the gripper of {weakest.name} bears {format_quantity(weakest.gripper.force, 'force', 4)}, less than part "
            f"{assembly.names[heaviest]} weighs in {cell.name}, {format_quantity(weight[heaviest], 'force', 4)}; "
            f"take a stronger gripper"
        )
    if settings.criterion == "equilibrium":  # in which robots hold with any force
        return settings
    force = min(weakest.gripper.force, np.inf if holds.force is None else holds.force)
    moment = min(robot.gripper.moment for robot in cell.robots)
    moment = min(moment, np.inf if holds.moment is None else holds.moment)
    limits = {
        "force": None if np.isinf(force) else force / scale.force,
        "moment": None if np.isinf(moment) else moment / scale.moment,
    }
    return replace(settings, holds=replace(holds, stiffness=holds.stiffness / scale.stiffness, **limits))
