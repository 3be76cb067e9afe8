"""Arrays and options of the kernels of the criterion `contact`."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.stability.cpu.layout import KernelArrays, Scratch, make_scratch
from falsework.stability.cpu.panels import RIDGE
from falsework.stability.cpu.products import LANES
from falsework.stability.holds import PRESS_STIFFNESS, HoldMode, limits_of
from falsework.stability.problem import Problem
from falsework.stability.settings import StabilitySettings
from falsework.stability.stiffness import MOVEMENT, normal_stiffness, reach_of, structure_size
from falsework.utils.kernels import njit


class StepSchedule(NamedTuple):
    """Rules by which the time step grows and steps are accepted."""

    growth: float
    """Least growth of the time step after a full step; it grows by the decrease of the residual where that is more."""
    patience: int
    """Iterations after which the least growth is `late_growth` where a contact point opens, closes, or slides anew."""
    late_growth: float
    growth_after_rise: float
    """Largest of the least growth where a full step raised the residual."""
    memory: float
    """Share of the last but one residual up to which a step may raise the residual."""


VERDICT_SCHEDULE = StepSchedule(growth=4.0, patience=60, late_growth=1.2, growth_after_rise=4.0, memory=0.0)
"""StepSchedule of verdicts and replays: contacts that alternate between sliding and sticking need shorter steps."""


class ContactOptions(NamedTuple):
    """Numerical options of the kernel."""

    tolerance: float
    """Largest residual of a state at rest."""
    steps: int
    """Limit on Newton iterations from rest."""
    warm_steps: int
    """The same from the displacement of a parent, and half as many for the parts near a change while the others are
    fixed."""
    first_step: float
    """First time step from rest."""
    warm_first_step: float
    """The same from the displacement of a parent."""
    schedule: StepSchedule = VERDICT_SCHEDULE
    """Rules by which the time step grows."""


class ContactArrays(NamedTuple):
    """Arrays that the criterion adds to `KernelArrays`: scaled stiffness, and units of displacement."""

    structure: KernelArrays
    normal: NDArray[np.float64]
    """Normal stiffness of each contact point in scaled variables, median 1, shape (points,)."""
    tangential: NDArray[np.float64]
    turned_a: NDArray[np.float64]
    """Transposes of `Problem.transfer_a`, with rows of eight numbers, shape (pairs, 6, 8)."""
    turned_b: NDArray[np.float64]
    rows: NDArray[np.float64]
    """Transposes of `Problem.basis`, shape (points, 3, 8)."""
    scale: float
    """Metres (or radians) of displacement per scaled unit."""
    reach: NDArray[np.float64]
    """Distance of the farthest corner of each part, m: converts rotations to movements, shape (parts,)."""
    limit: float
    """Movement of a part up to which a structure never counts as collapsing, m."""
    grip: NDArray[np.float64]
    """Scaled stiffness of a robot's hold on each part, zero where holds are rigid, shape (parts,). The stiffness of a
    hold is a multiple of the mass matrix of its part, so one number is enough."""
    press_grip: NDArray[np.float64]
    """The same of a robot that presses, which is compliant; never zero."""
    force_limit: NDArray[np.float64]
    """Largest whitened force of a robot on each part, shape (parts,)."""
    moment_limit: NDArray[np.float64]
    """Largest moment of a robot on each part about its centre of mass, N m, shape (parts,)."""
    hybrid: bool
    """Whether robots that press control the force along one direction only, and the position across it."""


class ContactScratch(NamedTuple):
    """Scratch memory of one thread; points in the compact order of the current state."""

    work: Scratch
    normal: NDArray[np.float64]
    """Scaled stiffness of the acting points, shape (points,)."""
    tangential: NDArray[np.float64]
    pull: NDArray[np.float64]
    """Scaled tensile strength of the acting points, zero where they are broken, shape (points,)."""
    stick: NDArray[np.float64]
    offset: NDArray[np.float64]
    """Spring forces at zero displacement: the history in a replay, shape (points, 3)."""
    trial: NDArray[np.float64]
    """Elastic trial forces of the springs, shape (points, 3)."""
    next_trial: NDArray[np.float64]
    tangent: NDArray[np.float64]
    """Tangent stiffness of the points of one pair, shape (points, 9)."""
    load: NDArray[np.float64]
    """Whitened external wrenches on the parts, shape (n, 6)."""
    displacement: NDArray[np.float64]
    """Shape (n, 6), whitened and scaled."""
    next_displacement: NDArray[np.float64]
    residual: NDArray[np.float64]
    next_residual: NDArray[np.float64]
    step: NDArray[np.float64]
    grip: NDArray[np.float64]
    """Scaled stiffness of the hold on each part, zero for parts that nothing holds, shape (n,)."""
    across: NDArray[np.float64]
    """Scaled stiffness across `line` of a hold that controls the force along it; `LOCKED` where the part may not move
    across it; zero for other parts, shape (n,)."""
    line: NDArray[np.float64]
    """Direction of the force of such a hold, a unit vector, shape (n, 3)."""


@njit(cache=True)
def make_contact_scratch(law):
    """Return scratch large enough for every state of a structure."""
    n, points = len(law.structure.elimination.order), len(law.normal)
    return ContactScratch(
        make_scratch(law.structure),
        np.zeros(points),
        np.zeros(points),
        np.zeros(points),
        np.zeros(points),
        np.zeros((points, 3)),
        np.zeros((points, 3)),
        np.zeros((points, 3)),
        np.zeros((points, 9)),
        np.zeros((n, 6)),
        np.zeros((n, 6)),
        np.zeros((n, 6)),
        np.zeros((n, 6)),
        np.zeros((n, 6)),
        np.zeros((n, 6)),
        np.zeros(n),
        np.zeros(n),
        np.zeros((n, 3)),
    )


def build_contact_structure(
    assembly: Assembly, problem: Problem, structure: KernelArrays, settings: StabilitySettings
) -> ContactArrays:
    """Lay out the stiffness of a structure for the kernel.

    Args:
        assembly: the structure.
        problem: its scaled equilibrium problem.
        structure: the layout of that.
        settings: gravity, ratio of tangential to normal stiffness, and what robots can do.
    """
    holds, stiff = settings.holds, settings.holds.stiffness
    normal, scale, limit = contact_units(assembly, problem, settings.gravity)
    soft = np.where(problem.strength.idle, RIDGE, 1.0)
    wider = ((0, 0), (0, 0), (0, LANES - 6))
    mass, (force, moment) = assembly.mass.mass, limits_of(assembly, holds, settings.gravity)
    pressing = min(stiff, PRESS_STIFFNESS) / mass * scale
    return ContactArrays(
        structure=structure,
        normal=soft * normal,
        tangential=soft * (settings.stiffness_ratio * normal),
        turned_a=np.array(np.pad(problem.transfer_a.transpose(0, 2, 1), wider), order="C"),
        turned_b=np.array(np.pad(problem.transfer_b.transpose(0, 2, 1), wider), order="C"),
        rows=np.array(np.pad(problem.basis.transpose(0, 2, 1), wider), order="C"),
        scale=scale,
        reach=reach_of(assembly),
        limit=limit,
        grip=np.zeros(len(mass)) if np.isinf(stiff) else stiff / mass * scale,
        press_grip=pressing,
        force_limit=force / np.sqrt(mass),
        moment_limit=np.full(len(mass), moment),
        hybrid=holds.mode is HoldMode.HYBRID,
    )


def contact_units(assembly: Assembly, problem: Problem, gravity: float) -> tuple[NDArray[np.float64], float, float]:
    """Return the scaled normal stiffness of each contact point, `scale` and `limit` of `ContactArrays`."""
    stiffness = normal_stiffness(assembly, gravity) / problem.force_scale**2
    scale = 1.0 / float(np.median(stiffness)) if len(stiffness) else 1.0
    return stiffness * scale, scale, MOVEMENT * structure_size(assembly)
