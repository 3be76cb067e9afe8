"""The plan: steps in the order of assembly, with the verdict on every state."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import pairwise
from typing import TYPE_CHECKING, Any, overload

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.assembly_model import Count, Prop
from falsework.assembly.state import HELD, INSTALLED, REMOVED, Mask, States
from falsework.errors import PlanError
from falsework.geometry.clearance.moves import ExitPath
from falsework.search.margins.plan_margins import PlanMargins
from falsework.search.plans.steps import PlanStep, holders, inserts_several, steps_of, undone
from falsework.search.problem.plan_replay import PlanReplay
from falsework.search.problem.result import Route
from falsework.search.problem.task import Direction, Task
from falsework.search.together.exits import exit_path
from falsework.stability.certificate import StabilityCriterion
from falsework.stability.contact.hold_loads import Loads
from falsework.stability.holds import Press
from falsework.stability.state_arrays import StateArrays
from falsework.stability.verdict import Proof, Verdict, Verdicts
from falsework.utils.display.notebook import Displayed
from falsework.utils.models import FileModel
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly


class PartDeadline(FileModel, frozen=True):
    """Latest step at which a missing part is needed."""

    part: Count
    after_steps: Count
    """Number of assembly steps before it is needed."""
    after_parts: Count
    """Parts that are placed before it."""


def needs_of(states: States, missing: tuple[int, ...]) -> tuple[PartDeadline, ...]:
    """Return when each missing part is inserted, in this order; parts that no step inserts are omitted.

    Args:
        states: of the plan, shape (steps + 1, parts).
        missing: the parts in question.
    """
    there = states != REMOVED
    placed, needs = there.sum(axis=1), []
    for part in missing:
        if there[-1, part] and not there[0, part]:
            step = int(there[:, part].argmax()) - 1
            needs.append(PartDeadline(part, step, int(placed[step] - placed[0])))
    return tuple(sorted(needs, key=lambda need: need.after_steps))


def _exit_paths(route: Route, task: Task, props: tuple[Prop, ...]) -> tuple[ExitPath, ...]:
    """Return the moves of each step of a route, in the order of assembly; none for steps without or straight ones.

    Args:
        route: states of the parts, and of some of the props of the task.
        task: knows ways out.
    """
    if task.clearance is None or (task.moves_out == 1 and not task.turns):
        return ()
    bare, found = task.part_count - len(task.props), []
    states = np.zeros((len(route.states), task.part_count), dtype=np.uint8)
    states[:, [*range(bare), *(bare + task.props.index(prop.part) for prop in props)]] = route.states
    for before, state in pairwise(states[::-1]):
        leaving = tuple(np.flatnonzero((before[:bare] == REMOVED) & (state[:bare] != REMOVED)).tolist())
        found.append((exit_path(task, state, leaving) if leaving else ()) or ())
    return tuple(found)


@dataclass(frozen=True, eq=False)
class Plan(Displayed):
    """Steps of an assembly whose states are all proven stable.

    A plan is the sequence of its steps, always in the order of assembly: `len(plan)`, `plan[0]`, `for step in plan`.
    Disassembly undoes the last step first, see `in_order`. Searches work with routes, in the order of disassembly; `of`
    turns a route into a plan.
    """

    states: States
    """State at first, and after each step; shape (steps + 1, parts)."""
    actions: NDArray[np.int64]
    """Steps as numbers, shape (steps,): `parts + i` inserts part `i`, held by a robot, and `i` releases it. With
    `allow_regrasp`, `i` holds or releases part `i`, whichever it is not; `parts + i` inserts or removes a prop. Where a
    step inserts several parts, `i` is the first that a robot holds; see `PlanStep.parts`."""
    verdicts: tuple[Verdict, ...]
    """One a state."""
    proofs: tuple[Proof, ...]
    """One a state."""
    residuals: NDArray[np.float64]
    """Residual of each state, a share of gravity (see `Verdicts`), shape (steps + 1,)."""
    name: str
    """Name of the structure."""
    identity: str
    """Digest of the structure, `Assembly.identity`."""
    part_names: tuple[str, ...]
    boundary: Mask
    """Shape (parts,)."""
    friction: float
    robots: int
    claim: StabilityCriterion = field(default_factory=StabilityCriterion)
    """Stability criterion of the verdicts: cone, gravity, tolerance, bound on forces."""
    fixed: tuple[int, ...] = ()
    """Parts that the task excluded from all actions."""
    missing: tuple[int, ...] = ()
    """Parts that were not delivered yet when the plan was made."""
    removable_only_if_clear: bool = False
    """Whether every part that is removed has a free straight exit."""
    allow_regrasp: bool = False
    """Whether parts may be released without being removed, and held again."""
    props: tuple[Prop, ...] = ()
    """Props of the plan, which are the last parts."""
    prop_limit: int = 0
    """Props that may be in place at a time."""
    parts_at_once: int = 1
    """Parts that a step may insert at most; 1 if none inserts more."""
    moves: int = 1
    """Moves of a way out at most; 1 if every part leaves in one."""
    turns: bool = False
    """Whether parts turn on their ways out."""
    waiting: bool = False
    """Whether parts wait half way out on them, standing without a robot."""
    exit_paths: tuple[ExitPath, ...] = ()
    """Moves in which the part of each step leaves, one entry a step; an entry is empty where it leaves in a straight
    line, and all is where every part does. Insertion undoes them, the last one first."""
    source: Mapping[str, Any] | None = None
    """Where the structure came from: `built_in` or `path` (relative to the file of the plan), and the options of
    `load_structure` that were given; None if unknown."""
    forces: NDArray[np.float64] | StateArrays | None = None
    """Contact forces `(n, t1, t2)` of each state in N, the proof under `equilibrium`, shape (steps + 1, points, 3);
    those of searches take memory only for what changes from state to state."""
    displacement: NDArray[np.float64] | None = None
    """Proof of each state under `contact`: displacements of the parts in m and rad in the increments of the
    step that leads to it, shape (steps + 1, increments, parts, 6)."""
    torn: Mask | None = None
    """With it: contact points that have lost their tensile strength, shape (steps + 1, points)."""
    presses: tuple[tuple[Press, ...], ...] = ()
    """Presses of robots in each step, one entry a step; empty where there are none."""
    loads: Loads = ()
    """What robots bear in each state, the larger of what it is under the true friction and with the reserve, one entry
    a state; empty where it is not known."""
    replay: PlanReplay | None = None
    """Result of the replay with contact history; None if there was none."""
    margins: PlanMargins | None = None
    """Margins that its states keep; None if none were required."""

    @classmethod
    def from_route(
        cls,
        route: Route,
        assembly: Assembly,
        task: Task,
        verdicts: Verdicts,
        claim: StabilityCriterion = StabilityCriterion(),
        *,
        proven: bool = True,
    ) -> Plan:
        """Plan along a route, which is turned into the order of assembly here.

        Args:
            route: states and actions, in the order of disassembly.
            verdicts: of the states of the route in the order of assembly, with forces if the plan is to carry its
                proofs.
            proven: whether all of them must be stable.

        Raises:
            PlanError: a state that the verdicts do not call stable, though it must be.
        """
        bad = np.flatnonzero(~verdicts.stable)
        if len(bad) and proven:
            raise PlanError(f"state {bad[0]} of the plan is not proven stable; plan again")
        exit_paths = _exit_paths(route, task, assembly.props)
        return cls(
            states=route.states[::-1].copy(),
            actions=route.actions[::-1].copy(),
            verdicts=tuple(map(Verdict, verdicts.verdict.tolist())),
            proofs=tuple(map(Proof, verdicts.proof.tolist())),
            residuals=verdicts.residual,
            name=assembly.name,
            identity=assembly.identity,
            part_names=tuple(assembly.names),
            boundary=assembly.boundary,
            friction=assembly.friction,
            robots=task.robots,
            claim=claim,
            fixed=task.fixed,
            missing=task.missing,
            removable_only_if_clear=task.clearance is not None,
            allow_regrasp=bool(((route.states[:-1] == HELD) & (route.states[1:] == INSTALLED)).any())
            or bool(assembly.props),
            props=assembly.props,
            prop_limit=task.prop_limit if assembly.props else 0,
            parts_at_once=1 if task.together is None or not inserts_several(route.states) else task.together.largest,
            moves=task.moves_out if any(exit_paths) else 1,
            turns=any(move.turns for way in exit_paths for move in way),
            waiting=task.waiting and any(exit_paths),
            exit_paths=exit_paths if any(exit_paths) else (),
            forces=verdicts.forces,
        )

    def __len__(self) -> int:
        return len(self.actions)

    def __iter__(self) -> Iterator[PlanStep]:
        return iter(self.steps)

    @overload
    def __getitem__(self, index: int) -> PlanStep: ...

    @overload
    def __getitem__(self, index: slice) -> tuple[PlanStep, ...]: ...

    def __getitem__(self, index: int | slice) -> PlanStep | tuple[PlanStep, ...]:
        try:
            return self.steps[index]
        except IndexError:
            raise IndexError(f"index {index}: the plan has {counted(len(self), 'step')}, from index 0") from None

    def __repr__(self) -> str:
        return (
            f"<Plan of {self.name}: {counted(len(self), 'step')} with {counted(self.robots, 'robot')}, "
            f"criterion {self.claim.criterion}>"
        )

    @cached_property
    def steps(self) -> tuple[PlanStep, ...]:
        """Steps in the order of assembly; the first has the number 1 and the index 0."""
        return steps_of(self.states, self.actions, self.holders, self.verdicts, self.part_names, self.presses)

    def in_order(self, direction: Direction) -> tuple[PlanStep, ...]:
        """Return the steps as they are done in assembly, or in disassembly, in which the last one is undone first.

        In disassembly a step keeps its number, but holds where that of assembly releases, and removes where it
        inserts; its state is the one before.
        """
        if Direction(direction) is Direction.ASSEMBLY:
            return self.steps
        return undone(self.steps, self.states[0], self.verdicts[0])

    def with_ways(self, ways: Iterable[ExitPath], *others: Plan) -> Plan:
        """Return the plan with the ways of its steps, and the rules of the plans that the ways are of."""
        ways = tuple(ways)
        if not any(ways):
            return self
        return replace(
            self,
            exit_paths=ways,
            moves=max(plan.moves for plan in others),
            turns=any(move.turns for way in ways for move in way),
            waiting=any(plan.waiting for plan in others),
        )

    @cached_property
    def holders(self) -> NDArray[np.int64]:
        """Robot that holds each part in each state, `NO_ROBOT` for none; shape (steps + 1, parts)."""
        return holders(self.states, self.immovable)

    @property
    def immovable(self) -> Mask:
        """Parts that never move and that no robot holds, boundary and props; shape (parts,)."""
        mask = self.boundary.copy()
        mask[len(mask) - len(self.props) :] = True
        return mask

    @property
    def route(self) -> Route:
        """States and actions alone, in the order of disassembly."""
        return Route(self.states[::-1], self.actions[::-1])

    @property
    def needs(self) -> tuple[PartDeadline, ...]:
        """When each missing part is needed, in order; parts that the plan does not touch are omitted."""
        return needs_of(self.states, self.missing)

    def words(self, number: int) -> str:
        """Describe the step of a number, such as `insert keystone`, with the presses of robots; empty for 0."""
        return self.steps[number - 1].words if number else ""

    def line(self, number: int) -> str:
        """Return a line of a list of steps, such as `  30  insert keystone (R1)`; 0 is the start."""
        return f"{number:4d}  {self.steps[number - 1] if number else 'start'}"

    @property
    def presses_before(self) -> tuple[tuple[Press, ...], ...]:
        """Presses of the step that leads to each state, one entry a state."""
        return ((), *(self.presses or ((),) * len(self.actions)))

    def proof_arrays(self) -> NDArray[np.float64] | StateArrays | None:
        """Return the certificates of the states under the plan's criterion, if the plan has them."""
        return self.displacement if self.claim.criterion == "contact" else self.forces

    @property
    def inserted_parts(self) -> NDArray[np.int64]:
        """Parts that the plan inserts, in order."""
        parts = len(self.boundary)
        return self.actions[self.actions >= parts] - parts
