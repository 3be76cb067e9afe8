"""Holds in a cell: how large forces of the structure are there, and what its robots can do in the structure's units."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

import numpy as np

from falsework.assembly.model import Assembly
from falsework.errors import CellError
from falsework.robots.model.cell import Cell
from falsework.robots.model.part_shapes import placed_mass
from falsework.stability.holds import HoldSettings
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
        """Return the factors for a structure, in which all forces grow as the weights of its parts do.

        CellError if they do not: what is proven of the structure then does not hold for the one in the cell.
        """
        placement, movable = cell.placement, ~assembly.immovable
        factors = (placed_mass(assembly, placement) / assembly.mass.mass)[movable]
        force = float(factors.max(initial=0.0)) or placement.scale**3
        if not all(math.isclose(factor, force) for factor in factors.tolist()):
            own = assembly.density[movable]
            raise CellError(
                f"{cell.name} gives all parts of {assembly.name} a density of {placement.density:g} kg/m3, of which "
                f"some have {own.min():g} and others {own.max():g}, and which states are stable depends on that; leave "
                "density out of [structure], or give the structure one density (--density)"
            )
        given = _unscaled(assembly)
        if given and not (math.isclose(force, 1) and math.isclose(placement.scale, 1)):
            raise CellError(
                f"{cell.name} changes the weights of {assembly.name}, but its {given} stay as they are, so that other "
                "states are stable; leave scale and density out of [structure], and give the structure its true size "
                "and density"
            )
        return cls(placement.scale, force)

    @property
    def moment(self) -> float:
        """Factor of moments."""
        return self.force * self.length

    @property
    def stiffness(self) -> float:
        """Factor of stiffness."""
        return self.force / self.length

    @property
    def inverse(self) -> CellScale:
        """Factors from the cell to the structure."""
        return CellScale(1 / self.length, 1 / self.force)

    def holds(self, holds: HoldSettings) -> HoldSettings:
        """Return what robots can do, given in the units of the structure, in those of the cell."""
        force = None if holds.force is None else holds.force * self.force
        moment = None if holds.moment is None else holds.moment * self.moment
        return replace(holds, stiffness=holds.stiffness * self.stiffness, force=force, moment=moment)


def _unscaled(assembly: Assembly) -> str:
    """Return in words what a structure has besides weights and friction; empty if there is nothing."""
    loads, joints = assembly.loads, assembly.joints
    found = ["loads"] if loads is not None and loads.wrench[~assembly.immovable].any() else []
    if joints is not None and (np.nan_to_num(joints.cohesion).any() or joints.tension.any()):
        found.append("joints with a strength")
    return " and ".join(found)


def boundless(cell: Cell, force: float | None = None) -> str:
    """Return in words what planning under `contact` assumes of grippers without limits; empty where all have them.

    Args:
        force: largest force of robots that was asked for, in the cell, N.
    """
    names = sorted({robot.gripper.name for robot in cell.robots if not robot.gripper.has_limits})
    if not names:
        return ""
    least = min([force or np.inf, *(robot.gripper.force for robot in cell.robots)])
    bear = "fifty weights of the heaviest part" if np.isinf(least) else f"at most {format_quantity(least, 'force')}"
    return f"grippers without force and moment bear {bear} in planning: {', '.join(names)}"


def stability_in(cell: Cell, assembly: Assembly, settings: StabilitySettings) -> StabilitySettings:
    """Return settings of stability with robots that can do no more than those of a cell, in the structure's units.

    The least force and moment that a gripper of the cell bears limit those of all holds: which robot holds which part
    is open when states are judged. CellError if a gripper bears less than the weight of a part.
    """
    scale = CellScale.from_cell(assembly, cell)
    weight = settings.gravity * placed_mass(assembly, cell.placement) * ~assembly.immovable
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
    limits = weakest.gripper.force, min(robot.gripper.moment for robot in cell.robots)
    force, moment = (None if np.isinf(limit) else limit for limit in limits)
    tools = HoldSettings(np.inf, force, moment)
    return replace(settings, holds=scale.inverse.holds(settings.holds.within(tools)))
