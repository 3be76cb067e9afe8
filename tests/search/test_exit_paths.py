"""Plans in which parts leave in several moves: found, checked, written, read, shown and refused."""

from __future__ import annotations

import copy
import json
import pickle
from dataclasses import replace
from functools import cache
from itertools import product
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from falsework import (
    Assembly,
    Direction,
    Outcome,
    Plan,
    PlannerSettings,
    StabilityOracle,
    StabilitySettings,
    find_plans,
    load,
    make_task,
    min_robots,
    replan,
    save,
)
from falsework import sheet as make_sheet
from falsework.assembly.library import shelf as built_in_shelf
from falsework.assembly.library.blocks import box, gather
from falsework.assembly.library.voxels import grow_pieces, surface
from falsework.assembly.state import INSTALLED
from falsework.errors import InputError, PlanError, StateError
from falsework.geometry import TriangleMesh
from falsework.geometry.arrays import apply
from falsework.geometry.clearance.moves import PathMove
from falsework.interop.instruction_table import instructions_csv
from falsework.interop.tracks import tracks_of
from falsework.search.planner import Planner
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import plan_from_dict, plan_to_dict
from falsework.search.problem.deadline import DeadlineExceeded
from falsework.search.together.exits import sets_of
from falsework.utils.interruption import interrupted_by
from falsework.viewer import Timeline
from falsework.viewer.appearance import TRAVEL, appearance_at, diagonal

EDGE = 0.1
SETTINGS = StabilitySettings(criterion="equilibrium")
Cells = set[tuple[int, int, int]]


def cells(x: range, y: range, z: range) -> Cells:
    return set(product(x, y, z))


def of_cubes(*pieces: Cells, frame: Cells) -> Assembly:
    """Pieces of cubes, and a fixed frame."""
    solids = [surface("piece", frozenset(piece), (EDGE,) * 3, (0.0, 0.0, 0.0)) for piece in pieces]
    solids.append(replace(surface("frame", frozenset(frame), (EDGE,) * 3, (0.0, 0.0, 0.0)), fixed=True))
    blocks = gather(solids)
    return Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary)


@cache
def shaft() -> Assembly:
    """A block at the blind end of a tunnel, which leads out, and then up."""
    hollow = {(x, 0, 0) for x in range(4)} | {(3, 0, z) for z in range(3)}
    return of_cubes({(0, 0, 0)}, frame=cells(range(-1, 5), range(-1, 2), range(-1, 3)) - hollow)


@cache
def latch() -> Assembly:
    """A pin under a bar that never leaves the frame before the pin, but can slide aside."""
    hollow = {(1, 1, z) for z in range(5)} | {(x, 1, 2) for x in range(1, 6)} | {(x, 0, 2) for x in (1, 2)}
    pin, bar = {(1, 1, 0), (1, 1, 1)}, {(1, 1, 2), (2, 1, 2), (1, 0, 2)}
    hollow |= {(x, 0, 2) for x in range(1, 6)}
    frame = cells(range(-1, 7), range(-1, 3), range(-1, 5)) - hollow - pin - bar
    return of_cubes(pin, bar, frame=frame)


@pytest.fixture(scope="module")
def plan(drawer: Assembly) -> Plan:
    return find_plans(drawer, robots=1, moves=2).plans[0]


def test_a_drawer_behind_a_lip_is_lifted_and_then_pulled_out(plan: Plan, drawer: Assembly) -> None:
    assert plan.moves == 2
    (up, out), _ = plan.exit_paths
    assert up.direction == (0.0, 0.0, 1.0)
    assert 0.06 - 1e-3 <= up.distance <= 0.15 + 1e-3
    assert out.direction == (1.0, 0.0, 0.0)
    report = validate_plan(plan, drawer)
    assert report.good, report.reason
    assert report.about is not None
    assert report.about.moves == 2


@pytest.mark.parametrize("most", [1e-7, 1e-6, 1e-5])
@pytest.mark.parametrize("turns", [False, True])
def test_rounded_coordinates_lock_nothing(drawer: Assembly, inexact: Any, most: float, turns: bool) -> None:
    found = find_plans(inexact(drawer, most), robots=1, moves=2, turns=turns, stability=SETTINGS)
    assert len(found.plans[0].exit_paths[0]) == 2


