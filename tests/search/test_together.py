"""Several parts in one step against an enumeration that shares neither geometry nor rules with the package."""

from __future__ import annotations

import csv
import io
import json
import pickle
import re
from collections.abc import Iterator
from dataclasses import replace
from functools import cache, lru_cache
from itertools import combinations, product
from math import gcd
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest

from falsework import (
    Assembly,
    Direction,
    Outcome,
    Plan,
    StabilityOracle,
    StabilitySettings,
    Task,
    Verdict,
    find_plans,
    make_task,
)
from falsework import sheet as make_sheet
from falsework.assembly.library import shelf as built_in_shelf
from falsework.assembly.library.blocks import box, gather, prism
from falsework.assembly.library.voxels import grow_pieces, surface
from falsework.errors import AssemblyError, InputError, PlanError
from falsework.interop.instruction_table import instructions_csv
from falsework.interop.tracks import tracks_of
from falsework.search import Demands, ExhaustiveSearch, Oracle
from falsework.search.beam.state_search import StateSearch
from falsework.search.margins.demands import MarginOracle
from falsework.search.plans import plan_rules
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import load_plan, plan_from_dict, plan_to_dict, save_plan
from falsework.search.plans.plan_model import plan_schema
from falsework.search.problem.part_sets import InterlockedSets, carried_group, holds_together
from falsework.search.together.moves import TaskMoves
from falsework.stability import HoldSettings, Verdicts
from falsework.stability.judges.discrete_elements import BuildJudge
from falsework.viewer import Timeline
from falsework.viewer.appearance import appearance_at

EDGE = 0.1
SETTINGS = StabilitySettings(criterion="equilibrium")
Cells = frozenset[tuple[int, int, int]]


def assembly_of(pieces: list[Cells], fixed: Cells = frozenset()) -> Assembly:
    """Pieces of cubes on a slab that reaches two cubes beyond a region of three by three."""
    solids = [surface("piece", piece, (EDGE,) * 3, (0.0, 0.0, 0.0)) for piece in pieces]
    if fixed:
        solids.append(replace(surface("frame", fixed, (EDGE,) * 3, (0.0, 0.0, 0.0)), fixed=True))
    solids.append(box("slab", (-2 * EDGE, -2 * EDGE, -EDGE), (5 * EDGE, 5 * EDGE, 0.0), fixed=True))
    blocks = gather(solids)
    return Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary)


def drawn(seed: int, count: int, region: tuple[int, int, int]) -> list[Cells]:
    """Cut a box of cubes at random into connected pieces."""
    rng = np.random.default_rng(seed)
    while True:
        pieces = grow_pieces([(x, y, z) for x, y, z in product(*map(range, region))], count, rng)
        if pieces is not None:
            return [frozenset(piece) for piece in pieces]


class EveryStateStands(Oracle):
    """Oracle for which only geometry matters."""

    holds_keep_stable = True
    settings = SETTINGS

    def verdicts(self, states, *, near=None, require_certificate=False):
        verdicts = Verdicts.all_undecided(len(states))
        verdicts.verdict[:] = Verdict.STABLE
        return verdicts


