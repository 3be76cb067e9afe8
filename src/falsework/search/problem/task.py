"""Planning task: start and target states, number of robots, and extra rules."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from enum import StrEnum
from functools import cached_property
from operator import index
from typing import TYPE_CHECKING, Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.state import (
    HELD,
    INSTALLED,
    REMOVED,
    Mask,
    States,
    apply_actions,
    as_states,
    check_robots,
    complete_state,
    held_count,
    undo_actions,
)
from falsework.errors import InputError, StateError
from falsework.geometry.clearance.protocol import Clearance
from falsework.search.problem.legal_moves import LegalMoves
from falsework.search.problem.oracle import Criterion
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.search.problem.part_sets import InterlockedSets

STAGE = np.array([2, 0, 1], dtype=np.int64)
"""Steps of disassembly that a part has behind it, indexed by its value: installed 0, held 1, removed 2."""


class Direction(StrEnum):
    """Order in which a search visits the states between start and target."""

    DISASSEMBLY = "disassembly"
    """From the start state, by holding and removing; a removal needs a verdict."""
    ASSEMBLY = "assembly"
    """From the target state, by inserting and releasing; a release needs a verdict."""

    @classmethod
    def _missing_(cls, value: object) -> Direction:
        raise InputError(f"there is no direction {value!r}; give {' or '.join(cls)}")


@dataclass(frozen=True, eq=False)
class Task:
    """Rules between a start and a target state of one structure; build it with `Task.from_rules`.

    Every part passes through installed, held, removed in this order and never back, so all plans of a task
    have the same number of steps, and states can be sorted into levels by the steps they are away from the start.
    """

    boundary: Mask
    """Shape (parts,)."""
    robots: int
    start: States
    """Shape (parts,)."""
    target: States
    """Shape (parts,)."""
    fixed: tuple[int, ...] = ()
    """Parts that are never touched."""
    missing: tuple[int, ...] = ()
    """Parts not delivered yet, which assembly defers as long as possible."""
    postponed: tuple[int, ...] = ()
    """Entry `k`: assembly steps to be done before the `k + 1`-th missing part is inserted. Ascending."""
    clearance: Clearance | None = None
    """Where given, a part is removed only if it can leave."""
    identity: str = ""
    """Hash of the structure, so that saved searches are not mixed up."""
    neighbours: Mask | None = None
    """Which movable parts are in contact, shape (parts, parts); a search that has it learns from failures."""
    holds_keep_stable: bool = False
    """Whether a stable state stays stable when a part of it is held, so that holds need no verdict; see `judged_by`."""
    allow_regrasp: bool = False
    """Whether a held part may be released without being removed, and held again."""
    props: tuple[int, ...] = ()
    """Part above each prop; the props are the last parts of the structure, and no robot holds them."""
    prop_limit: int = 0
    """Props that may be in place at a time."""
    together: InterlockedSets | None = None
    """Rule on several parts in one step; None where every step moves one part."""

    def __repr__(self) -> str:
        first, last = (int((state != REMOVED).sum()) for state in (self.start, self.target))
        return f"<Task for {counted(self.robots, 'robot')}: from {first} to {last} of {len(self.boundary)} parts>"

    @classmethod
    def from_rules(
        cls,
        boundary: ArrayLike,
        robots: int = 2,
        *,
        start: ArrayLike | None = None,
        target: ArrayLike | None = None,
        fixed: Sequence[int] = (),
        missing: Sequence[int] = (),
        clearance: Clearance | None = None,
        contacts: ArrayLike | None = None,
        identity: str = "",
        allow_regrasp: bool = False,
        props: Sequence[int] = (),
        prop_limit: int = 0,
        together: InterlockedSets | None = None,
    ) -> Task:
        """Validate a task and fill in defaults; arguments that are not described are fields.

        Args:
            boundary: which parts are boundary, shape (parts,).
            robots: number of parts that may be held at once.
            start: state to disassemble from, shape (parts,); the complete structure if not given.
            target: state to end in, shape (parts,); by default nothing is left but the boundary and `fixed`.
            fixed: parts that must be neither held nor removed.
            contacts: pairs of parts in contact, shape (pairs, 2).
            props: part above each prop; the last parts of the structure are props, absent from a start or target that
                is not given.
            together: rule on several parts in one step; needs `clearance`.

        Raises:
            InputError: fewer than one robot, missing parts with allow_regrasp, several parts at once without clearance,
                or a part number out of range, doubled, or of the boundary.
            StateError: a malformed state, more parts held than robots, or a target that no rule leads to.
        """
        boundary = np.asarray(boundary, dtype=bool)
        robots = check_robots(robots)
        fixed = _part_numbers(fixed, boundary, "fixed", boundary_allowed=True)
        missing = _part_numbers(missing, boundary, "missing", boundary_allowed=False)
        if missing and allow_regrasp:
            raise InputError("plans with repeated holds take no missing parts; leave out one of the two")
        if together is not None and clearance is None:
            raise InputError("several parts leave in one step only where parts need a way out; give a clearance")
        if start is None:
            start = complete_state(boundary)
            start[len(boundary) - len(props) :] = REMOVED
        first = _one_state(start, boundary, "start")
        if target is None:
            last = np.where(boundary, HELD, REMOVED).astype(np.uint8)
            last[list(fixed)] = first[list(fixed)]
        else:
            last = _one_state(target, boundary, "target")
        for part in fixed:
            if first[part] != last[part]:
                raise StateError(f"part {part} is fixed but differs between start and target; make them agree")
        for part in missing:
            if first[part] == REMOVED:
                raise StateError(f"part {part} is missing but not in the start either, so never needed; leave it out")
            if last[part] != REMOVED:
                raise StateError(
                    f"part {part} is missing but already in place where assembly starts; take it out of that state, or "
                    "out of the missing parts"
                )
        immovable = boundary.copy()
        immovable[len(boundary) - len(props) :] = True
        _check_order(first, last, immovable, allow_regrasp)
        for name, state in (("start", first), ("target", last)):
            held = int(held_count(state[None], immovable)[0])
            if held > robots:
                hold = counted(robots, "robot")
                raise StateError(f"the {name} state has {counted(held, 'part')} held; {hold} can hold {robots}")
        for array in (boundary, first, last):
            array.setflags(write=False)
        neighbours = None
        if contacts is not None:
            a, b = np.asarray(contacts, dtype=np.int64).reshape(-1, 2).T
            neighbours = np.zeros((len(boundary), len(boundary)), dtype=bool)
            neighbours[a, b] = neighbours[b, a] = True
            neighbours &= ~boundary[:, None] & ~boundary
        order = (0,) * len(missing)
        return cls(
            boundary, robots, first, last, fixed, missing, order, clearance, identity, neighbours,
            allow_regrasp=allow_regrasp, props=tuple(props), prop_limit=prop_limit, together=together,
        )  # fmt: skip

    @property
    def part_count(self) -> int:
        """Number of parts, boundary included."""
        return len(self.boundary)

    @cached_property
    def steps(self) -> int:
        """Number of steps of every plan."""
        parts = self.part_count - len(self.props)
        props = int((self.target[parts:] != self.start[parts:]).sum())
        return int(STAGE[self.target[:parts]].sum() - STAGE[self.start[:parts]].sum()) + props

    @property
    def is_done(self) -> bool:
        """Whether start and target are one state; with repeated holds, plans of no `steps` may lead to another."""
        return np.array_equal(self.start, self.target)

    def judged_by(self, oracle: Criterion) -> Task:
        """Return the same task with the moves, and the parts that move aside, that an oracle allows."""
        clearance = None if self.clearance is None else self.clearance.judged_by(oracle, self.robots)
        return replace(self, holds_keep_stable=oracle.holds_keep_stable, clearance=clearance)

    @property
    def caveat(self) -> str:
        """Reason why an exhaustive search so far would not prove that there is no plan; empty if it would."""
        if self.prop_limit:
            return f"props were tried at {len(self.props)} places, one under a part; they may help at others"
        if self.clearance is None:
            return ""
        return self.clearance.caveat((self.start != REMOVED) & (self.target == REMOVED))

    @property
    def moves_out(self) -> int:
        """Moves of a way out at most; 1 for straight ways."""
        return 1 if self.clearance is None else self.clearance.moves

    @property
    def turns(self) -> bool:
        """Whether a part that leaves may turn."""
        return self.clearance is not None and self.clearance.turns

    @property
    def moves_aside(self) -> bool:
        """Whether other parts may move aside while one leaves, held by robots or waiting."""
        return self.moves_out > 1 and (self.robots > 1 or self.waiting)

    @property
    def waiting(self) -> bool:
        """Whether parts may wait half way out, standing without a robot."""
        return self.clearance is not None and self.clearance.waiting

    def postpone(self, postponed: Sequence[int]) -> Task:
        """Return the same task with other lower bounds on when missing parts are inserted."""
        return replace(self, postponed=tuple(int(steps) for steps in postponed))

    def origin(self, direction: Direction) -> States:
        """Return the state that a search in `direction` begins with, shape (parts,)."""
        return self.start if direction is Direction.DISASSEMBLY else self.target

    def goal(self, direction: Direction) -> States:
        """Return the state that a search in `direction` must reach, shape (parts,)."""
        return self.target if direction is Direction.DISASSEMBLY else self.start

    def steps_done(self, states: States) -> NDArray[np.int64]:
        """Return steps of disassembly between the start and each state, shape (batch,)."""
        return STAGE[states].sum(axis=-1) - STAGE[self.start].sum()

    def contains(self, states: States) -> Mask:
        """Return whether states lie between start and target and obey the rules, stability aside. Shape (batch,)."""
        stage = STAGE[states]
        between = ((stage >= STAGE[self.start]) & (stage <= STAGE[self.target])).all(axis=-1)
        inside = between & (held_count(states, self.boundary) <= self.robots)
        if any(self.postponed):
            present = (states[:, list(self.missing)] != REMOVED).sum(axis=1)
            inside &= present <= self._legal[Direction.DISASSEMBLY].missing_allowed(states, 0)
        return inside

    def moves(self, states: States, direction: Direction) -> Mask:
        """Return actions that the rules allow from each state, stability aside.

        Args:
            states: states between start and target, shape (batch, parts).
            direction: in disassembly actions lead out of the states; in assembly they are undone.

        Returns:
            Shape (batch, 2 parts), indexed like `action_mask`.
        """
        return self._legal[direction].legal(states)

    def dead_ends(self, states: States, direction: Direction) -> Mask:
        """Return states from which the goal is certainly out of reach, stability aside. Shape (batch,).

        In assembly parts only block more: one that has no free direction now never will, unless held parts move aside.
        """
        if self.clearance is None or direction is Direction.DISASSEMBLY or self.moves_aside:
            return np.zeros(len(states), dtype=bool)
        to_come = (states == REMOVED) & (self.start != REMOVED)
        return (to_come & ~self.clearance.can_leave(states, to_come)).any(axis=1)

    def fixes(self, actions: NDArray[np.integer], direction: Direction) -> Mask:
        """Return whether moves fix a part: a hold, and in assembly an insertion. Shape (batch,)."""
        holds = np.asarray(actions) < self.part_count
        return holds if direction is Direction.DISASSEMBLY else ~holds

    def needs_verdict(self, actions: NDArray[np.integer], direction: Direction) -> Mask:
        """Return whether moves can make a stable state unstable. Shape (batch,).

        A removal, and in assembly a release, may. Fixing a part leaves every force that balanced the structure
        admissible, so under the criterion `equilibrium` it never does; under `contact` it may, because a part that is
        held no longer presses on its neighbours.
        """
        return ~(self.fixes(actions, direction) & self.holds_keep_stable)

    def moved_value(self, actions: NDArray[np.integer], direction: Direction) -> NDArray[np.uint8]:
        """Return the value that each move gives its part, shape (batch,)."""
        holds = np.asarray(actions) < self.part_count
        if direction is Direction.DISASSEMBLY:
            return np.where(holds, HELD, REMOVED).astype(np.uint8)
        return np.where(holds, INSTALLED, HELD).astype(np.uint8)

    def follow(self, states: States, actions: NDArray[np.integer], direction: Direction) -> States:
        """Return states after one move each. Shapes (batch, parts), (batch,)."""
        step = apply_actions if direction is Direction.DISASSEMBLY else undo_actions
        return step(states, actions)

    def to_dict(self) -> dict[str, object]:
        """Return all that distinguishes this task from another, as plain JSON values."""
        return {
            "identity": self.identity,
            "boundary": np.flatnonzero(self.boundary).tolist(),
            "robots": self.robots,
            "start": self.start.tolist(),
            "target": self.target.tolist(),
            "fixed": list(self.fixed),
            "missing": list(self.missing),
            "postponed": list(self.postponed),
            "removable_only_if_clear": self.clearance is not None,
            "moves": self.moves_out,
            "turns": self.turns,
            "waiting": self.waiting,
            "holds_keep_stable": self.holds_keep_stable,
        }

    @cached_property
    def _legal(self) -> dict[Direction, LegalMoves]:
        can_leave = None if self.clearance is None else self.clearance.can_leave
        return {direction: self.legal_moves("numpy", np.asarray, direction, can_leave) for direction in Direction}

    def legal_moves(
        self,
        space: str,
        put: Callable[[NDArray[Any]], Any],
        direction: Direction,
        can_leave: Callable[[Any, Any], Any] | None,
    ) -> LegalMoves:
        """Return the rules of moves for arrays of some kind.

        Args:
            space: `numpy` or `torch`.
            put: turns an array of numpy into one of these.
            can_leave: which parts of those asked for have a free exit; None where that does not matter.
        """
        touchable = ~self.boundary
        touchable[list(self.fixed)] = False
        postponed = self.postponed if any(self.postponed) else ()
        goal = self.goal(direction)
        return LegalMoves(
            space,
            direction is Direction.ASSEMBLY,
            self.robots,
            put(~self.boundary),
            put(touchable),
            goal=put(goal),
            keeps=bool(((goal == HELD) & ~self.boundary).any()),
            can_leave=can_leave,
            missing=put(np.asarray(self.missing, dtype=np.int64)),
            postponed=put(np.asarray(postponed, dtype=np.int64)),
            steps=self.steps,
            begun=int(2 * (self.start == REMOVED).sum() + (self.start == HELD).sum()),
        )


def _one_state(state: ArrayLike, boundary: Mask, name: str) -> States:
    batch = as_states(state, boundary)
    if len(batch) != 1:
        raise StateError(f"the {name} must be one state, not {len(batch)}")
    return batch[0].copy()


def _part_numbers(parts: Sequence[int], boundary: Mask, name: str, *, boundary_allowed: bool) -> tuple[int, ...]:
    try:
        numbers = tuple(index(part) for part in parts)
    except TypeError:
        raise InputError(f"{name} parts are {parts!r}; give a list of part numbers, such as [3, 4]") from None
    for part in numbers:
        if not 0 <= part < len(boundary):
            raise InputError(f"{name} part {part} does not exist; parts are numbered 0 to {len(boundary) - 1}")
        if boundary[part] and not boundary_allowed:
            raise InputError(f"{name} part {part} is boundary, which is always there; leave it out")
        if numbers.count(part) > 1:
            raise InputError(f"{name} part {part} is listed twice; list it once")
    return tuple(sorted(numbers))


def _check_order(start: States, target: States, immovable: Mask, allow_regrasp: bool) -> None:
    earlier = (STAGE[target] < STAGE[start]) & ~immovable  # props come and go
    backwards = np.flatnonzero(earlier & ((start == REMOVED) | (not allow_regrasp)))
    if len(backwards) == 0:
        return
    part = int(backwards[0])
    word = {REMOVED: "removed", INSTALLED: "installed", HELD: "held"}
    remedy = (
        "disassembly never puts a part back; exchange start and target for an assembly"
        if start[part] == REMOVED
        else "a held part is never released in disassembly; hold it in the target or release it in the start"
    )
    raise StateError(
        f"part {part} is {word[int(start[part])]} in the start and {word[int(target[part])]} in the target: {remedy}"
    )