def test_without_several_moves_it_is_proven_that_there_is_no_plan(drawer: Assembly) -> None:
    found = find_plans(drawer, robots=1, removable_only_if_clear=True, stability=SETTINGS)
    assert found.result.outcome is Outcome.PROVED_IMPOSSIBLE
    assert find_plans(shaft(), robots=1, moves=2, stability=SETTINGS).plans[0].exit_paths[0][0].direction == (
        1,
        0,
        0,
    )


@pytest.mark.parametrize("direction", Direction)
def test_a_bar_that_a_robot_holds_moves_aside_for_a_pin(direction: Direction) -> None:
    """It stays inside; with one robot it cannot be held meanwhile, and that there is no plan is proven."""
    assembly, settings = latch(), PlannerSettings(directions=(direction,))
    one = find_plans(assembly, robots=1, moves=6, stability=SETTINGS, settings=settings, target=[0, 1, 2])
    assert one.result.outcome is Outcome.PROVED_IMPOSSIBLE
    two = find_plans(assembly, robots=2, moves=2, stability=SETTINGS, settings=settings, target=[0, 2, 2])
    (step,) = [row for row, way in enumerate(two.plans[0].exit_paths) if way]
    aside, out = two.plans[0].exit_paths[step]
    assert (aside.parts, out.parts) == ((1,), (0,))
    assert validate_plan(two.plans[0], assembly, SETTINGS).good


def test_a_part_that_rests_on_one_that_moves_aside_falls_meanwhile() -> None:
    """So the bar may not move aside while something lies on it, although there is room."""
    hollow = {(1, 1, z) for z in range(4)} | {(x, 1, z) for x in range(1, 5) for z in (2, 3)}
    pin, bar, rider = {(1, 1, 0), (1, 1, 1)}, {(1, 1, 2), (2, 1, 2)}, {(2, 1, 3)}
    frame = cells(range(-1, 6), range(3), range(-1, 4)) - hollow - pin - bar - rider
    frame |= {(x, y, 4) for x in range(2, 6) for y in range(3)} | {(5, y, z) for y in range(3) for z in range(5)}
    assembly = of_cubes(pin, bar, rider, frame=frame)
    state = np.array([[2, 2, 1, 2]], dtype=np.uint8)
    free = make_task(assembly, 2, moves=3).clearance
    assert free is not None
    assert free.can_leave(state)[0, 0]
    judged = make_task(assembly, 2, moves=3).judged_by(StabilityOracle(assembly))
    assert judged.clearance is not None
    assert not judged.clearance.can_leave(state)[0, 0]


def test_ways_are_written_and_read(plan: Plan) -> None:
    data = json.loads(json.dumps(plan_to_dict(plan)))
    assert data["rules"]["moves"] == 2
    assert [move.keys() for move in data["steps"][0]["exit_path"]] == [{"direction", "distance"}] * 2
    again = plan_from_dict(data)
    assert again.exit_paths == plan.exit_paths
    straight = find_plans("arch:blocks=3", moves=4).plans[0]
    assert straight.moves == 1
    assert "moves" not in plan_to_dict(straight)["rules"]
    assert not any("exit_path" in step for step in plan_to_dict(straight)["steps"])


def change(data: Any, value: Any, *path: Any) -> Any:
    data = copy.deepcopy(data)
    inner = data
    for key in path[:-1]:
        inner = inner[key]
    inner[path[-1]] = value
    return data


