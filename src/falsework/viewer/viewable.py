"""Opening of files and objects to show: plans, runs, robot plans, state graphs and structures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.load import as_assembly, load_structure
from falsework.assembly.model import Assembly
from falsework.assembly.state import complete_state
from falsework.errors import InputError
from falsework.files import load_own
from falsework.robots.model.cell import Cell
from falsework.robots.plans.robot_plan import RobotPlan
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_source import structure_of_plan
from falsework.search.plans.steps import holders
from falsework.search.problem.state_graph import StateGraph
from falsework.search.problem.task import Direction
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Criterion
from falsework.viewer.arms import Arms
from falsework.viewer.proof import BuildProofs, StateProof, proofs_of_states
from falsework.viewer.timeline import Timeline

if TYPE_CHECKING:
    from falsework.learn.networks.policy import Policy


@dataclass(frozen=True, eq=False)
class Viewable:
    """Plan, run, robot plan, state graph or structure with everything that pictures and the viewer need."""

    kind: Literal["plan", "run", "robot plan", "graph", "structure"]
    assembly: Assembly
    timeline: Timeline
    plan: Plan | None = None
    policy: Policy | None = None
    """Policy of a run."""
    graph: StateGraph | None = None
    arms: Arms | None = None
    """Robots of a robot plan."""

    def with_policy(self, policy: Policy | Path | str | None) -> Viewable:
        """Add a policy, or that of a run in a folder; None leaves everything as it is."""
        if policy is None:
            return self
        if isinstance(policy, (str, Path)):
            policy = _load_run(policy, self.assembly).policy
        return replace(self, policy=policy)

    def proofs(self, places: Iterable[int], criterion: Criterion = "contact") -> dict[int, StateProof]:
        """Decide the stability of some states of the timeline, by place.

        Under `contact`, states of a plan are judged as they are reached in assembly.
        """
        chosen = list(places)
        oracle = StabilityOracle(self.assembly, StabilitySettings(criterion=criterion))
        rows = [self.timeline.row(place) for place in chosen]
        if self.plan is not None and criterion == "contact":
            build = BuildProofs(self.plan, oracle)
            return {place: build.at(row) for place, row in zip(chosen, rows, strict=True)}
        return dict(zip(chosen, proofs_of_states(oracle, self.timeline.states[rows]), strict=True))


Showable = Viewable | Plan | RobotPlan | StateGraph | Assembly | str | Path | ArrayLike
"""Values that can be shown: objects of this package, a state, or what `open_file` takes."""


def open_file(
    path: str | Path,
    structure: Assembly | str | Path | None = None,
    *,
    cell: Cell | str | Path | None = None,
    direction: Direction = Direction.ASSEMBLY,
    robots: int = 2,
    **options: Any,
) -> Viewable:
    """Open a plan, run, robot plan, state graph or structure, whichever the file is.

    Args:
        path: file, folder of a run or of meshes, or the name of a built-in structure.
        structure: structure of a plan, graph or run, where the file does not name it or it has moved.
        cell: cell of a robot plan, where the file does not name it or it has moved.
        direction: order in which the steps are shown.
        robots: number of robots of a structure.
        options: as for `load_structure`.

    Raises:
        InputError: nothing that can be shown.
        DependencyError: a run without torch.
    """
    file = Path(path)
    if file.suffix.lower() == ".toml":
        raise InputError(
            f"{path} is a cell, which has no steps; falsework view and picture show it (view_cell in Python)"
        )
    known = load_own(path)
    if isinstance(known, Plan):
        return _plan(known, file, structure, direction, options)
    if isinstance(known, RobotPlan):
        return _robot_plan(known, file, structure, cell, direction, options)
    if isinstance(known, StateGraph):
        return _graph(known, str(file), structure, direction, options)
    if known is not None:
        return _run(known if structure is None else _load_run(file, as_assembly(structure, **options)))
    if structure is not None:
        raise InputError(f"{path} is a structure itself; leave --structure out")
    assembly = load_structure(path, **options)
    return Viewable("structure", assembly, _still(assembly, complete_state(assembly.boundary), robots, direction))


def viewable_of(
    subject: Showable,
    structure: Assembly | str | Path | None = None,
    *,
    cell: Cell | str | Path | None = None,
    direction: Direction = Direction.ASSEMBLY,
    robots: int = 2,
    **options: Any,
) -> Viewable:
    """Make a file or an object viewable.

    Args:
        subject: what `open_file` takes, a plan, robot plan, state graph or assembly, or a state of shape (parts,) of
            the given structure.
        structure: as for `open_file`.
        cell: as for `open_file`.
        direction: as for `open_file`.
        robots: as for `open_file`.
        options: as for `load_structure`.

    Raises:
        InputError: nothing that can be shown, or a state without a structure.
    """
    if isinstance(subject, Viewable):
        return subject
    if isinstance(subject, (str, Path)):
        return open_file(subject, structure, cell=cell, direction=direction, robots=robots, **options)
    if isinstance(subject, Plan):
        return _plan(subject, None, structure, direction, options)
    if isinstance(subject, RobotPlan):
        return _robot_plan(subject, None, structure, cell, direction, options)
    if isinstance(subject, StateGraph):
        return _graph(subject, "the graph", structure, direction, options)
    if isinstance(subject, Assembly):
        return Viewable("structure", subject, _still(subject, complete_state(subject.boundary), robots, direction))
    if not (isinstance(subject, (list, tuple)) or hasattr(subject, "__array__")):
        raise InputError(
            f"{type(subject).__name__} cannot be shown; give a plan, structure, state graph, state or file"
        )
    if structure is None:
        raise InputError("a state alone does not say which structure it is of; give the structure too")
    assembly = as_assembly(structure, **options)
    return Viewable("structure", assembly, _still(assembly, subject, robots, direction))


def _still(assembly: Assembly, state: ArrayLike, robots: int, direction: Direction) -> Timeline:
    return Timeline.from_state(assembly, state, robots).turned(direction)


def _plan(
    plan: Plan,
    file: Path | None,
    structure: Assembly | str | Path | None,
    direction: Direction,
    options: dict[str, Any],
) -> Viewable:
    assembly = structure_of_plan(plan, file, structure, **options)
    return Viewable("plan", assembly, Timeline.from_plan(plan, assembly, direction), plan)


def _robot_plan(
    robot_plan: RobotPlan,
    file: Path | None,
    structure: Assembly | str | Path | None,
    cell: Cell | str | Path | None,
    direction: Direction,
    options: dict[str, Any],
) -> Viewable:
    from falsework.robots.cells.cell_file import as_cell

    assembly = structure_of_plan(robot_plan.plan, file, structure, **options)
    if cell is None:
        if robot_plan.cell_source is None:
            raise InputError(f"{file or 'the robot plan'} does not say where its cell is; name it (--cell)")
        beside = (Path() if file is None else file.resolve().parent) / robot_plan.cell_source
        cell = str(beside) if beside.is_file() else robot_plan.cell_source
    cell = as_cell(cell)
    robot_plan.check_identity(assembly, cell)
    arms = Arms(robot_plan, cell, direction)
    timeline = Timeline.from_plan(robot_plan.plan, assembly, direction, arms.holders())
    return Viewable("robot plan", assembly, timeline, robot_plan.plan, arms=arms)


def _load_run(folder: Path | str, assembly: Assembly | None) -> Any:
    from falsework.utils.optional_packages import check_torch

    check_torch()
    from falsework.learn.training.checkpoint import load_run

    return load_run(folder, assembly=assembly)


def _run(run: Any) -> Viewable:
    robots = getattr(run.settings, "robots", 2)
    # A policy disassembles: its next actions are shown for the complete structure.
    still = _still(run.assembly, complete_state(run.assembly.boundary), robots, Direction.DISASSEMBLY)
    return Viewable("run", run.assembly, still, policy=run.policy)


def _graph(
    graph: StateGraph,
    name: str,
    structure: Assembly | str | Path | None,
    direction: Direction,
    options: dict[str, Any],
) -> Viewable:
    from falsework.assembly.library import built_in, is_built_in

    if structure is None:
        if not is_built_in(graph.name):
            raise InputError(f"{name} does not say where {graph.name or 'its structure'} is; name it (--structure)")
        structure = built_in(graph.name)
    assembly = as_assembly(structure, **options)
    if assembly.identity != graph.task.identity:
        raise InputError(f"{name} is of another structure than {assembly.name}; name the right one (--structure)")
    route = graph.sample_route(np.random.default_rng(0))
    if route is None:
        still = _still(assembly, graph.task.start, graph.task.robots, direction)
        return Viewable("graph", assembly, still, graph=graph)
    states = route.states[::-1]
    who = holders(states, assembly.boundary)
    timeline = Timeline(assembly, states, route.actions[::-1], who, direction, graph.task.robots)
    return Viewable("graph", assembly, timeline, graph=graph)