class Enumeration:
    """All plans of boxes, counted by plain recursion.

    Boxes that move along `d` hit others in an open convex cone of directions. A direction that is in none of some cones
    exists if and only if one exists in which two of the planes that bound them meet.
    """

    def __init__(
        self, pieces: list[Cells], robots: int, largest: int, stands=lambda state: True, fixed: Cells = frozenset()
    ) -> None:
        boxes = [[(np.array(c), np.array(c) + 1) for c in piece] for piece in (*pieces, fixed)]
        boxes[-1].append((np.array([-2, -2, -1]), np.array([5, 5, 0])))
        self.pieces, self.count, self.robots, self.largest, self.stands = pieces, len(pieces), robots, largest, stands
        self.gaps = {
            (i, j): [(b[0] - a[1], b[1] - a[0]) for a in boxes[i] for b in boxes[j]]
            for i in range(self.count)
            for j in range(self.count + 1)
            if i != j
        }
        self.ways = self._directions()
        self.hits = {pair: self._hit(pair, self.ways) for pair in self.gaps}
        self.grid = np.array([v for v in product((-2, -1, 0, 1, 2), repeat=3) if any(v)])
        self.number = {tuple(v): k for k, v in enumerate(self.grid.tolist())}
        self.grid_hits = {pair: self._hit(pair, self.grid) for pair in self.gaps}
        self.leaves, self.carries = lru_cache(None)(self._leaves), lru_cache(None)(self._carries)

    def _directions(self) -> np.ndarray:
        planes = set()
        for gaps in self.gaps.values():
            for low, high in gaps:
                for axis in range(3):
                    u, v = [k for k in range(3) if k != axis]
                    for a, b in product((low[u], high[u]), (low[v], high[v])):
                        normal = [0, 0, 0]
                        normal[u], normal[v] = -int(b), int(a)
                        planes.add(self._reduced(normal))
        planes.discard((0, 0, 0))
        planes = np.array(sorted(planes))
        first, second = np.triu_indices(len(planes), 1)
        found = {self._reduced(d) for d in np.cross(planes[first], planes[second]).tolist()}
        found |= {tuple(-x for x in d) for d in found}
        found.discard((0, 0, 0))
        return np.array(sorted(found))

    @staticmethod
    def _reduced(vector) -> tuple[int, ...]:
        by = gcd(*map(int, vector)) or 1
        return tuple(int(x) // by for x in vector)

    def _hit(self, pair: tuple[int, int], ways: np.ndarray) -> np.ndarray:
        hit = np.zeros(len(ways), dtype=bool)
        for low, high in self.gaps[pair]:
            begin, end = np.zeros(len(ways)), np.full(len(ways), np.inf)
            for axis in range(3):
                d = ways[:, axis].astype(float)
                with np.errstate(divide="ignore", invalid="ignore"):
                    one, two = low[axis] / d, high[axis] / d
                still = d == 0
                begin = np.maximum(begin, np.where(still, -np.inf, np.minimum(one, two)))
                end = np.minimum(end, np.where(still, np.inf, np.maximum(one, two)))
                begin[still & ~((low[axis] < 0) & (high[axis] > 0))] = np.inf
            hit |= begin < end - 1e-9
        return hit

    def _leaves(self, parts: tuple[int, ...], others: frozenset[int], apart: bool) -> bool:
        """Whether parts leave past others and the slab along one direction, or, with `apart`, several."""
        rest = [*others, self.count]
        if not np.any([self.hits[i, j] for i in parts for j in rest], axis=0).all():
            return True
        if not apart or len(parts) == 1:
            return False
        unit = [v for v in product((-1, 0, 1), repeat=3) if any(v)]
        own = [[v for v in unit if not any(self.grid_hits[i, j][self.number[v]] for j in rest)] for i in parts]
        for velocities in product(*own):
            between = [
                (i, j, tuple(np.subtract(v, w).tolist()))
                for (i, v), (j, w) in combinations(zip(parts, velocities, strict=True), 2)
            ]
            if all(not any(w) or not self.grid_hits[i, j][self.number[w]] for i, j, w in between):
                return True
        return False

    def together(self, parts: tuple[int, ...], others: frozenset[int], apart: bool) -> bool:
        """Whether parts leave, and no fewer of them past the rest."""
        fewer = [some for count in range(1, len(parts)) for some in combinations(parts, count)]
        straight = self.leaves(parts, others, False)
        blocked = not any(self.leaves(some, others | set(parts) - set(some), False) for some in fewer)
        if straight or not apart:
            return straight and blocked
        still = not any(self.leaves(some, others | set(parts) - set(some), True) for some in fewer)
        return still and self.leaves(parts, others, True)

    def _carries(self, parts: tuple[int, ...], carrier: int) -> bool:
        meshes = [assembly_of(self.pieces).meshes[part] for part in parts]
        reached, left = {carrier}, True
        while left:
            left = {
                j
                for i in reached
                for j in set(parts) - reached
                if any(sum(abs(np.subtract(a, b))) == 1 for a in self.pieces[i] for b in self.pieces[j])
            }
            reached |= left
        if reached != set(parts):
            return False
        group = Assembly.from_meshes(meshes, boundary=[parts.index(carrier)])
        state = np.where(group.boundary, 2, 1).astype(np.uint8)
        return bool(StabilityOracle(group, SETTINGS).verdicts(state).stable[0])

    def after(self, state: tuple[int, ...]) -> Iterator[tuple[int, ...]]:
        there = [part for part in range(self.count) if state[part]]
        held = [part for part in there if state[part] == 2]
        for part in there:
            if state[part] == 1 and len(held) < self.robots:
                yield self._with(state, (part,), 2)
        for size in range(1, self.largest + 1):
            for parts in combinations(there, size):
                by = [part for part in parts if part in held]
                others = frozenset(there) - set(parts)
                one = len(by) == 1 < size and self.together(parts, others, apart=False) and self.carries(parts, by[0])
                if one or (len(by) == size and self.together(parts, others, apart=True)):
                    yield self._with(state, parts, 0)

    @staticmethod
    def _with(state, parts, value) -> tuple[int, ...]:
        return tuple(value if part in parts else old for part, old in enumerate(state))

    def plans(self) -> int:
        @lru_cache(None)
        def count(state: tuple[int, ...]) -> int:
            if not any(state):
                return 1
            return sum(count(after) for after in self.after(state) if self.stands(after))

        return count((1,) * self.count)


def plans_of(task: Task, oracle) -> int:
    """Count the plans of a task by its own moves."""
    moves = TaskMoves(task, oracle)

    @lru_cache(None)
    def count(key: bytes) -> int:
        state = np.frombuffer(key, dtype=np.uint8)
        if (state == task.target).all():
            return 1
        _, after, _ = moves.after(state[None], Direction.DISASSEMBLY)
        stable = oracle.verdicts(after).stable if len(after) else ()
        return sum(count(row.tobytes()) for row, good in zip(after, stable, strict=True) if good)

    return count(task.start.tobytes())


def diverging(wide: float = 2.0, high: float = 3.0, roof: float = 2.0) -> Assembly:
    """Two parts in channels that lead up to both sides; each has a tongue below a lip of the other, along x.

    Neither leaves without the other, and they leave along different directions only. The channels and the walls beside
    them reach to `wide`, these to `high`, and the roof between them to `roof`.
    """
    lines_x, lines_y = [-1.5, -0.5, 0.0, 0.5, 1.5], [0.0, 0.3, 0.6, 0.9]
    levels = {0.0: (-0.5, 0.25, 1.0, 2.0), 0.5: (0.0, 0.25, 0.5, 1.5), 1.5: (1.0, 1.25, 1.5, 2.5)}
    owner = {
        (y, z): "b" if (y, z) in ((0, 1), (2, 0)) else "a" for y, z in [(0, 0), (0, 1), (1, 0), (1, 1), (2, 0), (2, 1)]
    }
    cells = {"a": [(3, y, z) for y in range(3) for z in range(3)], "b": [(0, y, z) for y in range(3) for z in range(3)]}
    for x, ((y, z), name) in product((1, 2), owner.items()):
        cells[name].append((x, y, z))
    solids = []
    for name in ("a", "b"):
        solid = surface(name, frozenset(cells[name]), (1.0, 1.0, 1.0), (0.0, 0.0, 0.0))
        index = np.rint(solid.vertices).astype(int)
        corners = [(lines_x[i], lines_y[j], levels[abs(lines_x[i])][k]) for i, j, k in index.tolist()]
        solids.append(replace(solid, vertices=np.array(corners)))
    for side in (-1, 1):
        ring = [(0.0, 0.0, -0.5), (wide * side, 0.0, wide - 0.5), (wide * side, 0.0, -1.5), (0.0, 0.0, -1.5)]
        solids.append(prism("floor", ring[::side], (0.0, 0.9, 0.0), fixed=True))
        low = -0.2 if side < 0 else 0.9
        solids.append(box("wall", (-wide, low, -1.5), (wide, low + 0.2, high), fixed=True))
    ring = [(0.0, 0.0, 1.0), (roof, 0.0, 1.0 + roof), (-roof, 0.0, 1.0 + roof)]
    solids.append(prism("roof", ring, (0.0, 0.9, 0.0), fixed=True))
    blocks = gather(solids)
    return Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary)


