"""Plans: what they say, what they are read from, and that bad ones are caught."""

from __future__ import annotations

import base64
import json
import re
import zlib
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import jsonschema
import numpy as np
import pytest

from falsework import (
    Action,
    Assembly,
    Direction,
    Plan,
    StabilityOracle,
    StabilitySettings,
    Task,
    Verdict,
    find_plans,
    load_structure,
)
from falsework.errors import InputError, PlanError
from falsework.search import Demands, PlanMargins
from falsework.search.plans.packed_proofs import pack_proofs
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import load_plan, plan_from_dict, plan_to_dict, save_plan
from falsework.search.plans.plan_model import plan_schema
from falsework.stability.settings import EQUILIBRIUM
from tests.older_files import as_version_3


@pytest.fixture(scope="module")
def plan(small_arch: Assembly, arch_oracle: StabilityOracle) -> Plan:
    planning = find_plans(small_arch, oracle=arch_oracle)
    assert planning.found
    return planning.plans[0]


@pytest.fixture
def data(plan: Plan, tmp_path: Path) -> dict[str, Any]:
    save_plan(plan, tmp_path / "plan.json", proofs=True)
    return json.loads((tmp_path / "plan.json").read_text())


def same(a: Plan, b: Plan) -> bool:
    arrays = ("states", "actions", "verdicts", "proofs", "boundary", "forces")
    values = ("name", "identity", "part_names", "friction", "robots", "claim", "fixed", "missing")
    return (
        all(np.array_equal(getattr(a, name), getattr(b, name)) for name in arrays)
        and all(getattr(a, name) == getattr(b, name) for name in values)
        and np.allclose(a.residuals, b.residuals, rtol=1e-5)
        and a.removable_only_if_clear == b.removable_only_if_clear
        and np.array_equal(np.asarray(a.displacement, float), np.asarray(b.displacement, float), equal_nan=True)
    )


def test_every_state_is_proven_anew(plan: Plan, small_arch: Assembly) -> None:
    report = validate_plan(plan, small_arch)
    assert report.good
    assert report.checked == report.states == len(plan) + 1 == 2 * 7 + 1
    assert report.certified == report.states
    assert report.residual == pytest.approx(plan.residuals.max())
    assert report.residual <= 1e-4
    assert report.bad_step is None


def test_a_plan_is_the_sequence_of_its_steps(plan: Plan, small_arch: Assembly) -> None:
    """In the order of assembly: from the boundary alone to the complete structure."""
    boundary, parts = small_arch.boundary, small_arch.part_count
    assert np.array_equal(plan.states[0], np.where(boundary, 2, 0))
    assert np.array_equal(plan.states[-1], np.where(boundary, 2, 1))
    assert list(plan) == list(plan.steps)
    assert plan[0] is plan.steps[0]
    assert plan[-2:] == plan.steps[-2:]
    assert [step.number for step in plan] == list(range(1, len(plan) + 1))
    with pytest.raises(IndexError, match=f"the plan has {len(plan)} steps, from index 0"):
        plan[len(plan)]
    for step, before in zip(plan, plan.states, strict=False):
        value, now = before[step.part], step.state[step.part]
        assert (value, now) == {Action.INSERT: (0, 2), Action.RELEASE: (2, 1)}[step.action]
        assert (step.state != before).sum() == 1
        assert step.state is not before
        assert np.array_equal(step.state, plan.states[step.number])
        assert step.name == small_arch.names[step.part]
        assert step.verdict is Verdict.STABLE
        assert plan.words(step.number) == f"{step.action} {step.name}"
        assert plan.line(step.number) == f"{step.number:4d}  {step.action} {step.name} (R{(step.robot or 0) + 1})"
    assert plan.words(0) == ""
    assert plan.line(0) == "   0  start"
    actions = [step.action for step in plan]
    assert actions.count(Action.INSERT) == actions.count(Action.RELEASE) == 7
    assert plan[0].action is Action.INSERT
    assert int(plan.actions[0]) == parts + plan[0].part


