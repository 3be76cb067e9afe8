"""Ways on which parts wait half way out: found where no others are, and refused where what waits falls."""

from __future__ import annotations

import json
import pickle
from dataclasses import replace
from functools import cache
from itertools import product
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, Outcome, Plan, StabilityOracle, StabilitySettings, find_plans, make_task, replan
from falsework import sheet as make_sheet
from falsework.assembly import HELD, INSTALLED, REMOVED
from falsework.assembly.library.blocks import gather
from falsework.assembly.library.voxels import surface
from falsework.errors import InputError, PlanError
from falsework.geometry.clearance.moves import after
from falsework.geometry.paths import waiting
from falsework.geometry.paths.waiting import stages
from falsework.interop.instruction_table import instructions_csv
from falsework.interop.tracks import tracks_of
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import plan_from_dict, plan_to_dict
from falsework.viewer import Timeline
from falsework.viewer.appearance import appearance_at

EDGE = 0.1
SETTINGS = StabilitySettings(criterion="equilibrium")
LEFT = [0, 1, 2]
"""All that is to be left: the first part leaves, the second stays."""
Cells = set[tuple[int, int, int]]
Flat = set[tuple[int, int]]


def of_cubes(*pieces: Cells, frame: Cells) -> Assembly:
    """Pieces of cubes, and a fixed frame."""
    solids = [surface("piece", frozenset(piece), (EDGE,) * 3, (0.0, 0.0, 0.0)) for piece in pieces]
    solids.append(replace(surface("frame", frozenset(frame), (EDGE,) * 3, (0.0, 0.0, 0.0)), fixed=True))
    blocks = gather(solids)
    return Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary)


def on_a_floor(hollow: Flat, *pieces: Flat) -> Assembly:
    """Pieces one cube high in a hollow between a floor and a ceiling, in which they slide."""
    xs, ys = ([cell[axis] for cell in hollow] for axis in (0, 1))
    every = product(range(min(xs) - 1, max(xs) + 2), range(min(ys) - 1, max(ys) + 1), (-1, 0, 1))
    frame = {(x, y, z) for x, y, z in every if z or (x, y) not in hollow}
    return of_cubes(*({(x, y, 0) for x, y in piece} for piece in pieces), frame=frame)


def latch(*, upright: bool = False) -> Assembly:
    """A pin behind a bar that never leaves the frame, but can slide aside: on its floor, or upwards."""
    hollow = {(1, 1, z) for z in range(5)} | {(x, y, 2) for x in range(1, 6) for y in (0, 1)}
    pin, bar = {(1, 1, 0), (1, 1, 1)}, {(1, 1, 2), (2, 1, 2), (1, 0, 2)}
    frame = set(product(range(-1, 7), range(-1, 3), range(-1, 5))) - hollow - pin - bar
    sets = [{cell[::-1] for cell in some} if upright else some for some in (pin, bar, frame)]
    return of_cubes(*sets[:2], frame=sets[2])


@cache
def dodge() -> Assembly:
    """A block that leaves its place for a hook, which passes there before the way out behind it is free."""
    hollow = {(0, 0), (0, -1), (1, -1), (1, 0), (1, 1), (2, 0), (2, 1), (0, 1), (-1, 1), (1, 2), (1, 3)}
    return on_a_floor(hollow, {(0, 0)}, {(1, 1), (2, 1), (2, 0)})


@pytest.fixture(scope="module")
def latched() -> tuple[Assembly, Plan]:
    assembly = latch()
    plan = find_plans(assembly, robots=1, moves=2, waiting=True, stability=SETTINGS, target=LEFT).plans[0]
    return assembly, plan


def test_one_robot_lays_a_bar_aside_where_without_that_no_plan_exists(latched: tuple[Assembly, Plan]) -> None:
    assembly, plan = latched
    without = find_plans(assembly, robots=1, moves=6, stability=SETTINGS, target=LEFT)
    assert without.result.outcome is Outcome.PROVED_IMPOSSIBLE
    aside, out = plan.exit_paths[0]
    assert (aside.parts, out.parts, plan.robots, plan.waiting) == ((1,), (0,), 1, True)
    assert (plan.states[:, 1] == 1).all()
    report = validate_plan(plan, assembly, SETTINGS)
    assert report.good, report.reason