@pytest.mark.parametrize(
    ("seed", "count", "robots", "largest"),
    [(11, 3, 1, 2), (13, 3, 3, 3), (38, 4, 2, 2), (59, 4, 2, 3), (65, 4, 1, 2), (0, 4, 2, 2), (5, 2, 2, 2)],
)
def test_as_many_plans_as_an_enumeration_of_boxes(seed: int, count: int, robots: int, largest: int) -> None:
    """All orders, sets and directions; with one part at a time too."""
    pieces = drawn(seed, count, (3, 3, 3))
    assembly = assembly_of(pieces)
    for most in (1, largest):
        expected = Enumeration(pieces, robots, most).plans()
        if most == 1:
            single = make_task(assembly, robots, removable_only_if_clear=True)
            assert ExhaustiveSearch(single, EveryStateStands()).run().plans == expected
            continue
        task = make_task(assembly, robots, parts_at_once=most)
        assert plans_of(task, EveryStateStands()) == expected


def three_bars() -> tuple[list[Cells], Cells]:
    """Three bars side by side in a frame that is open above; each has a tongue in a groove of the next."""
    whole = {(x, 0, z) for x, z in product(range(-1, 4), range(3))}
    first = {(-1, 0, z) for z in range(3)} | {(0, 0, 1)}
    last = {(3, 0, z) for z in range(3)} | {(2, 0, 0), (2, 0, 2)}
    frame = {(x, y, z) for x, y, z in product(range(-2, 5), (-1, 0, 1), range(3))} - whole
    return [frozenset(first), frozenset(whole - first - last), frozenset(last)], frozenset(frame)


