"""What a picture, a film or the page shows: a plan, a run, a robot plan, a state graph or a structure, told apart."""

from __future__ import annotations

import json
from collections.abc import Iterable
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, Literal

from tyro.conf import Positional, arg

from falsework.cli.command import UNSET, LoadOptions
from falsework.errors import InputError, PlanError

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.search.plans.plan import Plan
    from falsework.search.problem.state_graph import StateGraph
    from falsework.stability.verdict import Criterion
    from falsework.viewer.arms import Arms
    from falsework.viewer.proof import StateProof
    from falsework.viewer.timeline import Timeline


@dataclass(frozen=True, eq=False)
class Subject:
    """What was opened."""

    kind: Literal["plan", "run", "robot plan", "graph", "structure"]
    assembly: Assembly
    timeline: Timeline
    plan: Plan | None = None
    policy: Any = None
    """`torch.nn.Module` of a run."""
    graph: StateGraph | None = None
    arms: Arms | None = None
    """The robots of a robot plan."""

    def with_policy(self, run: str | None) -> Subject:
        """The same with the policy of a run, or as it is without one.

        Raises:
            InputError: no such run, or one for another structure.
            DependencyError: torch is not installed.
        """
        if run is None:
            return self
        from falsework.utils.optional_packages import check_torch

        check_torch()
        from falsework.learn.training.checkpoint import load_run

        return replace(self, policy=load_run(run, assembly=self.assembly).policy)

    def proofs(self, places: Iterable[int], criterion: Criterion) -> dict[int, StateProof]:
        """Verdicts on some states of the timeline, by place."""
        from falsework.stability import Stability, StabilitySettings
        from falsework.viewer.proof import proofs_of_states

        asked = list(places)
        oracle = Stability(self.assembly, StabilitySettings(criterion=criterion))
        states = self.timeline.states[[self.timeline.row(place) for place in asked]]
        return dict(zip(asked, proofs_of_states(oracle, states), strict=True))


