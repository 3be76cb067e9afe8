"""State graph: the states that a search found, with every valid action between them (paper, section 5.1)."""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from dataclasses import dataclass, replace
from functools import cached_property
from itertools import pairwise
from pathlib import Path
from typing import Any, get_args

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.state import HELD, Mask, States
from falsework.errors import InputError
from falsework.search.problem.hashing import StateHash, StateIndex, chunks, merge
from falsework.search.problem.result import Route
from falsework.search.problem.task import Direction, Task
from falsework.stability.verdict import Criterion
from falsework.utils.archive import check_header, read_archive, write_archive
from falsework.utils.files.damage import blamed_on
from falsework.utils.quantity import counted

FORMAT = "falsework.graph/1"

_OWN = "states", "source", "action", "target"
_ARRAYS = frozenset({*_OWN, "boundary", "start_state", "target_state"})
_KINDS: dict[str, type] = {
    "name": str,
    "identity": str,
    "robots": int,
    "removable_only_if_clear": bool,
    "fixed": list,
    "missing": list,
    "postponed": list,
}


def criterion_of(task: Task) -> Criterion:
    """Return the stability criterion of a task that was `judged_by` an oracle."""
    return "equilibrium" if task.holds_keep_stable else "contact"


def read_criterion(path: Path | str, header: dict[str, Any], remedy: str) -> Criterion:
    """Take the criterion out of the header of a file of states; files of older versions have none.

    Args:
        header: as read; `criterion` is removed.
        remedy: remedy for a damaged file.

    Raises:
        InputError: an unknown criterion.
    """
    criterion = header.pop("criterion", "equilibrium")
    if criterion not in get_args(Criterion):
        raise InputError(f"{path} is damaged (its criterion is {criterion!r}); {remedy}")
    return criterion