@pytest.mark.parametrize("robots", [1, 3])
def test_three_parts_that_leave_only_together(robots: int) -> None:
    """With one or two at a time it is proven that there is no plan, with three there are as many as counted."""
    bars, frame = three_bars()
    assembly = assembly_of(bars, frame)
    assert Enumeration(bars, robots, 2, fixed=frame).plans() == 0
    two = StateSearch(make_task(assembly, robots, parts_at_once=2), EveryStateStands())
    result = two.run(64)
    assert result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert result.notes == ("no part there, and no set of up to 2, can begin to move, not even by turning",)
    expected = Enumeration(bars, robots, 3, fixed=frame).plans()
    assert plans_of(make_task(assembly, robots, parts_at_once=3), EveryStateStands()) == expected > 0


@pytest.mark.parametrize(("seed", "count"), [(11, 3), (38, 4)])
def test_as_many_stable_plans_as_an_enumeration(seed: int, count: int) -> None:
    pieces = drawn(seed, count, (3, 3, 3))
    assembly = assembly_of(pieces)
    oracle, judge = StabilityOracle(assembly, SETTINGS), StabilityOracle(assembly, SETTINGS)
    stands = lru_cache(None)(lambda state: bool(judge.verdicts(np.array([*state, 2], np.uint8)).stable[0]))
    expected = Enumeration(pieces, 2, 2, stands).plans()
    assert plans_of(make_task(assembly, 2, parts_at_once=2), oracle) == expected > 0


@pytest.mark.parametrize("direction", list(Direction))
@pytest.mark.parametrize(("seed", "count", "possible"), [(11, 3, True), (80, 3, True), (59, 4, True), (0, 3, None)])
def test_beams_find_a_plan_where_there_is_one(seed: int, count: int, possible: bool | None, direction) -> None:
    """From both ends, and with one robot; else they prove that there is none."""
    pieces = drawn(seed, count, (3, 3, 3))
    assembly = assembly_of(pieces)
    expected = Enumeration(pieces, 1, 2).plans() > 0
    assert possible is None or expected == possible
    beam = StateSearch(make_task(assembly, 1, parts_at_once=2), EveryStateStands(), direction)
    result = beam.run(64)
    assert result.found == expected
    assert beam.examined_all or expected
    if not expected:
        assert result.outcome is Outcome.PROVED_IMPOSSIBLE
        return
    (route,) = result.routes
    np.testing.assert_array_equal(route.states[[0, -1]], [beam.task.start, beam.task.target])
    follow = TaskMoves(beam.task, EveryStateStands())
    for before, after, action in zip(route.states, route.states[1:], route.actions, strict=False):
        _, states, actions = follow.after(before[None], Direction.DISASSEMBLY)
        assert action in actions[(states == after).all(axis=1)]