@pytest.mark.parametrize(
    ("value", "path", "message"),
    [
        (1, ("rules", "moves"), "step 1 has 2 moves; at most 1 with rules.moves"),
        (0, ("rules", "moves"), "rules.moves is 0; give a whole number >= 1"),
        (101, ("rules", "moves"), "rules.moves is 101; give a whole number <= 100"),
        (False, ("rules", "removable_only_if_clear"), "they need rules.removable_only_if_clear"),
        (
            [1.0, 1.0, 0.0],
            ("steps", 0, "exit_path", 0, "direction"),
            r"exit_path\[0\].direction is no unit vector",
        ),
        (0.0, ("steps", 0, "exit_path", 1, "distance"), r"exit_path\[1\] moves nothing"),
        (-1.0, ("steps", 0, "exit_path", 1, "distance"), r"exit_path\[1\].distance is -1.0"),
        (
            [9],
            ("steps", 0, "exit_path", 1, "parts"),
            r"exit_path\[1\].parts\[0\] is 9; it must be a part from 0 to 6",
        ),
        ([], ("steps", 0, "exit_path", 1, "parts"), r"exit_path\[1\].parts is empty"),
        (
            1e9,
            ("steps", 0, "exit_path", 1, "angle"),
            r"exit_path\[1\] has only one of angle and point; a turn has both",
        ),
        (
            [{"direction": [1.0, 0.0, 0.0], "distance": 1.0}],
            ("steps", 1, "exit_path"),
            "step 2 has an exit_path",
        ),
    ],
)
def test_damaged_ways_are_refused(plan: Plan, value: Any, path: tuple, message: str) -> None:
    data = json.loads(json.dumps(plan_to_dict(plan)))
    with pytest.raises(PlanError, match=message):
        plan_from_dict(change(data, value, *path))


def test_a_check_takes_no_way_from_a_plan_without_sweeping_it(plan: Plan, drawer: Assembly) -> None:
    up, out = plan.exit_paths[0]

    def reason(*moves: PathMove, **changes: Any) -> str:
        bare = replace(plan, displacement=None, loads=(), replay=None, exit_paths=(moves, ()), **changes)
        return validate_plan(bare, drawer).reason

    assert reason(up, out) == ""
    assert "finds no straight way past the other parts" in reason()
    assert "its way has 3 moves, and 2 are allowed" in reason(up, out, out)
    assert "on its way out, move 1 takes drawer-0 into lip-6" in reason(out)
    assert "move 1 takes drawer-0 into top-5" in reason(replace(up, distance=0.2), out)
    assert "move 2 takes drawer-0 into lip-6" in reason(replace(up, distance=0.05), out)
    assert "its moves end while drawer-0 is still among the other parts" in reason(up, replace(out, distance=0.2))
    assert "its way moves top-5, which no robot holds" in reason(replace(up, parts=(5,)), out)
    assert "the last move of its way is not that of the part alone" in reason(up, replace(out, parts=(0, 5)))


def test_pictures_and_files_of_other_programs_show_the_way(plan: Plan, drawer: Assembly) -> None:
    assembly = drawer
    timeline = Timeline.from_plan(plan, assembly)
    far = TRAVEL * diagonal(assembly)
    up, out = plan.exit_paths[0]
    length = up.distance + min(out.distance, far)
    at_corner = appearance_at(timeline, 1.0 - 2.0 * up.distance / length).shift[0] if length > 2 * up.distance else None
    assert at_corner is not None
    np.testing.assert_allclose(at_corner, [0.0, 0.0, up.distance], atol=1e-9)
    np.testing.assert_allclose(
        timeline.displacements(0, 1.0, far)[0][:3, 3], [min(out.distance, far), 0.0, up.distance]
    )
    path = tracks_of(plan, assembly).tracks[0].path
    np.testing.assert_allclose(
        [place for _, place in path], [[out.distance, 0, up.distance], [0, 0, up.distance], [0] * 3]
    )
    assert "from +x, then from above" in instructions_csv(make_sheet(assembly, plan))


def test_replanning_goes_on_with_ways_of_several_moves(plan: Plan, drawer: Assembly) -> None:
    """What a plan allows is allowed from then on; ways that are done are kept."""
    for step in range(len(plan) + 1):
        answer = replan(plan, step=step, structure=drawer)
        assert answer.value is not None
        assert answer.value.exit_paths == plan.exit_paths
        assert validate_plan(answer.value, drawer).good
    bare = replan(drawer, "empty", target="complete", moves=2, robots=1)
    assert bare.value is not None
    assert bare.value.moves == 2
    with pytest.raises(StateError, match="no part has a free way"):
        replan(drawer, "empty", target="complete", removable_only_if_clear=True, robots=1)