@dataclass(frozen=True, eq=False)
class StateGraph:
    """Stable states of one task and all disassembly actions that lead from one of them to another."""

    states: States
    """Shape (states, parts), sorted by level."""
    source: NDArray[np.int32]
    """State that an action is taken in, shape (edges,), ascending."""
    action: NDArray[np.int32]
    """Shape (edges,)."""
    target: NDArray[np.int32]
    """State that it leads to, shape (edges,)."""
    task: Task
    """Rules under which the actions are valid."""
    name: str = ""
    """Name of the structure."""
    removable_only_if_clear: bool = False
    """Whether removals in this graph have a free exit direction."""
    origin: Mapping[str, Any] | None = None
    """Where the structure is, and the options with which it was read, as `Plan.source`; None if that is not known."""

    @classmethod
    def from_states(
        cls,
        task: Task,
        states: States,
        *,
        name: str = "",
        origin: Mapping[str, Any] | None = None,
        several: Callable[[States], Iterable[tuple[States, int]]] | None = None,
    ) -> StateGraph:
        """Connect stable states by every action that the rules of `task` allow.

        Args:
            task: rules between start and target, `judged_by` the oracle that found the states stable; only states
                between these two are used.
            states: stable states in any order, repeated or not, shape (count, parts).
            several: yields the states that removals of several parts from a state, shape (parts,), lead to, each with
                the number of the step.
        """
        state_hash = StateHash.for_parts(task.part_count)
        states = np.ascontiguousarray(states[task.contains(states)])
        first, _ = merge(state_hash(states), lambda rows: states[rows])
        states = states[first]
        states = states[np.argsort(task.steps_done(states), kind="stable")]
        index = StateIndex(states, state_hash)
        hashes = state_hash(states)
        edges = []
        for piece in chunks(len(states)):
            begin, chunk = piece.start, states[piece]
            row, action = np.nonzero(task.moves(chunk, Direction.DISASSEMBLY))
            part = action % task.part_count
            new = task.moved_value(action, Direction.DISASSEMBLY)
            child = state_hash.after(hashes[begin + row], part, chunk[row, part], new)

            def written(rows: NDArray[np.intp], chunk=chunk, row=row, action=action) -> States:
                return task.follow(chunk[row[rows]], action[rows], Direction.DISASSEMBLY)

            found = index.find_hashed(child, written)
            hit = found >= 0
            edges.append(np.stack([begin + row[hit], action[hit], found[hit]]).astype(np.int32))
        if several is not None:
            more = [(row, number, after) for row, state in enumerate(states) for after, number in several(state)]
            found = index.find(np.array([after for _, _, after in more], dtype=np.uint8).reshape(-1, task.part_count))
            rows = [(row, number, to) for (row, number, _), to in zip(more, found.tolist(), strict=True) if to >= 0]
            edges.append(np.array(rows, dtype=np.int32).reshape(-1, 3).T)
        every = np.concatenate(edges, axis=1) if edges else np.empty((3, 0), dtype=np.int32)
        source, action, target = every[:, np.argsort(every[0], kind="stable")]
        clear = task.clearance is not None
        return cls(states, source, action, target, task, name, clear, origin)

    def __len__(self) -> int:
        return len(self.states)

    def __repr__(self) -> str:
        size = f"{counted(len(self), 'state')}, {counted(len(self.source), 'action')}"
        return f"<StateGraph of {self.name or 'a structure'}: {size}>"

    @property
    def criterion(self) -> Criterion:
        """Stability criterion of its states."""
        return criterion_of(self.task)

    @cached_property
    def level(self) -> NDArray[np.int64]:
        """Steps between the start and each state, shape (states,)."""
        return self.task.steps_done(self.states)

    @cached_property
    def index(self) -> StateIndex:
        """Index of the states of this graph."""
        return StateIndex(self.states)

    @cached_property
    def solvable(self) -> Mask:
        """States from which the target can be reached within the graph, shape (states,)."""
        return self._spread(self.task.target, self.target, self.source, downwards=True)

    @cached_property
    def reachable(self) -> Mask:
        """States that can be reached from the start within the graph, shape (states,)."""
        return self._spread(self.task.start, self.source, self.target, downwards=False)

    def unseen(self, states: States) -> Mask:
        """Return states of this graph that are not among `states`, such as those to test a policy on.

        Shape (states,).
        """
        return StateIndex(np.unique(states, axis=0)).find(self.states) < 0

    def valid_actions(self) -> Mask:
        """Return actions that stay inside the graph, shape (states, 2 parts)."""
        mask = np.zeros((len(self.states), 2 * self.task.part_count), dtype=bool)
        mask[self.source, self.action] = True
        return mask

    def count_routes(self) -> int:
        """Count the different action sequences from start to target within the graph, exactly."""
        start = self._position(self.task.start)
        return int(self.routes_to_target()[start]) if start >= 0 else 0

    def routes_to_target(self) -> NDArray[np.object_]:
        """Return the number of action sequences from each state to the target, Python integers, shape (states,)."""
        count = np.zeros(len(self.states), dtype=object)
        if (last := self._position(self.task.target)) >= 0:
            count[last] = 1
        for edges in reversed(self.edges_by_level()):
            source, begin = np.unique(self.source[edges], return_index=True)
            if len(source):
                count[source] += np.add.reduceat(count[self.target[edges]], begin)
        return count

    def edges_by_level(self) -> list[slice]:
        """Return edges that leave each level, from the start on; edges are sorted, so each is a slice."""
        leaving = self.level[self.source]
        bounds = np.searchsorted(leaving, np.arange(self.task.steps + 1))
        return [slice(int(a), int(b)) for a, b in pairwise(bounds)]

    def sample_route(self, rng: np.random.Generator) -> Route | None:
        """Return a random path from start to target, each action drawn uniformly from those that can still reach it."""
        row, last = self._position(self.task.start), self._position(self.task.target)
        if row < 0 or not self.solvable[row]:
            return None
        useful, rows, actions = self.solvable[self.target], list[int](), []
        while row != last:
            rows.append(row)
            begin, end = np.searchsorted(self.source, [row, row + 1])
            edge = begin + rng.choice(np.flatnonzero(useful[begin:end]))
            actions.append(self.action[edge])
            row = int(self.target[edge])
        return Route(self.states[[*rows, row]], np.array(actions, dtype=np.int64))

    def _position(self, state: States) -> int:
        """Return the number of a state, shape (parts,), or -1."""
        return int(self.index.find(state[None])[0])

    def _spread(self, origin: States, near: NDArray[np.int32], far: NDArray[np.int32], *, downwards: bool) -> Mask:
        """Mark the nodes connected to `origin`, level by level, along edges from `near` to `far`."""
        marked = np.zeros(len(self.states), dtype=bool)
        if (first := self._position(origin)) >= 0:
            marked[first] = True
        levels = self.edges_by_level()
        for edges in reversed(levels) if downwards else levels:
            marked[far[edges][marked[near[edges]]]] = True
        return marked