@pytest.mark.parametrize("rounding", [0.0, 1e-7, 1e-5])
def test_parts_leave_along_different_directions(inexact: Any, rounding: float) -> None:
    """One up to the left, one up to the right, at the same time; that takes a robot for each."""
    assembly = inexact(diverging(), rounding)
    complete = np.where(assembly.boundary, 2, 1).astype(np.uint8)
    clearance = assembly.clearance_of_sets
    assert not assembly.clearance.can_leave(complete[None])[0, :2].any()
    assert not clearance.leave_together((0, 1), complete[None]).any(), "along no common direction"
    assert clearance.leave_together((0, 1), complete[None], apart=True).all()
    motion = clearance.exit_motion((0, 1), complete)
    assert motion is not None
    np.testing.assert_allclose(motion, np.array([[1, 0, 1], [-1, 0, 1]]) / np.sqrt(2), atol=1e-6 + 1e2 * rounding)
    two, one = (find_plans(assembly, robots=robots, parts_at_once=2, stability=SETTINGS) for robots in (2, 1))
    assert str(two.plans[0][0]) == "insert a-0 and b-1 (R1, R2)"
    assert validate_plan(two.plans[0], assembly, SETTINGS).good
    with_one = validate_plan(without(two.plans[0], robots=1), assembly, SETTINGS)
    assert with_one.reason.endswith("is against the rules: it needs 2 robots, and the plan has 1")
    assert one.result.outcome is Outcome.PROVED_IMPOSSIBLE
    alone = find_plans(assembly, robots=2, removable_only_if_clear=True, stability=SETTINGS)
    assert alone.result.outcome is Outcome.PROVED_IMPOSSIBLE


def test_a_structure_is_copied_without_what_was_found() -> None:
    """Worker processes get it by pickle, which cannot take the collision shapes."""
    assembly = diverging()
    complete = np.where(assembly.boundary, 2, 1).astype(np.uint8)
    for one in (assembly, pickle.loads(pickle.dumps(assembly)), assembly.replace(friction=0.3)):
        assert one.clearance_of_sets.leave_together((0, 1), complete[None], apart=True).all()
    assert assembly.replace(friction=0.3).clearance_of_sets is assembly.clearance_of_sets


def test_no_proof_where_a_motion_may_have_been_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    """If sweeps refuse all velocities that were tried, others may still be free."""
    assembly = diverging()
    apart = assembly.clearance_of_sets.apart
    monkeypatch.setattr(apart, "collide", lambda a, b, between: True)
    found = find_plans(assembly, robots=2, parts_at_once=2, stability=SETTINGS)
    assert found.result.outcome is Outcome.NOT_FOUND
    assert "1 sets of parts, a-0 and b-1 the first, can begin to move along different" in found.result.limit


# Groups that one robot carries


@cache
def tower() -> Assembly:
    blocks = gather([box("block", (0, 0, k), (1, 1, k + 1)) for k in range(3)])
    return Assembly.from_meshes(blocks.meshes, boundary=[0])


def test_what_lies_on_the_part_that_is_held_is_carried() -> None:
    """A block on the held one stays, one below it falls, however the criterion calls it."""
    assembly = tower()
    for settings in (SETTINGS, StabilitySettings()):
        assert holds_together(assembly, (1, 2), 1, settings)
        assert not holds_together(assembly, (1, 2), 2, settings)


def test_a_group_is_judged_without_what_is_around_it() -> None:
    group = carried_group(tower(), (1, 2), 1)
    assert group.boundary.tolist() == [True, False]
    assert group.names == ("block-1", "block-2")
    assert group.contacts.parts.tolist() == [[0, 1]]


def test_a_robot_carries_what_it_can_bear() -> None:
    assembly = tower()
    weight = 9.81 * assembly.mass.mass[1]
    for factor, carries in ((1.9, False), (2.1, True)):
        settings = StabilitySettings(holds=HoldSettings(force=factor * weight))
        assert holds_together(assembly, (1, 2), 1, settings) is carries


def test_a_group_that_is_not_connected_is_refused() -> None:
    blocks = gather(
        [box("block", (2 * k, 0, 0), (2 * k + 1, 1, 1)) for k in range(2)] + [box("floor", (0, 0, -1), (3, 1, 0))]
    )
    assembly = Assembly.from_meshes(blocks.meshes, boundary=[2])
    with pytest.raises(
        AssemblyError, match=r"parts block-0, block-1 are no group.*no contact connects block-1 to block-0"
    ):
        holds_together(assembly, (0, 1), 0, SETTINGS)