def test_alternatives_and_repeated_holds_leave_in_several_moves() -> None:
    """Two blocks in two blind tunnels; they leave in either order."""
    hollow = {(x, y, 0) for x in range(4) for y in (0, 2)} | {(3, y, z) for y in (0, 2) for z in range(3)}
    frame = cells(range(-1, 5), range(-1, 4), range(-1, 3)) - hollow
    assembly = of_cubes({(0, 0, 0)}, {(0, 2, 0)}, frame=frame)
    rules = {"robots": 1, "moves": 2, "stability": SETTINGS}
    found = find_plans(assembly, settings=PlannerSettings(alternatives=2), **rules)
    assert len({plan.states.tobytes() for plan in found.plans}) == 2
    for plan in (*found.plans, *find_plans(assembly, allow_regrasp=True, **rules).plans):
        assert sum(map(bool, plan.exit_paths)) == 2
        assert validate_plan(plan, assembly, SETTINGS).good


def test_sets_of_parts_and_several_moves_go_together() -> None:
    """A block that leaves around a corner, beside two boards, of which one robot can only move both."""
    shelf = built_in_shelf(shelves=0)
    hollow = {(x, 0, 0) for x in range(4)} | {(3, 0, z) for z in range(3)}
    walls = cells(range(-1, 5), range(-1, 2), range(-1, 3)) - hollow
    solids = [surface(name, frozenset(some), (EDGE,) * 3, (2.0, 0.0, 0.1)) for name, some in (("key", {(0, 0, 0)}),)]
    solids.append(replace(surface("frame", frozenset(walls), (EDGE,) * 3, (2.0, 0.0, 0.1)), fixed=True))
    blocks = gather(solids)
    boundary = [*np.flatnonzero(shelf.boundary).tolist(), shelf.part_count + 1]
    assembly = Assembly.from_meshes([*shelf.meshes, *blocks.meshes], boundary=boundary)
    plan = find_plans(assembly, robots=1, parts_at_once=2, moves=2, stability=SETTINGS).plans[0]
    assert (plan.parts_at_once, plan.moves) == (2, 2)
    assert validate_plan(plan, assembly, SETTINGS).good


@cache
def hooked() -> Assembly:
    """Two pieces that hook each other in a bent tunnel, so that neither leaves without the other."""
    one = {(0, 0, 0), (0, 0, 1), (0, 1, 0), (1, 0, 1), (1, 0, 2), (1, 1, 2)}
    other = cells(range(2), range(2), range(3)) - one
    hollow = cells(range(6), range(2), range(3)) | cells(range(4, 6), range(2), range(5))
    return of_cubes(one, other, frame=cells(range(-1, 7), range(-1, 3), range(-1, 5)) - hollow)


@pytest.mark.parametrize("robots", [1, 2])
def test_two_parts_leave_together_in_several_moves(robots: int, tmp_path: Path) -> None:
    """Carried by one robot, or held by two; one at a time, or in one move, they do not leave."""
    assembly = hooked()
    rules = {"robots": robots, "stability": SETTINGS, "settings": PlannerSettings(directions=(Direction.DISASSEMBLY,))}
    alone = find_plans(assembly, moves=2, **rules)
    assert alone.result.outcome is not Outcome.FOUND
    straight = find_plans(assembly, parts_at_once=2, **rules)
    assert straight.result.outcome is not Outcome.FOUND
    start = [2, 2 if robots == 2 else 1, 2]
    (plan,) = find_plans(assembly, parts_at_once=2, moves=2, start=start, **rules).plans
    (way,) = [way for way in plan.exit_paths if way]
    assert [move.parts for move in way] == [(0, 1)] * 2
    assert int((plan.states == 2)[:, :2].sum(axis=1).max()) == robots
    assert validate_plan(plan, assembly, SETTINGS).good
    save(plan, tmp_path / "plan.json")
    again = load(tmp_path / "plan.json")
    assert isinstance(again, Plan)
    assert again.exit_paths == plan.exit_paths
    assert validate_plan(again, assembly, SETTINGS).good
    step = next(number for number, way in enumerate(plan.exit_paths) if way)
    shown = Timeline.from_plan(plan, assembly).displacements(0, 1.0, 1.0)
    np.testing.assert_allclose(shown[0], shown[1])
    assert tracks_of(plan, assembly).tracks[0].path == tracks_of(plan, assembly).tracks[1].path
    up, out = way
    for moves, why in [
        ((up, replace(out, parts=(0,))), "the last move of its way is not that of its parts together"),
        ((replace(up, parts=(0,)), out), "move 1 takes" if robots == 2 else "do not move as one body"),
        ((out, up), "move 1 takes"),
        ((replace(up, parts=(0, 1, 2)), out), "its way moves frame-2, which no robot holds"),
    ]:
        paths = (*plan.exit_paths[:step], moves, *plan.exit_paths[step + 1 :])
        bare = replace(plan, displacement=None, loads=(), replay=None, exit_paths=paths, waiting=True)
        assert why in validate_plan(bare, assembly, SETTINGS).reason


