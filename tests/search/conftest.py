"""Structures made of rules instead of physics, and an enumeration that shares no code with the searches."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from functools import lru_cache
from itertools import product
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, Task, Verdict, load_structure
from falsework.geometry import TriangleMesh
from falsework.geometry.clearance.protocol import Clearance
from falsework.search import Oracle
from falsework.stability import Proof, Verdicts

State = tuple[int, ...]


@pytest.fixture(scope="session")
def inexact() -> Callable[[Assembly, float], Assembly]:
    """Return a structure whose corners are all displaced at random by up to a length, metres, as rounding does."""

    def displace(assembly: Assembly, most: float) -> Assembly:
        rng = np.random.default_rng(0)
        meshes = [
            TriangleMesh.from_arrays(
                mesh.name, mesh.vertices + rng.uniform(-most, most, mesh.vertices.shape), mesh.faces
            )
            for mesh in assembly.meshes
        ]
        return Assembly.from_meshes(meshes, boundary=assembly.boundary)

    return displace


def verdicts_of(stable: NDArray[np.bool_], undecided: NDArray[np.bool_] | None = None) -> Verdicts:
    verdict = np.where(stable, Verdict.STABLE, Verdict.UNSTABLE).astype(np.int8)
    if undecided is not None:
        verdict[undecided] = Verdict.UNDECIDED
    verdicts = Verdicts.all_undecided(len(stable))
    verdicts.verdict[:] = verdict
    verdicts.proof[:] = np.select([verdict == 1, verdict == -1], [Proof.FORCES, Proof.VELOCITY], Proof.NONE)
    verdicts.residual[:] = 0.0
    return verdicts


@dataclass
class RuleOracle(Oracle):
    """An installed part stands if one of its sets of supports is there; a held part needs none.

    So a hold never hurts, as under the criterion `equilibrium`.
    """

    supports: list[list[frozenset[int]]]
    asked: list[NDArray[np.uint8]] = field(default_factory=list)
    holds_keep_stable: bool = True
    replayer: Any = None

    def verdicts(
        self,
        states: NDArray[np.uint8],
        *,
        near: NDArray[np.uint8] | None = None,
        require_certificate: bool = False,
    ) -> Verdicts:
        assert near is None or len(near) == len(states)
        self.asked.append(states.copy())
        return verdicts_of(np.array([self.stands(tuple(state.tolist())) for state in states], dtype=bool))

    def stands(self, state: State) -> bool:
        return all(
            any(all(state[part] for part in choice) for choice in choices)
            for value, choices in zip(state, self.supports, strict=True)
            if value == 1
        )


@dataclass
class PressingOracle(RuleOracle):
    """As under the criterion `contact`: an installed part also slides while a part that presses on it is held."""

    pressed: list[frozenset[int]] = field(default_factory=list)
    holds_keep_stable: bool = False

    def verdicts(
        self,
        states: NDArray[np.uint8],
        *,
        near: NDArray[np.uint8] | None = None,
        require_certificate: bool = False,
    ) -> Verdicts:
        verdicts = super().verdicts(states, near=near)
        slides = [super(PressingOracle, self).stands(tuple(state.tolist())) for state in states]
        verdicts.verdict[np.array(slides, dtype=bool) & ~verdicts.stable] = Verdict.SLIDES
        return verdicts

    def stands(self, state: State) -> bool:
        pressed = any(
            value == 1 and any(state[part] == 2 for part in parts)
            for value, parts in zip(state, self.pressed, strict=True)
        )
        return super().stands(state) and not pressed


@dataclass(frozen=True)
class RuleClearance(Clearance):
    """Part `i` leaves if all of one of its sets of blockers are gone."""

    blockers: list[list[frozenset[int]]]
    complete: bool = True
    """Whether the sets are all there are, so that a search may rely on them for a proof."""

    def can_leave(self, states: NDArray[np.uint8], wanted: NDArray[np.bool_] | None = None) -> NDArray[np.bool_]:
        rows = [[self.free(tuple(state.tolist()), part) for part in range(states.shape[1])] for state in states]
        return np.array(rows, dtype=bool).reshape(states.shape)

    def caveat(self, parts: NDArray[np.bool_]) -> str:
        return "" if self.complete or not parts.any() else "exits may be missing"

    def free(self, state: State, part: int) -> bool:
        return any(all(not state[other] for other in way) for way in self.blockers[part])


@dataclass(frozen=True)
class Enumeration:
    """Everything that a task allows, found by plain recursion over tuples."""

    task: Task
    oracle: RuleOracle

    def moves(self, state: State) -> Iterator[tuple[int, State]]:
        task = self.task
        parts, boundary = len(state), task.boundary.tolist()
        held = sum(1 for value, fixed in zip(state, boundary, strict=True) if value == 2 and not fixed)
        for part, value in enumerate(state):
            goal = int(task.target[part])
            if boundary[part] or part in task.fixed:
                continue
            if value == 1 and goal != 1 and held < task.robots:
                after = (*state[:part], 2, *state[part + 1 :])
                if self.oracle.stands(after):
                    yield part, after
            if value == 2 and goal == 0:
                if task.clearance is not None and not task.clearance.free(state, part):  # type: ignore[attr-defined]
                    continue
                after = (*state[:part], 0, *state[part + 1 :])
                if self.oracle.stands(after):
                    yield parts + part, after

    def routes(self) -> list[tuple[State, ...]]:
        """All plans, as sequences of states."""
        goal = tuple(self.task.target.tolist())

        def extend(state: State) -> Iterator[tuple[State, ...]]:
            if state == goal:
                yield (state,)
                return
            for _, after in self.moves(state):
                for rest in extend(after):
                    yield (state, *rest)

        return list(extend(tuple(self.task.start.tolist())))

    def count(self) -> int:
        goal = tuple(self.task.target.tolist())

        @lru_cache(None)
        def plans(state: State) -> int:
            return 1 if state == goal else sum(plans(after) for _, after in self.moves(state))

        return plans(tuple(self.task.start.tolist()))

    def reachable(self) -> set[State]:
        start = tuple(self.task.start.tolist())
        found, todo = {start}, [start]
        while todo:
            for _, after in self.moves(todo.pop()):
                if after not in found:
                    found.add(after)
                    todo.append(after)
        return found


def tower(parts: int) -> RuleOracle:
    """Part 0 is the ground; every other part stands on the one before it."""
    return RuleOracle([[frozenset()], *([frozenset({part - 1})] for part in range(1, parts))])


def blocks(parts: int) -> RuleOracle:
    """Blocks side by side on the ground: each stands alone."""
    return RuleOracle([[frozenset()] for _ in range(parts)])


def arch(parts: int) -> RuleOracle:
    """Part 0 is the ground; every other part needs both neighbours, the last one the ground again."""
    needs = [[frozenset()]]
    for part in range(1, parts):
        needs.append([frozenset({part - 1, (part + 1) % parts})])
    return RuleOracle(needs)


def random_rules(seed: int, parts: int) -> tuple[RuleOracle, RuleClearance]:
    """Part 0 is the ground; supports and blockers are drawn at random, such that the complete structure stands."""
    rng = np.random.default_rng(seed)

    def sets(part: int, most: int) -> list[frozenset[int]]:
        others = [other for other in range(parts) if other != part]
        sizes = rng.integers(0, most + 1, size=rng.integers(1, 3))
        return [frozenset(rng.choice(others, size=min(size, len(others)), replace=False).tolist()) for size in sizes]

    supports = [[frozenset()], *(sets(part, 3) for part in range(1, parts))]
    return RuleOracle(supports), RuleClearance([sets(part, 2) for part in range(parts)])


def pressing(seed: int, parts: int) -> PressingOracle:
    """Random supports, and parts that slide while another one, drawn at random, is held."""
    rng = np.random.default_rng(seed)
    supports = random_rules(seed, parts)[0].supports
    pressed = [frozenset() if rng.random() < 0.5 else frozenset({int(rng.integers(1, parts))}) for _ in range(parts)]
    return PressingOracle(supports, pressed=[frozenset(), *(pressed[1:])])


def ground(parts: int) -> NDArray[np.bool_]:
    """Part 0 is boundary."""
    return np.arange(parts) == 0


class Rules:
    """The makers above, for tests."""

    tower = staticmethod(tower)
    blocks = staticmethod(blocks)
    arch = staticmethod(arch)
    random = staticmethod(random_rules)
    pressing = staticmethod(pressing)
    ground = staticmethod(ground)
    clearance = staticmethod(RuleClearance)
    enumeration = staticmethod(Enumeration)
    verdicts = staticmethod(verdicts_of)

    @staticmethod
    def all_states(parts: int) -> NDArray[np.uint8]:
        """Every state with part 0 as boundary."""
        return np.array([(2, *values) for values in product((0, 1, 2), repeat=parts - 1)], dtype=np.uint8)


@pytest.fixture(scope="session")
def rules() -> type[Rules]:
    return Rules


@pytest.fixture(scope="session")
def small_arch() -> Assembly:
    """A real arch of seven blocks between two abutments."""
    return load_structure("arch:blocks=7")


@pytest.fixture(scope="session")
def arch_oracle(small_arch: Assembly) -> StabilityOracle:
    return StabilityOracle(small_arch)


@pytest.fixture
def damage() -> Callable[[bytes, int], bytes]:
    """A file cut off, or with one byte changed."""

    def cut(data: bytes, keep: int) -> bytes:
        return data[:keep]

    return cut