# Plans


@pytest.fixture(scope="module")
def shelf() -> Assembly:
    return built_in_shelf(shelves=0)


@pytest.fixture(scope="module")
def plan(shelf: Assembly) -> Plan:
    return find_plans(shelf, robots=2, parts_at_once=2).plans[0]


def test_the_shelf_opens_with_two_parts_at_once(shelf: Assembly, plan: Plan) -> None:
    """One part at a time it is proved to be locked; the plan is checked by its certificates, and without them."""
    alone = find_plans(shelf, robots=2, removable_only_if_clear=True)
    assert alone.result.outcome is Outcome.PROVED_IMPOSSIBLE
    several = [step for step in plan if len(step.parts) > 1]
    assert [sorted(step.parts) for step in several] == [[2, 3]]
    assert plan.parts_at_once == 2
    report = validate_plan(plan, shelf)
    assert report.good
    assert report.certified == len(plan.states)
    assert report.about is not None
    assert report.about.parts_at_once == 2
    assert validate_plan(replace(plan, displacement=None, torn=None), shelf).good


def test_discrete_elements_build_it_too(shelf: Assembly, plan: Plan) -> None:
    assert BuildJudge(shelf).judge(plan.states, plan.presses_before).stands


def test_every_state_keeps_margins_that_are_asked_for(shelf: Assembly) -> None:
    oracle = MarginOracle(shelf, StabilitySettings(), Demands.from_text("tilt=2deg"))
    found = find_plans(shelf, oracle=oracle, parts_at_once=2)
    assert found.plans[0].parts_at_once == 2
    assert oracle.keeps(found.plans[0].states).all()


class EachHeld(InterlockedSets):
    """The same rule for robots that carry nothing but the part that they hold."""

    def carriers(self, parts, oracle):
        return ()


@pytest.fixture(scope="module")
def held(shelf: Assembly) -> Plan:
    task = replace(make_task(shelf, 2, parts_at_once=2), together=EachHeld(shelf, 2))
    return find_plans(shelf, task).plans[0]


def test_two_robots_hold_a_board_each(shelf: Assembly, held: Plan) -> None:
    step = next(step for step in held if len(step.parts) > 1)
    assert (step.parts, step.robots, str(step)) == ((2, 3), (0, 1), "insert top-2 and top-3 (R1, R2)")
    assert (step.state[2:4] == 2).all()
    assert validate_plan(held, shelf).good
    task = replace(make_task(shelf, 1, parts_at_once=2), together=EachHeld(shelf, 2))
    assert find_plans(shelf, task).result.outcome is Outcome.PROVED_IMPOSSIBLE


@pytest.mark.parametrize("name", ["plan", "held"])
def test_files_say_what_moves_at_once(name: str, request: pytest.FixtureRequest, tmp_path: Path) -> None:
    plan, file = request.getfixturevalue(name), tmp_path / "plan.json"
    save_plan(plan, file, proofs=True)
    data = json.loads(file.read_text())
    jsonschema.Draft202012Validator(plan_schema()).validate(data)
    again = load_plan(file)
    np.testing.assert_array_equal(again.states, plan.states)
    np.testing.assert_array_equal(again.actions, plan.actions)
    assert [str(step) for step in again] == [str(step) for step in plan]
    assert again.parts_at_once == 2
    assert plan_to_dict(again, proofs=True) == plan_to_dict(plan, proofs=True)