def test_the_part_that_leaves_waits_half_way_out_itself() -> None:
    """One robot takes it out of the way, lets go of it, moves the hook to where it was, and takes it out."""
    assembly = dodge()
    assert find_plans(assembly, robots=1, moves=6, stability=SETTINGS, target=LEFT).result.outcome is not Outcome.FOUND
    plan = find_plans(assembly, robots=1, moves=4, waiting=True, stability=SETTINGS, target=LEFT).plans[0]
    movers = [move.parts for move in plan.exit_paths[0]]
    assert len(movers) == 4
    assert movers[0] == movers[-1] == (0,)
    assert (1,) in movers
    assert validate_plan(plan, assembly, SETTINGS).good
    waits = [
        (state, poses)
        for state, poses in stages(plan.exit_paths[0], plan.states[1], (0,), 0, out=True)
        if state[0] == 1 and 0 in poses
    ]
    assert any(state[1] == 0 for state, _ in waits)


def test_what_would_wait_in_the_air_falls() -> None:
    """The same bar, but upwards: a second robot has to hold it there, and a plan that lets go of it is refused."""
    assembly = latch(upright=True)
    alone = find_plans(assembly, robots=1, moves=2, waiting=True, target=LEFT)
    assert alone.result.outcome is Outcome.NOT_FOUND
    assert "parts were tried half way out where they block another" in alone.result.limit
    held = find_plans(assembly, robots=2, moves=2, target=[0, 2, 2]).plans[0]
    (row,) = [row for row, way in enumerate(held.exit_paths) if way]
    lets_go = find_plans(latch(), robots=1, moves=2, waiting=True, stability=SETTINGS, target=LEFT).plans[0]
    bare = replace(lets_go, forces=None, identity=assembly.identity, exit_paths=(held.exit_paths[row], ()), replay=None)
    contact = StabilitySettings()
    bare = replace(bare, claim=contact.claim, displacement=None, loads=())
    assert "with piece-1 half way out, the other parts do not stand" in validate_plan(bare, assembly, contact).reason


def test_a_check_needs_the_rule_and_a_robot_for_each_part(latched: tuple[Assembly, Plan]) -> None:
    assembly, plan = latched
    aside, out = plan.exit_paths[0]

    def reason(**changes: Any) -> str:
        return validate_plan(replace(plan, forces=None, **changes), assembly, SETTINGS).reason

    assert "its way moves piece-1, which no robot holds" in reason(waiting=False)
    assert "its way moves frame-2, which no robot holds" in reason(exit_paths=((replace(aside, parts=(2,)), out), ()))
    both = replace(aside, parts=(0, 1))
    assert "no robot is free to carry piece-0, piece-1" in reason(exit_paths=((both, out), ()))


def test_files_say_it_and_a_wrong_one_is_refused(latched: tuple[Assembly, Plan]) -> None:
    _, plan = latched
    data = json.loads(json.dumps(plan_to_dict(plan)))
    assert data["rules"]["waiting"] is True
    again = plan_from_dict(data)
    assert (again.waiting, again.exit_paths) == (True, plan.exit_paths)
    data["rules"]["moves"] = 1
    with pytest.raises(PlanError, match=r"rules.waiting is true; it needs rules.moves above 1"):
        plan_from_dict(data)


def test_pictures_show_what_waits(latched: tuple[Assembly, Plan]) -> None:
    """The bar is aside while the pin is on its way, and back in place at both ends."""
    assembly, plan = latched
    timeline = Timeline.from_plan(plan, assembly)
    shifts = np.array([appearance_at(timeline, position).shift for position in np.linspace(-1.0, 1.0, 41)])
    np.testing.assert_allclose(shifts[-1], 0.0, atol=1e-9)
    assert shifts[:, 1, 0].max() == pytest.approx(EDGE, abs=1e-3)
    assert (shifts[shifts[:, 0, 2] > 1e-9, 1, 0] > 0.0).all()
    assert not shifts[:, 0, :2].any()
    pin, bar, _ = tracks_of(plan, assembly).tracks
    assert bar.path[0][1] == bar.path[-1][1] == (0.0, 0.0, 0.0)
    assert max(place[0] for _, place in bar.path) == pytest.approx(EDGE, abs=1e-3)
    assert {place[0] for _, place in pin.path} == {0.0}
    assert "from above, with piece-1 aside" in instructions_csv(make_sheet(assembly, plan))