def test_more_sets_than_can_be_examined_are_no_proof() -> None:
    """Then those are tried that lock each other in place."""
    task = make_task(hooked(), 1, moves=2, parts_at_once=2)
    assert sets_of(task, task.start == INSTALLED)[1] == ""
    few, why = sets_of(task, task.start == INSTALLED, most=0)
    assert set(few) <= set(sets_of(task, task.start == INSTALLED)[0])
    assert "sets of parts those were tried that lock each other in place" in why


def test_a_search_for_a_way_ends_at_the_deadline() -> None:
    """And so does the search for a plan around it."""
    new = replace(shaft())  # no way out of it is known yet
    task = make_task(new, 1, moves=2)
    calls: list[int] = []

    def late() -> None:
        calls.append(1)
        raise DeadlineExceeded

    assert task.clearance is not None
    task.clearance.prepare()
    with interrupted_by(late), pytest.raises(DeadlineExceeded):
        task.clearance.can_leave(task.start[None])
    assert calls == [1]
    with interrupted_by(late):
        found = Planner(task, StabilityOracle(new, SETTINGS)).run()
    assert found.interrupted
    assert not found.found


@pytest.mark.parametrize(
    ("rules", "message"),
    [
        ({"moves": 0}, "0 is not a number of moves of a way out; give 1 .* to 100"),
        ({"moves": 101}, "101 is not a number of moves"),
        ({"moves": 1.5}, "1.5 is not a number of moves"),
    ],
)
def test_wrong_numbers_are_refused(rules: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        make_task("arch:blocks=3", 2, **rules)


def test_ways_out_can_be_sent_to_another_process() -> None:
    assembly, state = shaft(), np.array([[2, 2]], dtype=np.uint8)
    sent = pickle.loads(pickle.dumps(make_task(assembly, 2, moves=2).clearance))
    np.testing.assert_array_equal(sent.can_leave(state), [[True, False]])


def test_no_number_of_robots_is_refuted_where_holds_open_ways() -> None:
    """With two robots, the fewest, the bar is held aside."""
    found = min_robots(latch(), stability=SETTINGS, moves=2, target=[0, 2, 2])
    assert found.value == 2


def rings(name: str, sections: list[np.ndarray], *, close: bool) -> TriangleMesh:
    """Surface through polygons, counter-clockwise seen from the last one, that two caps or a ring close."""
    count, number = len(sections[0]), len(sections)
    faces = []
    for a in range(number if close else number - 1):
        for i in range(count):
            j, b = (i + 1) % count, (a + 1) % number
            p, q, r, s = a * count + i, a * count + j, b * count + j, b * count + i
            faces += [(p, q, r), (p, r, s)]
    if not close:
        last = (number - 1) * count
        faces += [(0, i + 1, i) for i in range(1, count - 1)]
        faces += [(last, last + i, last + i + 1) for i in range(1, count - 1)]
    return TriangleMesh.from_arrays(name, np.concatenate(sections), faces)


def polygon(radius: float, count: int) -> np.ndarray:
    turn = 2 * np.pi * (np.arange(count) + 0.5) / count
    return np.stack([radius * np.cos(turn), radius * np.sin(turn), 0 * turn], axis=1)


def twisted(shape: np.ndarray, low: float, high: float, rate: float, steps: int) -> list[np.ndarray]:
    return [
        shape @ Rotation.from_rotvec([0.0, 0.0, rate * z]).as_matrix().T + (0.0, 0.0, z)
        for z in np.linspace(low, high, steps + 1)
    ]


def bolt(turns: float = 0.5, clearance: float = 2e-3, depth: float = 0.1) -> Assembly:
    """A square bolt that winds through a plate, with a head on top of it."""
    rate, steps = 2 * np.pi * turns / depth, int(120 * turns)
    shape, plate = polygon(0.02, 4), polygon(0.08, 4)
    head = [2 * shape, 2 * shape + (0.0, 0.0, 0.02)]
    inside = twisted(polygon(0.02 + clearance, 4), -depth, 0.0, rate, steps)
    meshes = [
        rings("bolt", [*twisted(shape, -depth, 0.0, rate, steps), *head], close=False),
        rings("plate", [plate + (0.0, 0.0, -depth), plate, *inside[::-1]], close=True),
    ]
    return Assembly.from_meshes(meshes, boundary=[1], name="bolt")


@pytest.fixture(scope="module")
def screwed() -> tuple[Assembly, Plan]:
    assembly = bolt()
    return assembly, find_plans(assembly, robots=1, turns=True, stability=SETTINGS).plans[0]


def test_a_bolt_screws_out_of_its_thread(screwed: tuple[Assembly, Plan]) -> None:
    assembly, plan = screwed
    (move,) = plan.exit_paths[0]
    pitch = 0.1 / np.pi
    np.testing.assert_allclose(move.direction, (0.0, 0.0, 1.0), atol=1e-3)
    assert move.distance / move.angle == pytest.approx(pitch, rel=5e-3)
    assert validate_plan(plan, assembly, SETTINGS).good
    again = plan_from_dict(json.loads(json.dumps(plan_to_dict(plan))))
    assert again.exit_paths == plan.exit_paths
    assert again.turns


def test_another_pitch_or_axis_does_not_pass(screwed: tuple[Assembly, Plan]) -> None:
    assembly, plan = screwed
    (move,) = plan.exit_paths[0]
    x, y, z = move.point
    for wrong in (
        replace(move, angle=0.0),
        replace(move, angle=-move.angle),
        replace(move, angle=1.3 * move.angle),
        replace(move, point=(x + 0.1, y, z)),
        replace(move, direction=(1.0, 0.0, 0.0)),
    ):
        bare = replace(plan, forces=None, exit_paths=((wrong,), ()))
        assert "move 1 takes bolt into plate" in validate_plan(bare, assembly, SETTINGS).reason
    bare = replace(plan, forces=None, turns=False)
    assert "its way has a turn, and none is allowed" in validate_plan(bare, assembly, SETTINGS).reason


def test_turns_are_shown_in_pictures_and_refused_by_name_elsewhere(screwed: tuple[Assembly, Plan]) -> None:
    assembly, plan = screwed
    (move,) = plan.exit_paths[0]
    look = appearance_at(Timeline.from_plan(plan, assembly), 0.5)
    turn = Rotation.from_matrix(look.turn[0]).as_rotvec()
    share = look.shift[0, 2] / move.distance
    assert 0.0 < share < 1.0
    np.testing.assert_allclose(turn, share * move.angle * np.array(move.direction), atol=1e-9)
    np.testing.assert_allclose(
        look.moved(0, assembly.meshes[0].vertices), apply(move.displacement(share), assembly.meshes[0].vertices)
    )
    assert "from above, turning by 180°" in instructions_csv(make_sheet(assembly, plan))
    with pytest.raises(PlanError, match="a part turns on its way in, which these files cannot show"):
        tracks_of(plan, assembly)


@cache
def lid() -> Assembly:
    """A lid behind a low wall, with its back end under a ledge: it tips up, and slides out along its own plane."""
    blocks = gather(
        [
            box("lid", (0.0, 0.0, 0.0), (0.3, 0.2, 0.02)),
            box("floor", (-0.05, -0.05, -0.05), (0.35, 0.25, 0.0), fixed=True),
            box("back", (-0.05, -0.05, 0.0), (-0.01, 0.25, 0.1), fixed=True),
            box("ledge", (-0.01, -0.05, 0.03), (0.03, 0.25, 0.1), fixed=True),
            box("side", (-0.01, -0.05, 0.0), (0.3, 0.0, 0.03), fixed=True),
            box("side", (-0.01, 0.2, 0.0), (0.3, 0.25, 0.03), fixed=True),
            box("front", (0.3, -0.05, 0.0), (0.35, 0.25, 0.02), fixed=True),
        ]
    )
    return Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary, name="lid")


