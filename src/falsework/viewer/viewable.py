"""Opening of files and objects to show: plans, runs, robot plans, state graphs and structures."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import ArrayLike

from falsework.assembly.load import AnyStructure, as_assembly, load_options, load_structure
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
from falsework.utils.models import check_options
from falsework.viewer.arms import Arms
from falsework.viewer.proof import BuildProofs, StateProof, proofs_of_states
from falsework.viewer.timeline import Timeline

if TYPE_CHECKING:
    from falsework.learn.networks.policy import Policy
    from falsework.robots.cells.cell_file import AnyCell


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
    file: Path | None = None
    """What it was read from, if it was."""

    def with_policy(self, policy: Policy | Path | str | None) -> Viewable:
        """Add a policy, or that of a run in a folder; None leaves everything as it is."""
        if policy is None:
            return self
        if isinstance(policy, (str, Path)):
            policy = _load_run(policy, self.assembly).policy
        return replace(self, policy=policy)

    def proofs(self, places: Iterable[int], criterion: Criterion = "contact") -> dict[int, StateProof]:
        """Decide the stability of some states of the timeline, by place.

        Under `contact`, states of a plan are judged as built.
        """
        chosen = list(places)
        claim = None if self.plan is None else self.plan.claim
        settings = StabilitySettings(criterion=criterion).under_gravity_of(claim)
        oracle = StabilityOracle(self.assembly, settings)
        rows = [self.timeline.row(place) for place in chosen]
        if self.plan is not None and criterion == "contact":
            build = BuildProofs(self.plan, oracle)
            return {place: build.at(row) for place, row in zip(chosen, rows, strict=True)}
        return dict(zip(chosen, proofs_of_states(oracle, self.timeline.states[rows]), strict=True))


Showable = Viewable | Plan | RobotPlan | StateGraph | Assembly | str | Path | ArrayLike
"""Values that can be shown: objects of this package, a state, or what `open_file` takes."""


def open_file(path: str | Path, structure: AnyStructure | None = None, **options: Any) -> Viewable:
    """Open a plan, run, robot plan, state graph or structure, whichever the file is.

    Args:
        path: file, folder of a run or of meshes, or the name of a built-in structure.
        structure: structure of a plan, graph or run, where the file does not name it or it has moved.
        options: cell of a robot plan, where the file does not name it or it has moved; `direction`, the order in which
            steps are shown; `robots`, the number of robots of a structure; and those of `load_structure`.

    Raises:
        InputError: nothing that can be shown.
        DependencyError: a run without torch.
    """
    check_options(open_file, options, viewable_options())
    return replace(viewable_of(path, structure, **options), file=Path(path))


def viewable_of(
    subject: Showable,
    structure: AnyStructure | None = None,
    *,
    cell: AnyCell | None = None,
    direction: Direction = Direction.ASSEMBLY,
    robots: int = 2,
    **options: Any,
) -> Viewable:
    """Make a file or an object viewable.

    Args:
        subject: what `open_file` takes, a plan, robot plan, state graph or assembly, or a state of shape (parts,) of
            the given structure.
        structure: as for `open_file`, like the rest.
    """
    if isinstance(subject, Viewable):
        return subject
    file = Path(subject) if isinstance(subject, (str, Path)) else None
    known: Any = _opened(subject, structure, options) if isinstance(subject, (str, Path)) else subject

    if cell is not None and not isinstance(known, RobotPlan):
        raise InputError(f"the cell {cell} is of a robot plan, which this is not; leave it out")

    def still(assembly: Assembly, state: ArrayLike) -> Timeline:
        return Timeline.from_state(assembly, state, robots).turned(direction)

    if isinstance(known, Plan):
        assembly = structure_of_plan(known, file, structure, **options)
        return Viewable("plan", assembly, Timeline.from_plan(known, assembly, direction), known)
    if isinstance(known, RobotPlan):
        assembly = structure_of_plan(known.plan, file, structure, **options)
        arms = Arms(known, _cell_of(known, file, cell, assembly), direction)
        timeline = Timeline.from_plan(
            known.plan, assembly, direction, arms.holders(), tuple(robot.name for robot in known.robots)
        )
        return Viewable("robot plan", assembly, timeline, known.plan, arms=arms)
    if isinstance(known, StateGraph):
        return _graph(known, file, structure, direction, options)
    if isinstance(known, Assembly):
        return Viewable("structure", known, still(known, complete_state(known.boundary)))
    if file is not None:  # a run; a policy disassembles: its next actions are shown for the complete structure
        state, robots = complete_state(known.assembly.boundary), getattr(known.settings, "robots", 2)
        timeline = Timeline.from_state(known.assembly, state, robots).turned(Direction.DISASSEMBLY)
        return Viewable("run", known.assembly, timeline, policy=known.policy)
    if not (isinstance(known, (list, tuple)) or hasattr(known, "__array__")):
        raise InputError(f"{type(known).__name__} cannot be shown; give a plan, structure, state graph, state or file")
    if structure is None:
        raise InputError("a state alone does not say which structure it is of; give the structure too")
    assembly = as_assembly(structure, **options)
    return Viewable("structure", assembly, still(assembly, known))


def viewable_options() -> tuple[str, ...]:
    """Return the names of the options of `viewable_of`."""
    return *load_options(), *(viewable_of.__kwdefaults__ or ())


def _opened(path: str | Path, structure: AnyStructure | None, options: dict[str, Any]) -> Any:
    """Return what a file holds: a plan, robot plan, state graph, run or structure."""
    if Path(path).suffix.lower() == ".toml":
        raise InputError(
            f"{path} is a cell, which has no steps; falsework view and picture show it (view_cell in Python)"
        )
    known = load_own(path)
    if known is None:
        if structure is not None:
            raise InputError(f"{path} is a structure itself; leave --structure out")
        return load_structure(path, **options)
    if structure is None or isinstance(known, (Plan, RobotPlan, StateGraph)):
        return known
    return _load_run(path, as_assembly(structure, **options))


def _cell_of(plan: RobotPlan, file: Path | None, cell: AnyCell | None, assembly: Assembly) -> Cell:
    """Return the cell of a robot plan: the one that is given, else the one that it names, beside its file."""
    from falsework.robots.cells.cell_file import as_cell

    found = as_cell(plan.cell_place(file or "the robot plan") if cell is None else cell)
    plan.check_identity(assembly, found)
    return found


def _load_run(folder: Path | str, assembly: Assembly | None) -> Any:
    from falsework.utils.tensors import check_torch

    check_torch()
    from falsework.learn.training.checkpoint import load_run

    return load_run(folder, assembly=assembly)


def _graph(
    graph: StateGraph,
    file: Path | None,
    structure: AnyStructure | None,
    direction: Direction,
    options: dict[str, Any],
) -> Viewable:
    assembly = structure_of_plan(graph, file, structure, **options)
    if assembly.identity != graph.task.identity:
        raise InputError(
            f"{file or 'the graph'} is of another structure than {assembly.name}; name the right one (--structure)"
        )
    route = graph.sample_route(np.random.default_rng(0))
    if route is None:
        still = Timeline.from_state(assembly, graph.task.start, graph.task.robots).turned(direction)
        return Viewable("graph", assembly, still, graph=graph)
    states = route.states[::-1]
    who = holders(states, assembly.boundary)
    timeline = Timeline(assembly, states, route.actions[::-1], who, direction, graph.task.robots)
    return Viewable("graph", assembly, timeline, graph=graph)