def test_a_robot_keeps_the_part_that_it_holds(plan: Plan) -> None:
    """One robot brings a part and lets go of it; no robot has two parts; a robot that is free takes the next part."""
    holding: dict[int, int] = {}
    for step in plan:
        assert step.robot is not None
        if step.action is Action.INSERT:
            assert step.robot not in holding
            holding[step.robot] = step.part
        else:
            assert holding.pop(step.robot) == step.part
        who = plan.holders[step.number]
        assert {robot: int(np.flatnonzero(who == robot)[0]) for robot in set(who.tolist()) - {-1}} == holding
    assert not holding


def test_disassembly_undoes_the_last_step_first(plan: Plan) -> None:
    undone = plan.in_order(Direction.DISASSEMBLY)
    assert plan.in_order(Direction.ASSEMBLY) == plan.steps
    assert [step.number for step in undone] == list(range(len(plan), 0, -1))
    for step in undone:
        same_step = plan[step.number - 1]
        assert (step.part, step.robot) == (same_step.part, same_step.robot)
        assert step.action is {Action.INSERT: Action.REMOVE, Action.RELEASE: Action.HOLD}[same_step.action]
        assert np.array_equal(step.state, plan.states[step.number - 1])
        assert step.action.undone is same_step.action
    assert np.array_equal(plan.route.states, plan.states[::-1])


