"""Keyframes: configurations of all robots in a state, and the motions of one robot from one to the next."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence, Set
from dataclasses import dataclass, field, replace
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, INSTALLED, REMOVED, States
from falsework.geometry.clearance.moves import ExitPath
from falsework.robots.model.shapes import Array
from falsework.robots.motion.collision_world import Attached, CollisionQuery, Scene
from falsework.search.problem.result import Route

_MOST_HAND_OVERS = 2
"""Hand-overs of a part between two removals: to another robot, and back with another grasp."""
_MOST_REPEATS = 2
"""Dead ends with the same arms at the same parts, after which other grasps of these arms are not tried."""
_HOME = 1e-9
"""Largest entry of a displacement from its place that a part at its place has."""


@dataclass(frozen=True, eq=False)
class CarriedLoad(Attached):
    """Part in a gripper away from its place."""

    gripped: Array
    """Configuration in which the robot would hold it at its place, shape (joints,)."""


@dataclass(frozen=True, eq=False)
class Node:
    """Keyframe: a state and the configurations of the robots."""

    state: States
    """Shape (parts,)."""
    configurations: tuple[Array, ...]
    held: tuple[int | None, ...]
    """The part that each robot holds; in the middle of a hand-over two robots hold the same one."""
    changed: frozenset[tuple[int, bytes]] = frozenset()
    """Parts held or released since a part was last removed; those released, or handed over, with the grip that they
    had."""
    carried: tuple[CarriedLoad | None, ...] = ()
    """What each robot carries; empty: none carries anything. Of the parts of the state these are aside for a time."""
    waits: tuple[tuple[int, Array], ...] = ()
    """Parts of the state that wait in the midst of a way, in no gripper: displacements from their places, (4, 4)."""
    following: tuple[Edge, ...] = ()
    """Edges that come next, in the midst of a way."""

    @cached_property
    def present(self) -> NDArray[np.bool_]:
        """Which parts are in place, shape (parts,)."""
        found = self.state != REMOVED
        found[[load.part for load in self.carried if load is not None]] = False
        found[[part for part, _ in self.waits]] = False
        return found

    @cached_property
    def key(self) -> bytes:
        """Key that is equal for equal nodes."""
        rounded = np.round(np.concatenate(self.configurations), 6) + 0.0
        released = sorted(entry for entry in self.changed if entry[1])
        carried = [None if load is None else load.part for load in self.carried]
        return (
            self.state.tobytes()
            + rounded.tobytes()
            + repr((self.held, released, carried, len(self.following))).encode()
        )

    @property
    def scene(self) -> Scene:
        """The node as a scene of the collision world."""
        return Scene(self.configurations, self.present, self.carried or (None,) * len(self.held), self.waits)

    def can_release(self, part: int) -> bool:
        """Return whether a part is held since before a part was last removed; others need not have been held."""
        return part in self.held and all(part != other for other, _ in self.changed)

    def can_hand_over(self, part: int) -> bool:
        """Return whether a part is held as since before a part was last removed, or was handed over once since then."""
        times = sum(part == other for other, grip in self.changed if grip)
        return part in self.held and (part, b"") not in self.changed and times < _MOST_HAND_OVERS

    @property
    def handed(self) -> int | None:
        """The part that two robots hold."""
        return next((part for part, count in Counter(self.held).items() if part is not None and count > 1), None)

    def holder(self, part: int) -> int:
        """Return the robot that holds a part; of two robots the one that held it first."""
        robots = [robot for robot, held in enumerate(self.held) if held == part]
        return next((k for k in robots if not self.is_new(part, k, self.configurations[k])), robots[0])

    def is_new(self, part: int, robot: int, values: Array) -> bool:
        """Return whether no robot released a part from this grip since a part was last removed."""
        return (part, _grip(robot, values)) not in self.changed

    def was_released(self, part: int) -> bool:
        """Return whether a part was released, or handed over, since a part was last removed."""
        return any(part == other and grip for other, grip in self.changed)

    @property
    def hands(self) -> tuple[int | None, ...]:
        """The part that each robot holds, or carries."""
        loads = map(self.load, range(len(self.held)))
        return tuple(part if load is None else load.part for part, load in zip(self.held, loads, strict=True))

    def load(self, robot: int) -> CarriedLoad | None:
        """Return what a robot carries."""
        return self.carried[robot] if self.carried else None

    def moved(self, robot: int, values: Array, load: CarriedLoad | None) -> Node:
        """Return the keyframe with one robot in another configuration, shape (joints,), and with another load."""
        configurations, carried = list(self.configurations), list(self.carried or (None,) * len(self.held))
        configurations[robot], carried[robot] = np.asarray(values), load
        kept = tuple(carried) if any(entry is not None for entry in carried) else ()
        return replace(self, configurations=tuple(configurations), carried=kept)

    def carrying(
        self, loads: Mapping[int, CarriedLoad], configurations: tuple[Array, ...], *, stay: bool = False
    ) -> Node:
        """Return the keyframe after robots have moved the parts that they hold, and carry them.

        They have removed them, unless the parts `stay` in the state, aside for a time.
        """
        state, held = self.state.copy(), list(self.held)
        for robot, load in loads.items():
            held[robot] = None
            if not stay:
                state[load.part] = REMOVED
        carried = tuple(loads.get(robot, self.load(robot)) for robot in range(len(held)))
        changed = self.changed if stay else frozenset()
        return Node(state, configurations, tuple(held), changed, carried, self.waits)

    def taken(self, robot: int, values: Array, load: CarriedLoad) -> Node:
        """Return the keyframe after a robot has taken a part where it waits, or stands, in a configuration, (joints,).

        It carries the part from then on.
        """
        waits = tuple(entry for entry in self.waits if entry[0] != load.part)
        return replace(self.moved(robot, values, load), waits=waits)

    def left(self, part: int, pose: Array) -> Node:
        """Return the keyframe after a robot has let go of a part that waits, or is at its place again.

        The pose is the displacement from its place, shape (4, 4).
        """
        robot, held = self.hands.index(part), list(self.held)
        node = self.moved(robot, self.configurations[robot], None)
        held[robot] = None
        home = self.state[part] != HELD and np.abs(pose - np.eye(4)).max() <= _HOME
        return replace(node, held=tuple(held), waits=self.waits if home else (*self.waits, (part, pose)))

    def back(self, holders: Mapping[int, int], ends: Mapping[int, Array], home: Set[int]) -> Node:
        """Return the keyframe after robots have moved parts on, some of them to their places, where they hold them."""
        node, held = self, list(self.held)
        for part, robot in holders.items():
            node = node.moved(robot, ends[robot], None if part in home else node.load(robot))
            held[robot] = part if part in home else None
        return replace(node, held=tuple(held))

    def after(self, action: int, robot: int, values: Array) -> Node:
        """Return the keyframe after an action as of `state_after`, or half of a hand-over of a held part."""
        configurations, held = list(self.configurations), list(self.held)
        configurations[robot] = np.asarray(values)
        if action in held[:robot] + held[robot + 1 :]:
            giver = self.holder(action)
            held[robot] = action if held[robot] is None else None
            given = (action, _grip(giver, self.configurations[giver]))
            changed = self.changed | {given}
            return replace(self, configurations=tuple(configurations), held=tuple(held), changed=changed)
        part, state = action % len(self.state), state_after(self.state, action)
        held[robot] = part if state[part] == HELD else None
        changed: frozenset[tuple[int, bytes]] = frozenset()
        if state[part] != REMOVED:
            changed = self.changed | {(part, b"" if state[part] == HELD else _grip(robot, self.configurations[robot]))}
        return Node(state, tuple(configurations), tuple(held), changed, self.carried, self.waits)


@dataclass(eq=False)
class DeadEnds:
    """Dead ends of one search."""

    keys: set[bytes] = field(default_factory=set)
    """Keys of keyframes."""
    arms: Counter[tuple[bytes, tuple[int | None, ...]]] = field(default_factory=Counter)
    """Number of dead ends in each state with the same arms at the held parts."""

    def add(self, node: Node) -> None:
        """Count a keyframe as a dead end."""
        self.keys.add(node.key)
        self.arms[node.state.tobytes(), node.held] += 1

    def __contains__(self, node: Node) -> bool:
        return node.key in self.keys

    def repeated(self, node: Node, action: int, robot: int) -> bool:
        """Return whether an action of a robot leads to arms at parts with which dead ends are frequent."""
        after, held = state_after(node.state, action), list(node.held)
        held[robot] = action if action < len(after) and after[action] == HELD else None
        return self.arms[after.tobytes(), tuple(held)] >= _MOST_REPEATS

    def clear(self) -> None:
        """Try everything again."""
        self.keys.clear()
        self.arms.clear()


@dataclass(frozen=True, eq=False)
class PathSegment:
    """Path of one robot without time parameterisation."""

    kind: str
    """`free` or `line`."""
    path: Array
    """Shape (points, joints)."""
    part: int | None = None
    touches: int | None = None
    view: CollisionQuery | None = None
    """Collision queries of the scene in which a free path was planned."""


@dataclass(frozen=True, eq=False)
class Edge:
    """Executed action."""

    action: int
    robot: int
    segments: tuple[PathSegment, ...]
    node: Node
    """Keyframe after the action."""
    hands_over: bool = False
    """Whether it is half of a hand-over, which changes no state: `action` is the part."""
    put_down: Array | None = None
    """Where the part lies while its robot changes its grasp: displacement from its place, shape (4, 4)."""
    transit: bool = False
    """Whether the robot only goes to another place; the action is -1."""
    way: ExitPath = ()
    """Way on which the part of a removal leaves."""
    partners: tuple[tuple[int, tuple[PathSegment, ...]], ...] = ()
    """Other robots that move their own parts at the same instant, with as many segments, of as many points."""


def _grip(robot: int, values: Array) -> bytes:
    """Return the key of a grip: arms around a structure may have the same joint values."""
    return bytes([robot]) + values.tobytes()


def set_action(parts: Sequence[int], count: int) -> int:
    """Return the action that removes held parts at the same instant: twice the count of all, and a bit for each."""
    return 2 * count + sum(1 << part for part in parts)


def removed_by(action: int, count: int) -> list[int]:
    """Return the parts that an action removes, of a structure of so many parts."""
    if action < 2 * count:
        return [action - count] if action >= count else []
    return [part for part in range(count) if (action - 2 * count) >> part & 1]


def state_after(state: States, action: int) -> States:
    """Return the state after an action: `i` holds part `i`, or releases it if it is held; `parts + i` removes it.

    Those of `set_action` remove several.
    """
    after, removed = state.copy(), removed_by(action, len(state))
    if removed:
        after[removed] = REMOVED
    else:
        after[action] = INSTALLED if state[action] == HELD else HELD
    return after


def accept_all(_: Edge) -> bool:
    """Accept every edge."""
    return True


def route_along(root: Node, chain: Sequence[Edge]) -> Route:
    """Return the states and actions of a chain of edges, hand-overs and transits left out."""
    chain = [edge for edge in chain if not (edge.hands_over or edge.transit)]
    states: States = np.array([root.state, *(edge.node.state for edge in chain)], dtype=np.uint8)
    count = len(root.state)
    actions = [count + min(removed) if (removed := removed_by(edge.action, count)) else edge.action for edge in chain]
    return Route(states, np.array(actions, dtype=np.int64))