def test_replanning_goes_on_with_parts_that_wait(latched: tuple[Assembly, Plan]) -> None:
    assembly, plan = latched
    answer = replan(plan, step=0, structure=assembly)
    assert answer.value is not None
    assert answer.value.exit_paths == plan.exit_paths
    assert validate_plan(answer.value, assembly, SETTINGS).good


def test_ways_can_be_sent_to_another_process() -> None:
    assembly = latch()
    oracle = StabilityOracle(assembly, SETTINGS)
    clearance = make_task(assembly, 1, moves=2, waiting=True).clearance
    assert clearance is not None
    sent = pickle.loads(pickle.dumps(clearance)).judged_by(oracle, 1)
    np.testing.assert_array_equal(sent.can_leave(np.array([[2, 1, 2]], dtype=np.uint8)), [[True, False, False]])


def test_wrong_rules_are_refused() -> None:
    with pytest.raises(InputError, match="waits half way out only on a way of several moves; give moves"):
        make_task("arch:blocks=3", 1, waiting=True)
    arch = Assembly.from_meshes(latch().meshes, boundary=[2], contacts=latch().contacts)
    with pytest.raises(InputError, match="has given contacts, which belong to parts in place"):
        make_task(arch, 1, moves=2, waiting=True)


def fewest_moves(hollow: Flat, pieces: list[Flat], most: int) -> int | None:
    """Moves of one piece at a time, by cells, after which the first is out; None if so many do not suffice."""
    start, out = tuple((0, 0) for _ in pieces), max(y for _, y in hollow)
    front, seen = {start}, {start}
    for number in range(1, most + 1):
        reached = set()
        for at in front:
            for one, step in product(range(len(pieces)), ((1, 0), (-1, 0), (0, 1), (0, -1))):
                filled = {(x + at[k][0], y + at[k][1]) for k in range(len(pieces)) if k != one for x, y in pieces[k]}
                here = at[one]
                while True:
                    here = here[0] + step[0], here[1] + step[1]
                    cells = {(x + here[0], y + here[1]) for x, y in pieces[one]}
                    if any(cell in filled or (cell not in hollow and cell[1] <= out) for cell in cells):
                        break
                    if min(y for _, y in cells) > out:
                        if one == 0:
                            return number
                        break
                    reached.add((*at[:one], here, *at[one + 1 :]))
        front = reached - seen
        seen |= reached
    return None


def room(seed: int) -> tuple[Flat, list[Flat]]:
    """A room of three by three cells with a door one cell wide, and in it a block, and a bar too wide for the door."""
    rng = np.random.default_rng(seed)
    cells, door = list(product(range(3), range(3))), int(rng.integers(3))
    bars = [{(x, y), (x + 1, y)} for x, y in product(range(2), range(3))]
    while True:
        block, bar = {cells[int(rng.integers(9))]}, bars[int(rng.integers(len(bars)))]
        if not block & bar:
            return {*cells, (door, 3)}, [block, bar]


@pytest.mark.parametrize("seed", range(8))
def test_pieces_leave_in_as_few_moves_as_by_cells_one_at_a_time(seed: int) -> None:
    hollow, pieces = room(seed)
    expected, assembly = fewest_moves(hollow, pieces, 4), on_a_floor(hollow, *pieces)
    state = np.array([2, 1, 2], dtype=np.uint8)
    for moves in range(2, 5):
        clearance = make_task(assembly, 1, moves=moves, waiting=True).clearance
        assert clearance is not None
        way = clearance.exit_path(state, (0,))
        assert (way is not None) == (expected is not None and expected <= moves)
        if way is not None:
            assert len(way or (0,)) == expected
            assert all(len(move.parts) == 1 for move in way)
            assert 0 in after(way) or way == ()
            return


def test_values_of_parts_are_those_of_states() -> None:
    """Geometry knows nothing of assemblies, so it names them itself."""
    assert (waiting.REMOVED, waiting.INSTALLED, waiting.HELD) == (REMOVED, INSTALLED, HELD)