def test_a_plan_that_moves_one_part_at_a_time_is_written_as_before(shelf: Assembly) -> None:
    data = plan_to_dict(find_plans("arch:blocks=3", parts_at_once=2).plans[0])
    assert "parts_at_once" not in data["rules"]
    assert not any("parts" in step for step in data["steps"])


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"parts": ["first"]}, "steps\\[{index}\\].parts is \\[{first}\\]; give a list of length >= 2"),
        ({"parts": ["first", "first"]}, "steps\\[{index}\\].parts names a part twice"),
        ({"parts": ["second", "first"]}, "step {number} does 'insert' with parts \\[{second}, {first}\\]"),
        ({"parts": ["first", 9]}, "steps\\[{index}\\].parts\\[1\\] is 9; it must be a part from 0 to 4"),
        ({"parts": ["first", 4]}, "step {number} cannot insert part 4, which is there already"),
        ({"parts": ["first", 1]}, "step {number} cannot insert part 1, which is there already"),
        ({"held": 0}, "steps\\[{index}\\].held is 0; give a whole number >= 1"),
        ({"held": 3}, "step {number} holds 3 of 2 parts"),
        ({"held": None}, "step {number} has only one of parts and held"),
        ({"parts": None}, "step {number} has only one of parts and held"),
    ],
)
def test_damaged_steps_are_refused(plan: Plan, change: dict[str, Any], message: str) -> None:
    data = json.loads(json.dumps(plan_to_dict(plan)))
    (number,) = [number for number, step in enumerate(data["steps"]) if "parts" in step]
    names = dict(zip(("first", "second"), data["steps"][number]["parts"], strict=True))
    for key, value in change.items():
        data["steps"][number][key] = [names.get(part, part) for part in value] if isinstance(value, list) else value
    with pytest.raises(PlanError, match=message.format(index=number, number=number + 1, **names)):
        plan_from_dict(data)


def test_a_step_of_several_held_parts_needs_as_many_robots(shelf: Assembly) -> None:
    data = json.loads(
        json.dumps(plan_to_dict(find_plans(shelf, robots=1, parts_at_once=2, stability=SETTINGS).plans[0]))
    )
    (step,) = [step for step in data["steps"] if "parts" in step]
    step["held"] = 2
    with pytest.raises(PlanError, match=r"needs 2 robots, but the plan has 1"):
        plan_from_dict(data)


def test_a_reader_without_such_steps_refuses_the_file(plan: Plan) -> None:
    """What it lacks is the rule, as versions that do not know it do."""
    data = json.loads(json.dumps(plan_to_dict(plan)))
    del data["rules"]["parts_at_once"]
    with pytest.raises(PlanError, match=r"at most 1 with rules.parts_at_once"):
        plan_from_dict(data)
    with pytest.raises(PlanError, match=r"rules.parts_at_once is 0"):
        plan_from_dict(data | {"rules": data["rules"] | {"parts_at_once": 0}})
    rules = {"parts_at_once": 2, "removable_only_if_clear": False}
    with pytest.raises(PlanError, match=r"parts move at once only with rules.removable_only_if_clear"):
        plan_from_dict(data | {"rules": data["rules"] | rules})


def without(plan: Plan, **changes: Any) -> Plan:
    return replace(plan, displacement=None, torn=None, forces=None, loads=(), replay=None, **changes)


def test_a_check_takes_no_set_from_a_plan(shelf: Assembly, plan: Plan) -> None:
    """What can leave together, and what one robot can carry, is found from the structure."""
    row = next(step.number for step in plan if len(step.parts) > 1)
    assert (
        "it moves 2 parts, and at most 1 can move at once"
        in validate_plan(without(plan, parts_at_once=1), shelf).reason
    )
    assert "touches a fixed part" in validate_plan(without(plan, fixed=(2,)), shelf).reason
    other = plan.actions.copy()
    other[row - 1] = len(plan.boundary) + next(step.parts[1] for step in plan if len(step.parts) > 1)
    assert "is named after a part that no robot holds" in validate_plan(without(plan, actions=other), shelf).reason
    # Both uprights at once: each stands by itself, so that they do not leave together.
    states = np.array(
        [[0, 0, 0, 0, 2], [2, 2, 0, 0, 2], [1, 2, 0, 0, 2], [1, 1, 0, 0, 2], *plan.states[row:]], np.uint8
    )
    actions = np.array([5, 0, 1, *plan.actions[row - 1 :]])
    some = [0, 0, 0, 0, *range(row, len(plan.states))]
    forged = without(
        plan,
        states=states,
        actions=actions,
        verdicts=tuple(plan.verdicts[k] for k in some),
        proofs=tuple(plan.proofs[k] for k in some),
        residuals=plan.residuals[some],
    )
    report = validate_plan(forged, shelf)
    assert report.reason.startswith("step 1 (insert upright-0 and upright-1) is against the rules: ")
    assert "do not leave together" in report.reason


