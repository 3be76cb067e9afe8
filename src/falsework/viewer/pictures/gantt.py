"""Gantt chart of a robot plan: when each arm moves, holds a part at its place, and waits."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

from falsework.errors import DependencyError, InputError
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.robots.plans.temporal_graph import TemporalPlanGraph
from falsework.robots.plans.timeline import nodes_of
from falsework.utils.archive import write_whole
from falsework.viewer.palette import INK, robot_color

_WIDTH, _ROW = 12.0, 0.55
"""Of the chart and of the row of an arm, inches."""
_ALPHA = {"moves": 1.0, "carries": 1.0, "holds": 0.35}


@dataclass(frozen=True)
class Bar:
    """What one arm does for a while."""

    robot: int
    begin: float
    end: float
    """Seconds from the start of the plan."""
    does: Literal["moves", "carries", "holds"]
    part: int | None


def bars_of(plan: RobotPlan) -> list[Bar]:
    """Return what the arms of a plan do; between two bars of an arm it waits.

    A plan without a schedule is shown one motion after the other.
    """
    starts, graph = _starts(plan)
    found = []
    for robot in range(len(plan.robots)):
        free, held = 0.0, plan.keyframes[0].held[robot]
        for index in graph.of_robot(robot):
            node = graph.nodes[index]
            if held is not None and starts[index] > free:
                found.append(Bar(robot, free, starts[index], "holds", held))
            free = starts[index] + node.seconds
            if node.trajectory is not None:
                part = plan.steps[node.step].trajectories[node.trajectory].part
                found.append(Bar(robot, starts[index], free, "moves" if part is None else "carries", part))
                held = None
            if node.trajectory is None or node.trajectory == len(plan.steps[node.step].trajectories) - 1:
                held = plan.keyframes[node.step + 1].held[robot]
        if held is not None and plan.makespan > free:
            found.append(Bar(robot, free, plan.makespan, "holds", held))
    return found


def _starts(plan: RobotPlan) -> tuple[list[float], TemporalPlanGraph]:
    if plan.schedule is not None:
        return plan.schedule.starts().tolist(), plan.schedule
    nodes, _ = nodes_of(plan)
    return list(_one_by_one([node.seconds for node in nodes])), TemporalPlanGraph(nodes, (), len(plan.robots), 0.0)


def _one_by_one(seconds: list[float]) -> Iterator[float]:
    now = 0.0
    for length in seconds:
        yield now
        now += length


def draw_gantt(plan: RobotPlan, path: Path, *, width: int = 0, title: str = "") -> int:
    """Draw the chart as PNG or SVG, and return the number of bars.

    Args:
        plan: the robot plan.
        path: file to write.
        width: pixels across; 0 chooses.
        title: a line above.

    Raises:
        DependencyError: matplotlib is not installed.
        InputError: a file that is neither PNG nor SVG, or that cannot be written.
    """
    form = path.suffix.lower()[1:]
    if form not in ("png", "svg"):
        raise InputError(f"{path} is neither PNG nor SVG; name a file that ends in .png or .svg")
    try:
        from matplotlib.figure import Figure
    except ImportError:
        raise DependencyError("a Gantt chart needs matplotlib: pip install 'falsework[picture]'") from None
    bars = bars_of(plan)
    figure = Figure(figsize=(_WIDTH, 1.3 + _ROW * len(plan.robots)), layout="constrained")
    axes = figure.add_subplot()
    for bar in bars:
        edge: dict[str, Any] = {"edgecolor": INK, "linewidth": 1.0 if bar.does == "carries" else 0.3}
        color, alpha = robot_color(bar.robot), _ALPHA[bar.does]
        height = 0.4 if bar.does == "moves" else 0.7
        axes.barh(bar.robot, bar.end - bar.begin, left=bar.begin, height=height, color=color, alpha=alpha, **edge)
    axes.set_yticks(range(len(plan.robots)), [robot.name for robot in plan.robots])
    axes.invert_yaxis()
    axes.set_xlim(0.0, max(plan.makespan, 1e-3))
    axes.set_xlabel(
        "seconds; high: carries a part; low: moves without one; pale: holds a part at its place; gap: waits"
    )
    axes.set_title(title or f"{plan.plan.name}: {plan.makespan:.1f} s, one after the other {plan.seconds:.1f} s")
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    dots = 100 if width == 0 else width / _WIDTH
    write_whole(path, lambda file: figure.savefig(file, format=form, dpi=dots))
    return len(bars)
