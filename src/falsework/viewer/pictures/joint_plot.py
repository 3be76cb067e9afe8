"""Plot of the joints of a robot plan over time: position and velocity of each, as shares of their limits."""

from __future__ import annotations

from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from falsework.robots.model.cell import Cell
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.timeline import schedule_of, segments_of
from falsework.viewer.palette import INK
from falsework.viewer.pictures.picture import figure_class, save_figure

Array = NDArray[np.float64]

_WIDTH, _ROW = 12.0, 2.6
"""Width of the plot and height of an arm, inches."""
_SAMPLES = 0.02
"""Time between two samples, seconds."""


def joint_values(plan: RobotPlan, robot: int) -> tuple[Array, Array, Array]:
    """Return times, seconds, and position and velocity of the joints of an arm at them, shape (times, joints) each."""
    starts, segments = schedule_of(plan).starts(), segments_of(plan)[robot]
    times, positions, rates = [0.0], [segments[0].rest[None]], [np.zeros_like(segments[0].rest)[None]]
    for segment in segments:
        if segment.trajectory is None or segment.begun is None:
            continue
        seconds = segment.trajectory.seconds
        own = np.linspace(0.0, seconds, 2 + int(seconds / _SAMPLES))
        times += (starts[segment.begun] + own).tolist()
        positions.append(segment.trajectory.sample(own))
        rates.append(segment.trajectory.rates(own))
    end = max(plan.makespan, times[-1])
    last = positions[-1][-1:]
    return np.array([*times, end]), np.concatenate([*positions, last]), np.concatenate([*rates, np.zeros_like(last)])


def joint_shares(plan: RobotPlan, cell: Cell, robot: int) -> tuple[Array, Array, Array]:
    """Return as `joint_values`, with positions from -1, the lower limit, to 1, and velocities as shares of theirs."""
    times, positions, rates = joint_values(plan, robot)
    model = cell.robots[robot].model
    return times, (2 * positions - model.upper - model.lower) / (model.upper - model.lower), rates / model.velocity


def draw_joints(plan: RobotPlan, cell: Cell, path: Path, *, width: int = 0, title: str = "") -> float:
    """Draw positions and velocities of all joints as PNG or SVG, and return the largest share of a velocity limit.

    Args:
        cell: its cell, which has the limits.
        width: pixels across; 0 chooses.
        title: a line above.
    """
    rows = len(plan.robots)
    figure = figure_class("plots of joints")(figsize=(_WIDTH, 0.8 + _ROW * rows), layout="constrained")
    grid, fastest = figure.subplots(rows, 2, sharex=True, squeeze=False), 0.0
    for robot, (record, axes) in enumerate(zip(plan.robots, grid, strict=True)):
        times, positions, rates = joint_shares(plan, cell, robot)
        for place, values in zip(axes, (positions, rates), strict=True):
            for joint, name in enumerate(record.joint_names):
                place.plot(times, values[:, joint], linewidth=1.0, label=name)
            for limit in (-1.0, 1.0):
                place.axhline(limit, color=INK, linewidth=0.8, linestyle="--")
            place.set_ylim(-1.15, 1.15)
            for side in ("top", "right"):
                place.spines[side].set_visible(False)
        fastest = max(fastest, float(np.abs(rates).max(initial=0.0)))
        axes[0].set_ylabel(f"{record.name}: position", parse_math=False)
        axes[0].set_yticks((-1, 0, 1), ("lower limit", "middle", "upper limit"))
        axes[1].set_ylabel("velocity")
        axes[1].set_yticks((-1, 0, 1), ("-limit", "0", "limit"))
        legend = axes[1].legend(loc="center left", bbox_to_anchor=(1.0, 0.5), fontsize=7, frameon=False)
        for text in legend.get_texts():
            text.set_parse_math(False)
    for place in grid[-1]:
        place.set_xlabel("seconds")
        place.set_xlim(0.0, max(plan.makespan, 1e-3))
    figure.suptitle(title or f"{plan.plan.name}: joints of {plan.cell_name}", parse_math=False)
    save_figure(figure, path, width / _WIDTH or 100)
    return fastest