@dataclass(frozen=True, kw_only=True)
class SubjectOptions(LoadOptions):
    """Options that say what to look at."""

    spec: Annotated[Positional[str], arg(metavar="WHAT")]
    """Plan, run, robot plan, state graph, or a structure: built-in, folder or file of meshes."""
    structure: Annotated[str | None, arg(metavar="STRUCTURE", help_behavior_hint=UNSET)] = None
    """Structure of the plan or graph, where the file does not name it or it has moved."""
    cell: Annotated[str | None, arg(metavar="CELL", help_behavior_hint=UNSET)] = None
    """Cell of a robot plan, where the file does not name it or it has moved."""
    order: Literal["assembly", "disassembly"] = "assembly"
    """Order in which the steps of a plan are shown."""

    def open(self, robots: int = 2) -> Subject:
        """Tell what it is and read it.

        Args:
            robots: of a structure that no plan says it of.

        Raises:
            InputError: nothing that can be shown; the message says what to do.
        """
        from falsework.cli.loading import load
        from falsework.search.problem.task import Direction
        from falsework.viewer.timeline import Timeline

        path, direction = Path(self.spec), Direction(self.order)
        if path.is_file() and path.suffix.lower() == ".json":
            form = _format_of(path)
            if form.startswith("falsework.plan/"):
                return self._plan(path, direction)
            if form.startswith("falsework.robot"):
                return self._robot_plan(path, direction)
            if form and not form.startswith("falsework.assembly/"):
                raise InputError(f"{path} has format {form!r}, which is nothing to look at; give a plan or a structure")
            if path.name == "assembly.json":
                path = path.parent
        elif path.is_file() and path.suffix.lower() == ".npz":
            return self._graph(path, direction)
        elif path.is_dir() and (path / "run.json").is_file():
            return self._run(path)
        if self.structure is not None:
            raise InputError(f"{self.spec} is a structure itself; leave --structure out")
        from falsework.assembly.state import complete_state

        assembly = load(str(path) if path.exists() else self.spec, **self.given())
        still = Timeline.still(assembly, complete_state(assembly.boundary), robots)
        return Subject("structure", assembly, still.turned(direction))

    def _plan(self, path: Path, direction: Any) -> Subject:
        from falsework.cli.loading import structure_of
        from falsework.search.plans.plan_file import load_plan
        from falsework.viewer.timeline import Timeline

        plan = load_plan(path)
        assembly = structure_of(plan, path, self.structure, **self.given())
        return Subject("plan", assembly, Timeline.of(plan, assembly, direction), plan)

    def _robot_plan(self, path: Path, direction: Any) -> Subject:
        from falsework.cli.loading import structure_of
        from falsework.robots.cells.cell_file import load_cell
        from falsework.robots.plans.robot_plan_file import load_robot_plan
        from falsework.viewer.arms import Arms
        from falsework.viewer.timeline import Timeline

        robot_plan = load_robot_plan(path)
        assembly = structure_of(robot_plan.plan, path, self.structure, **self.given())
        source = self.cell if self.cell is not None else robot_plan.cell_source
        if source is None:
            raise InputError(f"{path} does not say where its cell is; name it with --cell")
        beside = path.resolve().parent / source
        cell = load_cell(str(beside) if self.cell is None and beside.is_file() else source)
        robot_plan.check_identity(assembly, cell)
        arms = Arms(robot_plan, cell, direction)
        timeline = Timeline.of(robot_plan.plan, assembly, direction, arms.holders())
        return Subject("robot plan", assembly, timeline, robot_plan.plan, arms=arms)

    def _run(self, path: Path) -> Subject:
        from falsework.assembly.state import complete_state
        from falsework.search.problem.task import Direction
        from falsework.utils.optional_packages import check_torch
        from falsework.viewer.timeline import Timeline

        check_torch()
        from falsework.learn.training.checkpoint import load_run

        given = None
        if self.structure is not None:
            from falsework.cli.loading import load

            given = load(self.structure, **self.given())
        run = load_run(path, assembly=given)
        robots = getattr(run.settings, "robots", 2)
        still = Timeline.still(run.assembly, complete_state(run.assembly.boundary), robots)
        # A policy takes apart: from the complete structure its next actions are there to be seen.
        return Subject("run", run.assembly, still.turned(Direction.DISASSEMBLY), policy=run.policy)

    def _graph(self, path: Path, direction: Any) -> Subject:
        import numpy as np

        from falsework.assembly.library import is_built_in
        from falsework.cli.loading import load
        from falsework.search.problem.state_graph import load_state_graph
        from falsework.viewer.timeline import Timeline, holders

        graph = load_state_graph(path)
        spec = self.structure
        if spec is None:
            if not is_built_in(graph.name):
                raise InputError(f"{path} does not say where {graph.name or 'its structure'} is; add --structure")
            spec = graph.name
        assembly = load(spec, **self.given())
        if assembly.identity != graph.task.identity:
            raise InputError(f"{path} is of another structure than {assembly.name}; name the right one (--structure)")
        route = graph.sample_route(np.random.default_rng(0))
        if route is None:
            still = Timeline.still(assembly, graph.task.start, graph.task.robots)
            return Subject("graph", assembly, still.turned(direction), graph=graph)
        who = holders(route.states, assembly.boundary)
        timeline = Timeline(assembly, route.states, route.actions, who, direction, graph.task.robots)
        return Subject("graph", assembly, timeline, graph=graph)


def _format_of(path: Path) -> str:
    """What a JSON file says that it is; empty if it does not say.

    Raises:
        PlanError: it is no JSON.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (OSError, UnicodeDecodeError, ValueError, RecursionError):
        raise PlanError(f"{path} is not valid JSON; it may be truncated; write it again") from None
    form = content.get("format") if isinstance(content, dict) else None
    return form if isinstance(form, str) else ""
