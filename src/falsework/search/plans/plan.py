"""The plan: states and actions from start to target, with the verdict on every state."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.prop import Prop
from falsework.assembly.state import HELD, INSTALLED, Mask, States, describe_step
from falsework.errors import PlanError
from falsework.search.margins.plan_margins import PlanMargins
from falsework.search.plans.plan_replay import PlanReplay
from falsework.search.problem.result import Route
from falsework.search.problem.task import Direction, Task
from falsework.stability.certificate import StabilityCriterion
from falsework.stability.holds import Press, describe_presses
from falsework.stability.state_arrays import StateArrays
from falsework.stability.verdict import Verdicts
from falsework.utils.display.notebook import Displayed

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly


@dataclass(frozen=True)
class PartDeadline:
    """Latest step at which a missing part is needed."""

    part: int
    after_steps: int
    """Number of assembly steps before it is needed."""
    after_parts: int
    """Parts that are placed before it."""


def needs_of(
    actions: NDArray[np.int64], direction: Direction, parts: int, missing: tuple[int, ...]
) -> tuple[PartDeadline, ...]:
    """Return when each missing part is inserted, in this order; parts that no action inserts are omitted.

    Args:
        actions: of the plan, shape (steps,).
        direction: which way the plan runs.
        parts: number of parts.
        missing: the parts in question.
    """
    in_order = actions if direction is Direction.ASSEMBLY else actions[::-1]
    placed = np.cumsum(in_order >= parts)
    needs = []
    for part in missing:
        step = np.flatnonzero(in_order == parts + part)
        if len(step):
            needs.append(PartDeadline(part, int(step[0]), int(placed[step[0]]) - 1))
    return tuple(sorted(needs, key=lambda need: need.after_steps))


@dataclass(frozen=True, eq=False)
class Plan(Displayed):
    """Sequence of actions whose states are all proven stable.

    In disassembly action `i` holds part `i` and `parts + i` removes it. A plan for assembly runs the other way:
    action `i` releases part `i`, and `parts + i` inserts it, held by a robot. With `support`, action `i` holds part `i`
    or releases it, whichever it is not, in either direction.
    """

    states: States
    """Shape (steps + 1, parts)."""
    actions: NDArray[np.int64]
    """Action between two states, shape (steps,)."""
    verdicts: NDArray[np.int8]
    """`Verdict` of each state, shape (steps + 1,)."""
    proofs: NDArray[np.int8]
    """`Proof` of each state, shape (steps + 1,)."""
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
    direction: Direction = Direction.DISASSEMBLY
    fixed: tuple[int, ...] = ()
    """Parts that the task excluded from all actions."""
    missing: tuple[int, ...] = ()
    """Parts that were not delivered yet when the plan was made."""
    removable_only_if_clear: bool = False
    """Whether every part that is removed has a free straight exit."""
    support: bool = False
    """Whether parts may be released without being removed, and held again."""
    props: tuple[Prop, ...] = ()
    """Props of the plan, which are the last parts."""
    prop_limit: int = 0
    """Props that may be in place at a time."""
    source: Mapping[str, Any] | None = None
    """Where the structure came from: `built_in` or `path` (relative to the file of the plan), and the options of
    `load_structure` that were given; None if unknown."""
    forces: NDArray[np.float64] | StateArrays | None = None
    """Contact forces `(n, t1, t2)` of each state in N, the proof under `equilibrium`, shape (steps + 1, points, 3);
    those of searches take memory only for what changes from state to state."""
    displacement: NDArray[np.float64] | None = None
    """Proof of each state under `contact`: displacements of the parts in m and rad in the increments of the assembly
    step that leads to it, shape (steps + 1, increments, parts, 6)."""
    torn: Mask | None = None
    """With it: contact points that have lost their tensile strength, shape (steps + 1, points)."""
    presses: tuple[tuple[Press, ...], ...] = ()
    """Presses of robots in each step as it is done in assembly, one entry a step; empty where there are none."""
    replay: PlanReplay | None = None
    """Result of the replay in the order of assembly; None if there was none."""
    margins: PlanMargins | None = None
    """Margins that its states keep; None if none were required."""

    @classmethod
    def of(
        cls,
        route: Route,
        assembly: Assembly,
        task: Task,
        verdicts: Verdicts,
        claim: StabilityCriterion = StabilityCriterion(),
    ) -> Plan:
        """Plan for disassembly along a route.

        Args:
            route: states and actions.
            assembly: the structure.
            task: task of the route.
            verdicts: of the states of the route, with forces if the plan is to carry its proofs.
            claim: stability criterion of the verdicts.

        Raises:
            PlanError: a state that the verdicts do not call stable.
        """
        bad = np.flatnonzero(~verdicts.stable)
        if len(bad):
            raise PlanError(f"state {bad[0]} of the plan is not proven stable; plan again")
        return cls.unproven(route, assembly, task, verdicts, claim)

    @classmethod
    def unproven(
        cls, route: Route, assembly: Assembly, task: Task, verdicts: Verdicts, claim: StabilityCriterion
    ) -> Plan:
        """Plan as `of`, whatever the verdicts are."""
        return cls(
            states=route.states,
            actions=route.actions,
            verdicts=verdicts.verdict,
            proofs=verdicts.proof,
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
            support=bool(((route.states[:-1] == HELD) & (route.states[1:] == INSTALLED)).any()) or bool(assembly.props),
            props=assembly.props,
            prop_limit=task.prop_limit if assembly.props else 0,
            forces=verdicts.forces,
        )

    def __len__(self) -> int:
        return len(self.actions)

    def __repr__(self) -> str:
        return (
            f"<Plan of {self.name}: {self.direction.value} in {len(self)} steps with {self.robots} "
            f"robot{'s' * (self.robots > 1)}, criterion {self.claim.criterion}>"
        )

    @property
    def immovable(self) -> Mask:
        """Parts that never move and that no robot holds, boundary and props; shape (parts,)."""
        mask = self.boundary.copy()
        mask[len(mask) - len(self.props) :] = True
        return mask

    @property
    def route(self) -> Route:
        """States and actions alone, in disassembly order."""
        plan = self if self.direction is Direction.DISASSEMBLY else self.reverse()
        return Route(plan.states, plan.actions)

    @property
    def needs(self) -> tuple[PartDeadline, ...]:
        """When each missing part is needed, in order; parts that the plan does not touch are omitted."""
        return needs_of(self.actions, self.direction, len(self.boundary), self.missing)

    def describe(self, step: int) -> str:
        """Describe a step, such as `hold 7` or `insert keystone`, in assembly with the presses of robots."""
        action = describe_step(self.states[step], self.states[step + 1], self.part_names)
        presses = self.presses[step] if self.presses and self.direction is Direction.ASSEMBLY else ()
        return "; ".join(filter(None, (action, describe_presses(presses, self.part_names))))

    def reverse(self) -> Plan:
        """Return the plan in the other direction: assembly from disassembly, or back."""
        other = Direction.ASSEMBLY if self.direction is Direction.DISASSEMBLY else Direction.DISASSEMBLY
        return replace(
            self,
            states=self.states[::-1].copy(),
            actions=self.actions[::-1].copy(),
            verdicts=self.verdicts[::-1].copy(),
            proofs=self.proofs[::-1].copy(),
            residuals=self.residuals[::-1].copy(),
            forces=None if self.forces is None else self.forces[::-1].copy(),
            displacement=None if self.displacement is None else self.displacement[::-1].copy(),
            torn=None if self.torn is None else self.torn[::-1].copy(),
            presses=self.presses[::-1],
            margins=None if self.margins is None else self.margins.reverse(),
            direction=other,
        )

    @property
    def assembly_states(self) -> States:
        """States in the order of assembly, in which a plan is replayed, shape (steps + 1, parts)."""
        return self.states if self.direction is Direction.ASSEMBLY else self.states[::-1]

    @property
    def assembly_presses(self) -> tuple[tuple[Press, ...], ...]:
        """Presses of the step to each state in the order of assembly, one entry a state."""
        presses = self.presses or ((),) * len(self.actions)
        return ((), *(presses if self.direction is Direction.ASSEMBLY else presses[::-1]))

    def proof_arrays(self) -> NDArray[np.float64] | StateArrays | None:
        """Return the certificates of the states under the plan's criterion, if the plan has them."""
        return self.displacement if self.claim.criterion == "contact" else self.forces

    @property
    def removed_parts(self) -> NDArray[np.int64]:
        """Parts that the plan removes, or inserts, in its order."""
        parts = len(self.boundary)
        return self.actions[self.actions >= parts] - parts