def test_comes_back_from_disk(plan: Plan, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    written = replace(plan, forces=None)  # they follow from the displacements
    save_plan(plan, path, proofs=True)
    assert same(load_plan(path), written)
    assert load_plan(path).claim == plan.claim
    assert load_plan(path).replay == plan.replay
    save_plan(plan, path)
    assert load_plan(path).displacement is None
    assert same(replace(load_plan(path), displacement=plan.displacement), written)
    assert [entry.name for entry in tmp_path.iterdir()] == ["plan.json"]


@pytest.mark.parametrize("proofs", [False, True])
def test_files_follow_the_published_schema(plan: Plan, tmp_path: Path, proofs: bool) -> None:
    schema = plan_schema()
    jsonschema.Draft202012Validator.check_schema(schema)
    path = tmp_path / "plan.json"
    save_plan(plan, path, proofs=proofs)
    jsonschema.Draft202012Validator(schema).validate(json.loads(path.read_text()))


@pytest.mark.parametrize("direction", list(Direction))
def test_plans_of_version_3_are_read_in_the_order_of_assembly(
    plan: Plan, balanced: tuple[Assembly, Plan], small_arch: Assembly, tmp_path: Path, direction: Direction
) -> None:
    margins = PlanMargins.from_oracle(StabilityOracle(small_arch), plan.states, Demands(friction=1.05))
    recorded = replace(plan, margins=margins)
    for made, assembly, settings in (
        (recorded, small_arch, StabilitySettings()),
        (balanced[1], balanced[0], EQUILIBRIUM),
    ):
        path = tmp_path / "old.json"
        path.write_text(json.dumps(as_version_3(made, direction)))
        old = load_plan(path)
        forces = made.forces if settings is EQUILIBRIUM else None
        assert same(old, replace(made, forces=forces))
        assert old.replay == made.replay
        assert (old.margins is None) == (made.margins is None)
        if old.margins is not None:
            assert old.margins.measured["friction"] == pytest.approx(margins.measured["friction"], rel=1e-8)
        assert validate_plan(old, assembly, settings).good
        save_plan(old, path, proofs=True)
        assert json.loads(path.read_text())["format"] == "falsework.plan/4"
        assert same(load_plan(path), old)


@pytest.mark.parametrize("direction", [None, "sideways", ["assembly"]])
def test_a_plan_of_version_3_says_its_order(plan: Plan, direction: Any) -> None:
    old = as_version_3(plan, Direction.ASSEMBLY) | {"direction": direction}
    with pytest.raises(PlanError, match=re.escape(f"direction is {direction!r}; it must be disassembly or assembly")):
        plan_from_dict(old)


@pytest.mark.parametrize("key", ["start", "steps", "end", "needs", "rules"])
@pytest.mark.parametrize("wrong", [None, 3, [], {}, [3]])
def test_damaged_plans_of_version_3_are_refused(plan: Plan, key: str, wrong: Any) -> None:
    old = as_version_3(plan, Direction.DISASSEMBLY) | {key: wrong}
    if old["needs"] == wrong == []:
        return
    with pytest.raises(PlanError, match="is not a valid plan: "):
        plan_from_dict(old)


def edit(*keys: Any, to: Any) -> Callable[[dict[str, Any]], None]:
    def change(data: dict[str, Any]) -> None:
        inner: Any = data
        for key in keys[:-1]:
            inner = inner[key]
        if to is ...:
            del inner[keys[-1]]
        else:
            inner[keys[-1]] = to

    return change


WRONG_BY_SCHEMA = [
    (edit("format", to="falsework.plan/5"), "format is 'falsework.plan/5'"),
    (
        edit("format", to="falsework.robot-plan/2"),
        "it is a file of another kind (robot plan); give a file that `falsework plan` wrote, or check this one by "
        "`falsework robots check`",
    ),
    (edit("format", to=...), 'no "format"'),
    (edit("surprise", to=1), "surprise is not known; known are displacements, end,"),
    (edit("steps", 2, "surprise", to=1), "steps[2].surprise is not known; known are bears, do,"),
    (edit("rules", "surprise", to=1), "rules.surprise is not known"),
    (edit("robots", to=...), "robots is missing; it may be damaged or from another version"),
    (edit("robots", to=0), "robots is 0; give a whole number >= 1 (parts that can be held at once)"),
    (edit("robots", to=2.5), "robots is 2.5"),
    (edit("robots", to=True), "robots is True"),
    (edit("direction", to="assembly"), "direction is not known"),
    (edit("structure", "parts", to=[]), "structure.parts"),
    (edit("structure", "friction", to=-0.1), "structure.friction is -0.1"),
    (edit("structure", "name", to=7), "structure.name"),
    (edit("structure", to=[]), "structure is []; give an object"),
    (edit("rules", "fixed", to=[1.5]), "rules.fixed"),
    (edit("rules", "fixed", to=[1, 1]), "rules.fixed names a part twice"),
    (edit("rules", "removable_only_if_clear", to="no"), "removable_only_if_clear"),
    (edit("stability", "cone", to="pyramid"), "stability.cone is 'pyramid'"),
    (edit("stability", "gravity", to=0), "stability.gravity is 0; give a number > 0 (m/s2 along -z)"),
    (edit("steps", to={}), "steps is {}; give a list"),
    (edit("steps", 0, "do", to="remove"), "step 1 does 'remove' with part"),
    (edit("steps", 0, "do", to="juggle"), "steps[0].do is 'juggle'; give one of insert, release, hold, remove"),
    (edit("steps", 0, "part", to=-1), "steps[0].part is -1; give a whole number >= 0"),
    (edit("steps", 0, "verdict", to="unstable"), "steps[0].verdict is 'unstable'; give one of stable, undecided"),
    (edit("steps", 0, "proof", to="none"), "proof 'none'"),
    (edit("steps", 0, "residual", to=-1), "residual is -1"),
    (edit("steps", 0, "residual", to="small"), "residual is 'small'"),
    (edit("start", "state", 1, to=3), "start.state"),
    (edit("end", 1, to="0"), "end[1] is '0'; give one of 0, 1, 2"),
    (edit("needs", to=[{"part": 1}]), "needs"),
    (edit("displacements", "zlib_base64", to=3), "displacements.zlib_base64 is 3; give a text"),
]
WRONG_BY_CONTENT = [
    (edit("structure", "boundary", to=[99]), "structure.boundary"),
    (edit("structure", "parts", to=["a", "b"]), "structure.boundary"),
    (edit("steps", 0, "part", to=99), "steps[0].part is 99; it must be a part from 0 to 8"),
    (edit("steps", 1, "do", to="insert"), "step 2 cannot insert part"),
    (edit("steps", 0, to=...), "cannot release part"),
    (edit("steps", -1, to=...), "do not lead to its end"),
    (edit("robots", to=1), "needs 2 robots"),
    (edit("end", to=[2, 1]), "end has 2 values for 9 parts"),
    (edit("start", "residual", to=0.5), "above the tolerance"),
    (edit("needs", to=[{"part": 1, "after_steps": 1, "after_parts": 1}]), "needs do not agree"),
    (edit("displacements", "parts", to=5), "displacements.parts is 5; the plan has 9 parts"),
    (edit("displacements", "zlib_base64", to="eJwDAAAAAAE="), "does not hold"),
    (edit("displacements", "zlib_base64", to="rubbish!"), "cannot be unpacked"),
    (edit("rules", "fixed", to=[3]), "which is fixed"),
]


@pytest.mark.parametrize(("change", "message"), [*WRONG_BY_SCHEMA, *WRONG_BY_CONTENT])
def test_reads_strictly(data: dict[str, Any], tmp_path: Path, change: Any, message: str) -> None:
    change(data)
    path = tmp_path / "bad.json"
    path.write_text(json.dumps(data))
    with pytest.raises(PlanError) as caught:
        load_plan(path)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(("change", "message"), WRONG_BY_SCHEMA)
def test_the_schema_is_as_strict(data: dict[str, Any], change: Any, message: str) -> None:
    change(data)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(plan_schema()).validate(data)


def test_fragments_are_rejected(plan: Plan, tmp_path: Path) -> None:
    path = tmp_path / "plan.json"
    save_plan(plan, path)
    text = path.read_bytes()
    for keep in range(0, len(text.rstrip()), 97):
        path.write_bytes(text[:keep])
        with pytest.raises(PlanError, match="truncated"):
            load_plan(path)
    for other in (b"[]", b"3", b'"falsework.plan/1"', b"{}"):
        path.write_bytes(other)
        with pytest.raises(PlanError, match="not a valid plan"):
            load_plan(path)
    path.write_bytes(b"\xff\xfe")
    with pytest.raises(PlanError, match="it is no text"):
        load_plan(path)
    with pytest.raises(PlanError, match="there is no plan file"):
        load_plan(tmp_path / "none.json")


def test_a_plan_is_for_one_structure(plan: Plan, small_arch: Assembly) -> None:
    with pytest.raises(PlanError, match="for another structure: its hash"):
        validate_plan(plan, small_arch.replace(friction=0.3))
    with pytest.raises(PlanError, match="with 9 parts"):
        validate_plan(plan, load_structure("arch:blocks=5"))


def test_the_first_unstable_state_is_found(plan: Plan, small_arch: Assembly) -> None:
    """Holding is left out of a plan for one robot's worth of steps: the arch falls, and the report says when."""
    states = plan.states.copy()
    step = int(np.flatnonzero(plan.actions >= len(plan.boundary))[-1])  # the last insertion
    # Claim a plan that ends before it with no robot holding anything: legal states, but nothing keeps them up.
    loose = states[step].copy()
    loose[(loose == 2) & ~plan.boundary] = 1
    let_go = int(np.flatnonzero(loose == 1)[0])
    before = loose.copy()
    before[let_go] = 2
    fallen = replace(
        plan,
        states=np.array([before, loose, states[-1]]),
        actions=np.array([let_go, plan[step].part + len(plan.boundary)]),
        forces=None,
    )
    # The states do not follow from the actions, which is found without any solver.
    assert "does not lead to the next state" in validate_plan(fallen, small_arch).reason
    ends = replace(fallen, states=np.array([before, loose]), actions=np.array([let_go]))
    report = validate_plan(ends, small_arch)
    assert not report.good
    assert report.checked == 0
    assert report.bad_step == 0
    assert "unstable at the beginning" in report.reason
    assert report.verdict is not None
    assert report.verdict.unstable[0]
    assert report.verdict.velocity is not None
    assert np.abs(report.verdict.velocity).max() > 0


def test_a_release_without_support_is_found_where_it_happens(small_arch: Assembly, plan: Plan) -> None:
    """Let go of a block before its neighbours are there: legal, and unstable at the step of its release."""
    blocks, parts = np.flatnonzero(~plan.boundary), len(plan.boundary)
    block = int(blocks[3])
    states = np.repeat(plan.states[:1], 3, axis=0)
    states[1:, block] = [2, 1]
    bad = replace(plan, states=states, actions=np.array([parts + block, block]), forces=None)
    report = validate_plan(bad, small_arch)
    assert report.checked == 2
    assert report.bad_step == 2
    assert f"after step 2 (release {plan.part_names[block]})" in report.reason


def test_broken_rules_are_found(plan: Plan, small_arch: Assembly) -> None:
    one = replace(plan, robots=1)
    assert "every robot is holding" in validate_plan(one, small_arch).reason
    fixed = replace(plan, fixed=(plan[0].part,))
    assert "touches a fixed part" in validate_plan(fixed, small_arch).reason
    early = replace(plan, actions=np.array([plan[0].part, *plan.actions[1:]]))
    assert "against the rules: the part is removed" in validate_plan(early, small_arch).reason


def test_wrong_displacements_are_found(plan: Plan, small_arch: Assembly) -> None:
    assert plan.displacement is not None
    half = replace(plan, displacement=0.5 * plan.displacement)
    assert not validate_plan(half, small_arch).good
    misfit = validate_plan(replace(plan, displacement=plan.displacement[:, :, 1:]), small_arch)
    assert "displacements of shape" in misfit.reason
    with pytest.raises(PlanError, match="carries no displacements"):
        save_plan(replace(plan, displacement=None), "plan.json", proofs=True)


@pytest.fixture(scope="module")
def balanced() -> tuple[Assembly, Plan]:
    """A vault with a plan whose proofs are forces."""
    vault = load_structure("vault:parts=62")
    return vault, find_plans(vault, oracle=StabilityOracle(vault, EQUILIBRIUM)).plans[0]


@pytest.fixture
def changes(balanced: tuple[Assembly, Plan]) -> dict[str, Any]:
    """Return a plan file that has what changes from state to state only, as those of large plans."""
    forces = balanced[1].forces
    assert forces is not None
    return plan_to_dict(balanced[1]) | {"forces": {"points": forces.shape[1], **pack_proofs(forces, whole_bytes=0)}}


def test_changes_of_forces_are_read_as_they_were(balanced: tuple[Assembly, Plan], changes: dict[str, Any]) -> None:
    vault, plan = balanced
    jsonschema.Draft202012Validator(plan_schema()).validate(changes)
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(plan_schema()).validate(changes | {"forces": {"points": 3}})
    read = plan_from_dict(changes)
    assert same(read, plan)
    report = validate_plan(read, vault, EQUILIBRIUM)
    assert report.good
    assert report.residual == validate_plan(plan, vault, EQUILIBRIUM).residual
    whole = replace(plan, forces=np.asarray(plan.forces))
    assert validate_plan(whole, vault, EQUILIBRIUM).good
    assert len(changes["forces"]["changes_zlib_base64"]) < len(
        plan_to_dict(whole, proofs=True)["forces"]["zlib_base64"]
    )


def test_forces_of_a_plan_that_were_changed_are_rejected(balanced: tuple[Assembly, Plan]) -> None:
    """Wherever one changes, in a state alone or from there on."""
    vault, plan = balanced
    assert plan.forces is not None
    forces = np.asarray(plan.forces)
    random = np.random.default_rng(0)
    places = np.argwhere(forces[:, :, 0] > 0.05 * forces[:, :, 0].max())
    for row, point in places[random.permutation(len(places))[:8]]:
        for rows in (slice(row, row + 1), slice(row, None)):
            tampered, arrays = forces.copy(), plan.forces[:].copy()
            tampered[rows, point] *= 1.5
            arrays[np.arange(len(forces))[rows]] = tampered[rows]
            report = validate_plan(replace(plan, forces=arrays), vault, EQUILIBRIUM)
            assert not report.good
            assert report.checked == row


def test_damaged_changes_are_rejected(changes: dict[str, Any]) -> None:
    points, states = changes["forces"]["points"], len(changes["steps"]) + 1
    data = zlib.decompress(base64.b64decode(changes["forces"]["changes_zlib_base64"]))
    count = np.frombuffer(data[: 4 * states], dtype="<u4").copy()

    def message(data: bytes, **other: Any) -> str:
        packed = {"changes_zlib_base64": base64.b64encode(zlib.compress(data)).decode(), "points": points} | other
        with pytest.raises(PlanError) as caught:
            plan_from_dict(changes | {"forces": packed})
        return str(caught.value)

    misfit = f"forces.changes_zlib_base64 does not hold forces of {points} points for each of {states} states"
    first = int(np.flatnonzero(count > 1)[0])
    place = 4 * (states + int(count[:first].sum()))
    swapped = data[:place] + data[place + 4 : place + 8] + data[place : place + 4] + data[place + 8 :]
    beyond = data[: place + 4 * int(count[first]) - 4] + np.uint32(points).tobytes()
    beyond += data[place + 4 * int(count[first]) :]
    many = count.copy()
    many[first] = points + 1
    for bad in (b"", data[:8], data[:-1], data + b"0", swapped, beyond, many.tobytes() + data[4 * states :]):
        assert misfit in message(bad)
    assert "does not hold" in message(np.zeros(states, dtype="<u4").tobytes(), points=10**12)
    assert "cannot be unpacked" in message(data, changes_zlib_base64="rubbish!")
    assert "must have either zlib_base64 or changes" in message(data, zlib_base64="")


def test_ways_out_are_checked(small_arch: Assembly, arch_oracle: StabilityOracle) -> None:
    """A plan that claims straight ways out is checked for them; one made with that rule passes."""
    task = Task.from_rules(small_arch.boundary, 2, clearance=small_arch.clearance, identity=small_arch.identity)
    planning = find_plans(small_arch, task, oracle=arch_oracle)
    assert planning.found
    clear = planning.plans[0]
    assert clear.removable_only_if_clear
    assert validate_plan(clear, small_arch).good

    class Shut:
        """Lets nothing into the complete structure."""

        def can_leave(self, states: Any) -> Any:
            return np.repeat((states == 0).any(axis=1)[:, None], states.shape[1], axis=1)

    shut = small_arch.replace()
    shut.__dict__["straight_ways"] = SimpleNamespace(table=Shut())
    report = validate_plan(clear, shut)
    last = max(step.number for step in clear if step.action is Action.INSERT)
    assert "finds no straight way past" in report.reason
    assert report.bad_step == last


def test_says_when_missing_parts_are_needed(plan: Plan) -> None:
    """Of seven parts, the last is needed after six others."""
    first, *_, last = plan.inserted_parts.tolist()
    (late,) = replace(plan, missing=(last,)).needs
    assert late.part == last
    assert late.after_parts == 6
    early, _ = replace(plan, missing=(last, first)).needs
    assert early.part == first
    assert (early.after_steps, early.after_parts) == (0, 0)


def test_nothing_half_written_is_left(plan: Plan, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    path = tmp_path / "plan.json"
    save_plan(plan, path)
    before = path.read_bytes()

    def fail(*_: Any) -> None:
        raise KeyboardInterrupt

    monkeypatch.setattr("os.replace", fail)
    with pytest.raises(KeyboardInterrupt):
        save_plan(replace(plan, robots=3), path)
    assert [entry.name for entry in tmp_path.iterdir()] == ["plan.json"]
    assert path.read_bytes() == before
    with pytest.raises(InputError, match="cannot write"):
        save_plan(plan, tmp_path / "no" / "plan.json")


def test_only_stable_routes_become_plans(plan: Plan, small_arch: Assembly, rules: Any) -> None:
    verdicts = rules.verdicts(np.arange(len(plan.states)) != 4)
    task = Task.from_rules(small_arch.boundary, 2)
    with pytest.raises(PlanError, match="state 4 of the plan is not proven stable"):
        Plan.from_route(plan.route, small_arch, task, verdicts)