def save_state_graph(graph: StateGraph, path: Path | str) -> None:
    """Write the graph as a versioned `.npz`."""
    task = graph.task
    header: dict[str, Any] = {
        "name": graph.name,
        "identity": task.identity,
        "robots": task.robots,
        "removable_only_if_clear": graph.removable_only_if_clear,
        "fixed": list(task.fixed),
        "missing": list(task.missing),
        "postponed": list(task.postponed),
        "criterion": graph.criterion,
        "origin": None if graph.origin is None else dict(graph.origin),
    }
    ends = {"boundary": task.boundary, "start_state": task.start, "target_state": task.target}
    write_archive(path, FORMAT, header, {name: getattr(graph, name) for name in _OWN} | ends)


def load_state_graph(path: Path | str) -> StateGraph:
    """Read a graph that `save_state_graph` wrote, and check that it is one.

    Raises:
        InputError: no such file, a damaged one, one of another version, or one whose edges are no legal actions.
    """
    header, arrays = read_archive(path, FORMAT, _ARRAYS)
    criterion = read_criterion(path, header, "build the graph again")
    origin = header.pop("origin", None)  # which files of older versions have not
    check_header(path, header, _KINDS, "build the graph again")
    boundary = arrays["boundary"]
    if boundary.ndim != 1 or boundary.dtype != bool or len(header["postponed"]) != len(header["missing"]):
        raise InputError(f"{path} is damaged (boundary or postponed parts have another form); build the graph again")
    with blamed_on(path, "build the graph again"):
        try:
            task = Task.from_rules(
                boundary,
                header["robots"],
                start=arrays["start_state"],
                target=arrays["target_state"],
                fixed=header["fixed"],
                missing=header["missing"],
                identity=header["identity"],
            ).postpone(header["postponed"])
            task = replace(task, holds_keep_stable=criterion == "equilibrium")
        except InputError as error:
            raise InputError(f"{path} is damaged ({error}); build the graph again") from None
        given: dict[str, Any] = {name: arrays[name] for name in _OWN}
        given |= {name: header[name] for name in ("name", "removable_only_if_clear")}
        graph = StateGraph(**given, task=task, origin=origin)
        _check(graph, path)
    return graph


def _check(graph: StateGraph, path: Path | str) -> None:
    states, parts, edges = graph.states, graph.task.part_count, graph.source.size
    damage = ""
    if states.dtype != np.uint8 or states.ndim != 2 or states.shape[1] != parts or (states > HELD).any():
        damage = f"states are not 0, 1, 2 for {parts} parts"
    elif not graph.task.contains(states).all() or (np.diff(graph.level) < 0).any():
        damage = "states break the rules or are out of order"
    elif graph.source.shape != (edges,) or graph.source.dtype != np.int32:
        damage = "edges are not a list of numbers"
    elif any(array.shape != (edges,) or array.dtype != np.int32 for array in (graph.action, graph.target)):
        damage = "edges have different lengths"
    elif edges and (
        min(graph.source.min(), graph.target.min(), graph.action.min()) < 0
        or max(graph.source.max(), graph.target.max()) >= len(states)
        or graph.action.max() >= 2 * parts
        or (np.diff(graph.source) < 0).any()
    ):
        damage = "edges point outside the states"
    elif (graph.level[graph.target] != graph.level[graph.source] + 1).any():
        damage = "an edge is not a legal action"
    else:
        for rows in chunks(edges):
            after = graph.task.follow(states[graph.source[rows]], graph.action[rows], Direction.DISASSEMBLY)
            if not np.array_equal(after, states[graph.target[rows]]):
                damage = "an edge does not lead where it says"
    if damage:
        raise InputError(f"{path} is damaged ({damage}); build the graph again")