def test_a_check_refuses_a_group_that_falls(plan: Plan, shelf: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(plan_rules, "holds_together", lambda *arguments: False)
    report = validate_plan(plan, shelf)
    assert "fall while a robot carries them by top-" in report.reason


# Outputs


def test_pictures_and_tracks_move_all_parts_of_a_step(shelf: Assembly, plan: Plan) -> None:
    timeline = Timeline.from_plan(plan, shelf)
    np.testing.assert_allclose(timeline.exit_directions[[2, 3]], [[0, 0, 1]] * 2, atol=1e-9)
    row = next(step.number for step in plan if len(step.parts) > 1)
    look = appearance_at(timeline, row - 0.5)
    assert (look.shift[[2, 3], 2] > 0).all()
    assert look.shift[2, 2] == look.shift[3, 2]
    tracks = tracks_of(plan, shelf).tracks
    assert tracks[2].path == tracks[3].path
    assert tracks[2].shown == tracks[3].shown == ((0.0, False), (float(row - 1), True))


def test_sheets_name_all_parts_of_a_step(shelf: Assembly, plan: Plan, held: Plan) -> None:
    for made, supports in ((plan, 1), (held, 2)):
        sheet = make_sheet(shelf, made)
        (step,) = [step for step in sheet.steps if len(step.parts) > 1]
        assert sheet.comes_in(step) == "from above"
        assert len(step.supports) == supports
        (row,) = [line for line in csv.DictReader(io.StringIO(instructions_csv(sheet))) if ";" in line["part"]]
        assert float(row["mass_kg"]) == pytest.approx(shelf.mass.mass[[2, 3]].sum(), rel=1e-5)
        assert sorted(row["name"].split("; ")) == ["top-2", "top-3"]
    assert sheet.named(step) == "top-2 and top-3"


@pytest.mark.parametrize(
    ("name", "said"), [("plan", r"carried by support [12], which holds"), ("held", "supports 1 and 2")]
)
def test_printed_sheets_list_and_point_at_each_part_of_a_step(
    shelf: Assembly, name: str, said: str, request: pytest.FixtureRequest
) -> None:
    pytest.importorskip("reportlab", reason="needs reportlab; pip install 'falsework[sheet]'")
    pdfium = pytest.importorskip("pypdfium2", reason="needs pypdfium2, of the group test")
    from falsework.interop.instruction_pdf import instructions_pdf, step_arrows

    sheet = make_sheet(shelf, request.getfixturevalue(name))
    (step,) = [step for step in sheet.steps if len(step.parts) > 1]
    ends = step_arrows(sheet, step).ends
    assert ends.shape == (2, 2, 3)
    for (tail, head), part in zip(ends, step.parts, strict=True):
        assert (tail[2] > head[2] > shelf.meshes[part].vertices[:, 2].max()).all()
        np.testing.assert_allclose(head[:2], shelf.mass.center[part, :2])
    document = pdfium.PdfDocument(instructions_pdf(sheet))
    words = " ".join(" ".join(page.get_textpage().get_text_range() for page in document).split())
    document.close()
    assert re.search(said, words)
    stock = words.partition("Stock list")[2]
    for part in step.parts:
        x, y, z = shelf.mass.center[part].round(3) + 0.0
        mass = shelf.mass.mass[part]
        assert f"{sheet.name(part)} {mass:.2f} {x:.3f}, {y:.3f}, {z:.3f} {step.number}" in stock


# What is refused


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"parts_at_once": 0}, "0 is not a number of parts of shelf:shelves=0 that can move at once; give 1 .* to 4"),
        ({"parts_at_once": 5}, "5 is not a number of parts of shelf:shelves=0 that can move at once; give 1 .* to 4"),
        ({"parts_at_once": 2.5}, "2.5 is not a number of parts of shelf:shelves=0 that can move at once"),
    ],
)
def test_rules_that_cannot_be_kept(shelf: Assembly, rules: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_task(shelf, 2, **rules)


def test_what_moves_one_part_at_a_time_says_so(shelf: Assembly, plan: Plan, tmp_path: Path) -> None:
    task = make_task(shelf, 2, parts_at_once=2)
    with pytest.raises(InputError, match="beams of levels move one part at a time"):
        ExhaustiveSearch(task, EveryStateStands())
    with pytest.raises(InputError, match="a search with several parts in one step cannot be saved"):
        find_plans(shelf, task, checkpoint=tmp_path / "search")