def test_a_lid_tips_up_and_slides_out_and_no_straight_moves_do() -> None:
    assembly = lid()
    straight = find_plans(assembly, robots=1, moves=8, stability=SETTINGS)
    assert straight.result.outcome is Outcome.PROVED_IMPOSSIBLE
    plan = find_plans(assembly, robots=1, moves=2, turns=True, stability=SETTINGS).plans[0]
    tip, slide = plan.exit_paths[0]
    np.testing.assert_allclose(np.abs(tip.direction), (0.0, 1.0, 0.0), atol=1e-6)
    assert 0.1 < abs(tip.angle) < 0.4
    assert slide.direction[0] == pytest.approx(np.cos(tip.angle), abs=1e-6)
    assert validate_plan(plan, assembly, SETTINGS).good


def test_what_turns_could_do_is_not_proven() -> None:
    """A block shut in has nothing to turn about; another that has room inside might have a way that was not sought."""
    closed = of_cubes({(0, 0, 0)}, frame=cells(*[range(-1, 2)] * 3) - {(0, 0, 0)})
    found = find_plans(closed, robots=1, moves=3, turns=True, stability=SETTINGS)
    assert found.result.outcome is Outcome.PROVED_IMPOSSIBLE
    roomy = of_cubes({(0, 0, 0)}, frame=cells(*[range(-1, 3)] * 3) - cells(*[range(2)] * 3))
    found = find_plans(roomy, robots=1, moves=2, turns=True, stability=SETTINGS)
    assert found.result.outcome is Outcome.NOT_FOUND
    assert "straight moves and turns were sought along the faces and edges of parts" in found.result.limit
    found = find_plans(roomy, robots=1, moves=9, stability=SETTINGS)
    assert found.result.outcome is Outcome.PROVED_IMPOSSIBLE


@pytest.mark.parametrize(("seed", "first"), [(174, 1), (231, 0), (357, 1), (395, 1)])
def test_interlocked_pieces_open_once_others_are_shifted(seed: int, first: int) -> None:
    """Four pieces of a box, one of them fixed, of which none leaves in one move, and one once another is shifted."""
    drawn = grow_pieces([*product(range(4), range(3), range(3))], 4, np.random.default_rng(seed))
    assert drawn is not None
    *pieces, frame = map(set, drawn)
    assembly, held = of_cubes(*pieces, frame=frame), np.array([[2, 2, 2, 2]], dtype=np.uint8)
    clearance = make_task(assembly, 3, moves=2).clearance
    assert clearance is not None
    np.testing.assert_array_equal(np.flatnonzero(clearance.can_leave(held)[0, :3]), [first])
    target = np.where(np.arange(4) == first, 0, 2)
    one = find_plans(assembly, robots=3, removable_only_if_clear=True, stability=SETTINGS, target=target)
    assert one.result.outcome is Outcome.PROVED_IMPOSSIBLE
    plan = find_plans(assembly, robots=3, moves=2, stability=SETTINGS, target=target).plans[0]
    (path,) = filter(None, plan.exit_paths)
    assert len(path) == 2
    assert path[0].parts != path[1].parts == (first,)
    assert validate_plan(plan, assembly, SETTINGS).good
