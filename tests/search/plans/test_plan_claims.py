"""Checks that take nothing from the plan that they check: what it says is verified, refused, or named as unverified."""

from __future__ import annotations

import base64
import copy
import json
import re
import zlib
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import jsonschema
import numpy as np
import pytest
from msgspec import structs

from falsework import Assembly, Plan, StabilityOracle, StabilitySettings, Task, find_plans, load_structure
from falsework.assembly import prop_places, with_props
from falsework.errors import InputError, PlanError
from falsework.geometry import TriangleMesh
from falsework.search import Demands, PlanMargins
from falsework.search.plans import plan_check
from falsework.search.plans.packed_proofs import unpack_proofs
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import load_plan, plan_from_dict, plan_to_dict, save_plan
from falsework.search.plans.plan_model import plan_schema
from falsework.search.plans.plan_report import PlanReport
from falsework.search.plans.plan_source import structure_to_check
from falsework.search.plans.proofs import prove_build
from falsework.search.problem.result import Route
from falsework.stability.holds import HoldMode, HoldSettings
from falsework.stability.settings import EQUILIBRIUM

Peak = Callable[[Callable[[], Any]], int]

DOCS = Path(__file__).resolve().parents[3] / "docs" / "files.md"
SPEC = "arch:blocks=3"


@pytest.fixture(scope="module")
def plan() -> Plan:
    """A plan with displacements, a replay and margins."""
    assembly = load_structure(SPEC)
    oracle = StabilityOracle(assembly)
    found = find_plans(assembly, oracle=oracle).plans[0]
    margins = PlanMargins.from_oracle(oracle, found.states, Demands(friction=1.1))
    return replace(found, margins=margins, source={"built_in": SPEC})


@pytest.fixture(scope="module")
def data(plan: Plan) -> dict[str, Any]:
    return json.loads(json.dumps(plan_to_dict(plan, proofs=True)))


@pytest.fixture(scope="module")
def propped() -> tuple[Assembly, Plan]:
    """A structure with a place for a prop, and a plan of it that does not use the prop."""
    ground = load_structure(SPEC, ground=True)
    with_one = with_props(ground, prop_places(ground)[:1])
    bare = find_plans(ground).plans[0]
    plan = replace(
        bare,
        states=np.append(bare.states, np.zeros((len(bare.states), 1), np.uint8), axis=1),
        actions=np.where(bare.actions >= ground.part_count, bare.actions + 1, bare.actions),
        identity=with_one.identity,
        part_names=with_one.names,
        boundary=with_one.boundary,
        props=with_one.props,
        prop_limit=1,
        allow_regrasp=True,
        forces=None,
        displacement=None,
        replay=None,
        source={"built_in": SPEC, "ground": True},
    )
    return with_one, plan


@pytest.fixture(scope="module")
def pressed() -> tuple[Assembly, Plan]:
    """Two plates beside a wall, of which one is let go while a robot presses the other, and a plan of that."""
    faces = [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4)]
    faces += [(2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5)]

    def box(name: str, left: float, right: float, size: float) -> TriangleMesh:
        corners = [(x, y, z) for z in (-size, size) for y in (-size, size) for x in (left, right)]
        return TriangleMesh.from_arrays(name, np.array(corners), faces)

    boxes = [box("plate-0", 0.0, 0.2, 0.5), box("plate-1", 0.2, 0.4, 0.5), box("wall", -1.0, 0.0, 1.0)]
    assembly = Assembly.from_meshes(boxes, boundary=[2], friction=0.5)
    states = np.array([[1, 2, 2], [2, 2, 2], [0, 2, 2]], np.uint8)
    task = Task.from_rules(assembly.boundary, 2, start=states[0], target=states[-1], fixed=[1])
    replayer = StabilityOracle(assembly).replayer
    assert replayer is not None
    return assembly, prove_build(Route.from_states(states), assembly, task, replayer, None, forces=True)


def checked(
    data: Any, settings: StabilitySettings = StabilitySettings(), structure: Assembly | None = None
) -> tuple[PlanReport, dict[str, Any]]:
    """Check a plan as the command does, with `--ground` if the plan has props, which need a floor."""
    plan = plan_from_dict(data)
    if structure is not None:
        return validate_plan(plan, structure, settings), {}
    assembly, overrides = structure_to_check(plan, ground=True if plan.props else None)
    return validate_plan(plan, assembly, settings), overrides


# Every entry, changed one at a time


def paths(value: Any, path: tuple[Any, ...] = ()) -> Iterator[tuple[Any, ...]]:
    """Paths to every value in JSON data; of a list of steps, to the first and the last only."""
    yield path
    inner = value.items() if isinstance(value, dict) else enumerate(value) if isinstance(value, list) else ()
    for key, entry in inner:
        if not (isinstance(entry, dict) and isinstance(key, int) and 0 < key < len(value) - 1):
            yield from paths(entry, (*path, key))


def mutations(value: Any) -> Iterator[Any]:
    """Other values in the place of one."""
    yield from (None, {}, [], "\x1b[2K", -1, 0, 1, 2, True, 1e9, float("nan"))
    if isinstance(value, bool):
        yield not value
    elif isinstance(value, (int, float)):
        yield from (
            value if value else 1e-9,
            value + np.pi,
            value + 2 * np.pi,
            value + 1,
            value * 2,
            value * 1e-3,
            value * (1 + 1e-6),
            1e300,
            [value],
            str(value),
        )
    elif isinstance(value, str):
        yield from (value + " ", value.upper(), "", value[:-4], value[::-1])
    elif isinstance(value, list):
        yield from (value[::-1], value[:-1], value + value[-1:], [2] * len(value), [0] * len(value), [value])
    elif isinstance(value, dict):
        yield from ({key: entry for key, entry in value.items() if key != left_out} for left_out in value)
        yield value | {"surprise": 1}


def changed(data: Any, path: tuple[Any, ...], value: Any) -> Any:
    if not path:
        return value
    top = data.copy()
    top[path[0]] = changed(data[path[0]], path[1:], value)
    return top


def weaker(kind: str, old: Any, new: Any) -> bool:
    """Whether recorded margins of a kind claim no more than others, which are known to 1 %; None is without bound."""
    if kind == "friction":
        return all(1.01 * (after or 0.0) >= (before or 0.0) for before, after in zip(old, new, strict=True))
    return all(
        before is None or (after is not None and after <= 1.01 * before) for before, after in zip(old, new, strict=True)
    )


def margins_are_kept(old: PlanMargins, new: PlanMargins | None) -> bool:
    """Whether margins are known to be kept from those that were measured."""
    if new is None:
        return True
    kept = 0.55 / max(value for value in old.measured["friction"] if value is not None)
    return (new.demands.friction or 1.0) <= kept and all(
        weaker(kind, old.measured[kind], values) for kind, values in new.measured.items()
    )


def presses_agree(old: Plan, new: Plan) -> bool:
    """Whether the wrenches of presses on the same parts differ by a thousandth of a newton per newton at most."""
    pairs = [pair for one, other in zip(old.presses, new.presses, strict=True) for pair in zip(one, other, strict=True)]
    return all(
        one.part == other.part and np.allclose(one.wrench, other.wrench, atol=1e-3 * one.force) for one, other in pairs
    )


def loads_are_no_less(report: PlanReport, new: Plan) -> bool:
    """Whether a plan says nothing of loads, or for each that it is at least what the check finds, to 1 %."""
    if not new.loads:
        return True
    return all(
        one.part == two.part and 1.01 * one.force >= two.force and 1.01 * one.moment >= two.moment - 1e-3 * two.force
        for said, found in zip(new.loads, report.loads, strict=True)
        for one, two in zip(sorted(said, key=lambda load: load.part), found, strict=True)
    )


LISTED: dict[str, Callable[[Plan, Plan, PlanReport], bool]] = {
    "structure.name": lambda old, new, report: report.about is not None and report.about.structure == old.name,
    "structure.source": lambda old, new, report: report.about is not None and report.about.identity == old.identity,
    "structure.props": lambda old, new, report: report.about is not None and report.about.props == len(new.props) == 1,
    "robots": lambda old, new, report: report.about is not None and report.about.robots == new.robots > old.robots,
    "rules.removable_only_if_clear": lambda old, new, report: new.removable_only_if_clear,
    "rules.support": lambda old, new, report: new.allow_regrasp is not old.allow_regrasp,
    "rules.props": lambda old, new, report: report.about is not None and report.about.prop_limit == new.prop_limit,
    "rules.parts_at_once": lambda old, new, report: (
        report.about is not None and report.about.parts_at_once <= new.parts_at_once
    ),
    "rules.moves": lambda old, new, report: report.about is not None and report.about.moves <= new.moves,
    "rules.turns": lambda old, new, report: new.turns,
    "rules.waiting": lambda old, new, report: new.waiting,
    "steps.exit_path": lambda old, new, report: True,
    "stability.stiffness_ratio": lambda old, new, report: report.claim.criterion == "equilibrium",
    "stability.tolerance": lambda old, new, report: f"its tolerance {new.claim.tolerance:g}" in report.unverified,
    "stability.force_bound": lambda old, new, report: f"its force bound {new.claim.force_bound:g}" in report.unverified,
    "stability.reserve": lambda old, new, report: (
        report.claim.reserve == new.claim.reserve or f"its reserve {new.claim.reserve:g}" in report.unverified
    ),
    "stability.holds": lambda old, new, report: report.claim.holds == new.claim.holds,
    "start.residual": lambda old, new, report: bool(new.residuals[0] <= new.claim.tolerance),
    "steps.residual": lambda old, new, report: bool(new.residuals.max() <= new.claim.tolerance),
    "start.bears": lambda old, new, report: loads_are_no_less(report, new),
    "steps.bears": lambda old, new, report: loads_are_no_less(report, new),
    "steps.presses": lambda old, new, report: report.certified == 0 or presses_agree(old, new),
    "replay": lambda old, new, report: new.replay is None or "its replay" in report.unverified,
    "displacements": lambda old, new, report: new.displacement is None and report.certified == 0,
    "forces": lambda old, new, report: new.forces is None and report.certified == 0,
    "margins": lambda old, new, report: old.margins is not None and margins_are_kept(old.margins, new.margins),
}
"""Entries of which a change may pass, as `docs/files.md` lists them, and what must hold of such a change then."""


def entry_of(path: tuple[Any, ...], old: Any, new: Any) -> str:
    """Name of the entry of the list that a change belongs to."""
    keys = [key for key in path if isinstance(key, str)]
    if isinstance(old, dict) and isinstance(new, dict) and len(old) == len(new) + 1:
        keys += set(old) - set(new)  # left out
    return next((name for name in LISTED if ".".join(keys).startswith(name)), ".".join(keys))


def accepted_changes(
    data: dict[str, Any],
    settings: StabilitySettings = StabilitySettings(),
    among: tuple[str, ...] = (),
    structure: Assembly | None = None,
) -> tuple[int, set[str]]:
    """Change one value at a time; return how many changes there were, and the entries of those that pass."""
    count, accepted, original = 0, set(), plan_from_dict(data)
    assert checked(data, settings, structure)[0].good
    written, rewritten = json.dumps(data), plan_to_dict(original, proofs=True)
    usual = structure or structure_to_check(original, ground=True if original.props else None)[0]
    for path in paths(data):
        if among and path[:1] and path[0] not in among:
            continue
        old = data
        for key in path:
            old = old[key]
        for value in mutations(old):
            changed_data = changed(data, path, value)
            if json.dumps(changed_data) == written:
                continue
            count += 1
            try:
                known = structure if path[:1] in ((), ("structure",)) else usual
                report, overrides = checked(changed_data, settings, known)
            except InputError:
                continue
            found = plan_from_dict(changed_data)
            if not report.good or overrides or plan_to_dict(found, proofs=True) == rewritten:
                continue
            entry = entry_of(path, old, value)
            assert entry in LISTED, (path, value)
            assert LISTED[entry](original, found, report), (path, value, report)
            accepted.add(entry)
    return count, accepted


_ALWAYS = {"structure.name", "structure.source", "robots", "rules.removable_only_if_clear", "stability.force_bound"}
_JUDGED = {"start.residual", "steps.residual"}
_BUILT = {"stability.reserve", "stability.holds"}


def test_one_change_at_a_time_is_refused_or_claims_nothing(data: dict[str, Any]) -> None:
    count, accepted = accepted_changes(data)
    assert count > 1200
    # What is listed is seen to be accepted, here or below, so that the list is not longer than it must be.
    assert accepted == _ALWAYS | _JUDGED | _BUILT | {"steps.bears", "replay", "displacements", "margins"}


def test_one_change_of_a_plan_under_equilibrium() -> None:
    found = find_plans(load_structure(SPEC), oracle=StabilityOracle(load_structure(SPEC), EQUILIBRIUM)).plans[0]
    exact = validate_plan(replace(found, forces=None), load_structure(SPEC), EQUILIBRIUM).residual
    assert exact < 1e-6  # from state to state, so a little above the resolution
    data = json.loads(json.dumps(plan_to_dict(replace(found, source={"built_in": SPEC}), proofs=True)))
    count, accepted = accepted_changes(data, EQUILIBRIUM)
    assert count > 1000
    others = {"stability.stiffness_ratio", "stability.reserve", "forces"}
    assert accepted - {"stability.tolerance"} == _ALWAYS | _JUDGED | others


def test_one_change_of_a_plan_with_presses(pressed: tuple[Assembly, Plan]) -> None:
    assembly, plan = pressed
    assert list(map(len, plan.presses)) == [0, 1]
    data = json.loads(json.dumps(plan_to_dict(plan, proofs=True)))
    count, accepted = accepted_changes(data, among=("start", "steps"), structure=assembly)
    assert count > 100
    assert accepted == {
        *("steps.presses", "steps.residual", "steps.bears", "replay", "displacements"),
        *("start.bears", "start.residual"),
    }


@pytest.mark.parametrize(
    "claimed",
    [
        {"criterion": "equilibrium", "cone": "octagon"},
        {"holds": HoldSettings(mode=HoldMode.LOCKED)},
        {"holds": HoldSettings(force=0.0)},
    ],
)
def test_robots_that_never_press_do_not(pressed: tuple[Assembly, Plan], claimed: dict[str, Any]) -> None:
    """Neither in a plan in memory nor in a file."""
    assembly, plan = pressed
    plan = replace(plan, displacement=None, loads=(), claim=replace(plan.claim, **claimed))
    settings = StabilitySettings.from_claim(plan.claim)
    assert "robots press, which those of the plan never do" in validate_plan(plan, assembly, settings).reason
    with pytest.raises(InputError, match="robots press in it, which they do under contact alone"):
        plan_from_dict(plan_to_dict(plan))


def test_a_plan_without_a_press_that_it_needs_is_refused(pressed: tuple[Assembly, Plan]) -> None:
    """Without certificates it is built anew, with its own presses."""
    assembly, plan = pressed
    bare = replace(plan, displacement=None)
    assert validate_plan(bare, assembly).good
    assert "does not come to rest" in validate_plan(replace(bare, presses=((), ())), assembly).reason
    (press,) = plan.presses[1]
    weak = structs.replace(press, wrench=tuple(0.1 * value for value in press.wrench))
    assert "does not come to rest" in validate_plan(replace(bare, presses=((), (weak,))), assembly).reason
    away = structs.replace(press, part=0)
    assert (
        "a robot presses plate-0, which it does not hold"
        in validate_plan(replace(plan, presses=((), (away,))), assembly).reason
    )


def test_one_change_of_a_plan_with_props(propped: tuple[Assembly, Plan]) -> None:
    data = json.loads(json.dumps(plan_to_dict(propped[1])))
    count, accepted = accepted_changes(data, among=("structure", "robots", "rules", "stability"))
    assert count > 500
    assert accepted == _ALWAYS | _BUILT | {"structure.props", "rules.support", "rules.props"}


def test_one_change_of_a_plan_with_several_parts_in_one_step() -> None:
    shelf = load_structure("shelf:shelves=0")
    found = find_plans(shelf, robots=1, oracle=StabilityOracle(shelf, EQUILIBRIUM), parts_at_once=2).plans[0]
    data = json.loads(json.dumps(plan_to_dict(replace(found, source={"built_in": "shelf:shelves=0"}), proofs=True)))
    count, accepted = accepted_changes(data, EQUILIBRIUM, among=("rules", "steps"), structure=shelf)
    assert count > 100
    assert accepted >= {"rules.parts_at_once", "steps.residual"}


def test_the_documentation_lists_what_claims_nothing() -> None:
    section = DOCS.read_text(encoding="utf-8").partition("### What a check takes from a plan")[2].partition("\n## ")[0]
    rows = [line.split("|")[1] for line in section.splitlines() if line.startswith("| `")]
    assert [name for row in rows for name in re.findall(r"`([^`]+)`", row)] == list(LISTED)


def test_a_smaller_tolerance_is_named(plan: Plan, data: dict[str, Any]) -> None:
    tight = 0.5 * (float(plan.residuals.max()) + plan.claim.tolerance)
    report, _ = checked(changed(data, ("stability", "tolerance"), tight))
    assert report.good
    assert f"its tolerance {tight:g}" in report.unverified


# Facts about the structure


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda p: replace(p, boundary=np.array([1, 0, 0, 1, 1], bool)), "part 0 is boundary, but in arch:blocks=3 it"),
        (lambda p: replace(p, boundary=np.array([0, 0, 0, 1, 0], bool)), "part 4 is free, but in arch:blocks=3 it is"),
        (lambda p: replace(p, part_names=p.part_names[::-1]), "calls part 0 'abutment-4', but in arch:blocks=3 it is"),
        (lambda p: replace(p, part_names=("a\nb", *p.part_names[1:])), r"calls part 0 'a\nb', but"),
        (lambda p: replace(p, friction=0.6), "friction is 0.6, but in arch:blocks=3 it is 0.55"),
        (lambda p: replace(p, identity="0" * 64), "for another structure: its hash 000000000000"),
    ],
)
def test_what_a_plan_says_of_the_structure_must_be_so(plan: Plan, change: Any, message: str) -> None:
    """The hash is copied from the structure, so it does not vouch for what stands beside it."""
    assembly = load_structure(SPEC)
    with pytest.raises(PlanError) as caught:
        validate_plan(change(plan), assembly)
    assert message in str(caught.value)
    assert "\n" not in str(caught.value)


def test_free_parts_that_a_plan_calls_boundary_support_nothing() -> None:
    """The keystone of an arch in mid-air, with one robot."""
    assembly = load_structure("arch:blocks=5")
    record = {"verdict": "stable", "proof": "history", "residual": 0.0}
    claim = plan_to_dict(find_plans(load_structure(SPEC)).plans[0])["stability"]
    steps = [{"do": do, "part": part, **record} for part in (1, 3, 0, 4) for do in ("hold", "remove")]
    structure = {"name": assembly.name, "identity": assembly.identity, "friction": 0.55, "boundary": [2, 5, 6]}
    forged = {
        "format": "falsework.plan/3",
        "direction": "disassembly",
        "structure": {**structure, "parts": list(assembly.names), "source": {"built_in": "arch:blocks=5"}},
        "robots": 1,
        "rules": {"fixed": [], "missing": [], "removable_only_if_clear": False},
        "stability": claim,
        "start": {"state": [1, 1, 2, 1, 1, 2, 2], **record},
        "steps": steps,
        "end": [0, 0, 2, 0, 0, 2, 2],
        "needs": [],
    }
    with pytest.raises(PlanError, match="says that part 2 is boundary"):
        checked(forged)


def test_props_are_where_the_structure_has_them(propped: tuple[Assembly, Plan]) -> None:
    assembly, plan = propped
    about = validate_plan(plan, assembly).about
    assert about is not None
    assert (about.props, about.prop_limit) == (1, 1)
    (prop,) = plan.props
    for other in (structs.replace(prop, floor=prop.floor - 1.0), structs.replace(prop, part=prop.part + 1)):
        with pytest.raises(PlanError, match="the plan has a prop under part"):
            validate_plan(replace(plan, props=(other,)), assembly)


def test_options_of_the_plan_count_only_with_the_callers_word() -> None:
    """Whatever makes the arch stand that falls by itself, the answer names it."""
    spec = "arch:blocks=15,thickness=0.05"
    for options in (
        {"friction": 0.6},
        {"density": 1000.0},
        {"ground": True},
        {"loads": [{"part": 3, "force": [0, 0, -1]}]},
    ):
        strange = load_structure(spec, **options)
        plan = replace(_drawn(strange), source={"built_in": spec, **options})
        assembly, overrides = structure_to_check(plan)
        assert overrides == options
        assert assembly.identity == strange.identity
        assert structure_to_check(plan, None, None, **options)[1] == {}
        with pytest.raises(PlanError, match=r"for another structure|with 18 parts"):
            validate_plan(plan, structure_to_check(plan, None, spec)[0])
    # Options that say what the structure is anyway are no overrides.
    plain = load_structure(spec)
    plan = replace(_drawn(plain), source={"built_in": spec, "friction": 0.55, "boundary": [15, 16]})
    assert structure_to_check(plan)[1] == {}


def _drawn(assembly: Any) -> Plan:
    """A plan of one step for a structure, without a verdict."""
    from falsework.stability import Verdicts

    start = np.where(assembly.boundary, 2, 1).astype(np.uint8)
    after = start.copy()
    after[0] = 2
    verdicts = Verdicts.all_undecided(2)
    verdicts.verdict[:] = 1
    verdicts.residual[:] = 0.0
    task = Task.from_rules(assembly.boundary, 2)
    return Plan.from_route(
        Route(np.array([start, after]), np.array([0])), assembly, task, verdicts, StabilitySettings().claim
    )


def test_a_name_of_a_folder_is_no_built_in_structure(plan: Plan, tmp_path: Path, monkeypatch: Any) -> None:
    (tmp_path / "mine").mkdir()
    monkeypatch.chdir(tmp_path)
    with pytest.raises(PlanError, match="names a built-in structure 'mine'"):
        structure_to_check(replace(plan, source={"built_in": "mine"}))


@pytest.mark.parametrize(
    ("source", "message"),
    [
        ([], "structure.source is []; give an object"),
        ({}, "must have either built_in or path"),
        ({"built_in": "arch", "path": "x"}, "must have either built_in or path"),
        ({"built_in": "arch", "colour": "red"}, "structure.source.colour is not known"),
        ({"built_in": "arch", "density": float("nan")}, "structure.source.density is nan; give a number > 0"),
        ({"built_in": "arch", "density": True}, "structure.source.density is True; give a number"),
        ({"built_in": "arch", "boundary": [[1]]}, "structure.source.boundary[0] is [1]; give a whole number or a text"),
        (
            {"built_in": "arch", "earthquake": [float("inf")]},
            "structure.source.earthquake[0] is inf; give a number <= 1000000000000",
        ),
        ({"built_in": "arch", "ground": 1}, "structure.source.ground is 1; give true or false"),
    ],
)
def test_wrong_sources(data: dict[str, Any], source: Any, message: str) -> None:
    with pytest.raises(PlanError) as caught:
        plan_from_dict(changed(data, ("structure", "source"), source))
    assert message in str(caught.value)


# Certificates and other claims


def test_a_plan_without_steps_shows_nothing(plan: Plan) -> None:
    empty = replace(plan, states=plan.states[:1], actions=plan.actions[:0], residuals=plan.residuals[:1], margins=None)
    for displacement in (None, plan.displacement[:1]):  # type: ignore[index]
        report = validate_plan(replace(empty, displacement=displacement), load_structure(SPEC))
        assert not report.good
        assert report.reason == "the plan has no step and shows nothing; plan again"
        assert report.checked == 0


def test_certificates_in_a_plan_are_evaluated_instead_of_solving(plan: Plan, monkeypatch: pytest.MonkeyPatch) -> None:
    assembly = load_structure(SPEC)
    for settings in (StabilitySettings(), EQUILIBRIUM):
        made = find_plans(assembly, oracle=StabilityOracle(assembly, settings)).plans[0]
        bare = replace(made, forces=None, displacement=None)
        solved = validate_plan(bare, assembly, settings)
        assert (solved.good, solved.certified) == (True, 0)
        with monkeypatch.context() as patch:
            for name in ("StabilityOracle", "Replayer"):
                patch.setattr(plan_check, name, type(name, (), {}))  # whoever asks a solver or a replay fails
            report = validate_plan(made, assembly, settings)
        assert report.good
        assert report.certified == report.states == len(made) + 1
        assert report.residual == pytest.approx(made.residuals.max())


@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, 0.0])
@pytest.mark.parametrize("row", [3, 6])
def test_a_certificate_that_proves_nothing_is_no_good(plan: Plan, value: float, row: int) -> None:
    """Though the state itself is stable."""
    assert plan.displacement is not None
    installed = plan.states[row] == 1
    assert installed.any()
    wrong = plan.displacement.copy()
    wrong[row][:, installed] = value
    report = validate_plan(replace(plan, displacement=wrong, margins=None), load_structure(SPEC))
    assert not report.good
    assert (report.checked, report.certified) == (row, 0)
    assert "is not proven: the displacements in the plan prove nothing: " in report.reason
    short = replace(plan, displacement=plan.displacement[:-1], margins=None)
    assert "displacements of shape" in validate_plan(short, load_structure(SPEC)).reason


def test_an_unstable_state_is_told_from_a_wrong_certificate(plan: Plan) -> None:
    """Of a state that falls, the report has the motion, whatever the plan carries for it."""
    assembly = load_structure(SPEC)
    states, parts = np.repeat(plan.states[-1:], 3, axis=0), assembly.part_count
    states[:2, 1] = [0, 2]
    proofs = StabilityOracle(assembly).verdicts(states[[1, 1, 2]], require_certificate=True).displacement
    falls = replace(plan, states=states, actions=np.array([parts + 1, 1]), displacement=proofs)
    report = validate_plan(replace(falls, margins=None), assembly)
    assert "the structure is unstable at the beginning" in report.reason
    assert report.verdict is not None


def test_claims_that_a_check_does_not_verify_are_named(plan: Plan) -> None:
    assembly = load_structure(SPEC)
    assert plan.margins is not None
    bound = replace(plan.margins, maximised="friction", bound=0.2)
    report = validate_plan(replace(plan, margins=bound), assembly, demands=Demands(friction=1.05))
    assert report.good
    assert report.unverified == (
        "its replay",
        "its margins friction=1.1",
        "its bound on the margin of friction of all plans",
    )
    other = validate_plan(replace(plan, margins=None), assembly, EQUILIBRIUM)
    assert other.good
    assert {"its criterion contact", "its cone quadratic", "its displacements"} <= set(other.unverified)
    assert other.certified == 0


@pytest.mark.parametrize(
    ("margins", "message"),
    [
        ({"demands": {"tilt": float(np.pi)}}, "margins.demands.tilt is 3.14159265"),
        ({"demands": {"tilt": float(2 * np.pi)}}, "margins.demands.tilt is 6.28318530"),
        ({"demands": {"friction": 0.5}}, "margins.demands.friction is 0.5; give a number >= 1"),
        ({"demands": {"push": 1e300}}, "margins.demands.push is 1e+300; give a number <= 1000000000000"),
        ({"measured": {"tilt": [float(2 * np.pi)] * 7}}, "margins.measured.tilt[0] is 6.28"),
        ({"measured": {"push": [1e300] * 7}}, "margins.measured.push[0] is 1e+300"),
        ({"maximised": "tilt", "bound": 7.0}, "margins.bound is 7.0; it must be a number within the range of its kind"),
    ],
)
def test_margins_outside_of_their_range(data: dict[str, Any], margins: dict[str, Any], message: str) -> None:
    """A tilt of a whole turn loads a structure like none; loads of 1e300 N overflow."""
    jsonschema.Draft202012Validator(plan_schema()).validate(data)
    if "bound" not in margins:  # its range depends on its kind
        with pytest.raises(jsonschema.ValidationError):
            jsonschema.Draft202012Validator(plan_schema()).validate(data | {"margins": data["margins"] | margins})
    with pytest.raises(PlanError) as caught:
        plan_from_dict(data | {"margins": data["margins"] | margins})
    assert message in str(caught.value)


def test_a_plan_for_another_stiffness_is_refused(plan: Plan) -> None:
    soft = replace(plan, claim=replace(plan.claim, stiffness_ratio=0.1))
    report = validate_plan(soft, load_structure(SPEC))
    assert report.reason == "the plan is for a stiffness ratio of 0.1; 0.7 is asked"


def test_the_report_says_what_was_checked(plan: Plan) -> None:
    about = validate_plan(plan, load_structure(SPEC)).about
    assert about is not None
    assert (about.structure, about.identity, about.boundary) == (SPEC, plan.identity, (3, 4))
    assert (about.steps, about.robots) == (6, 2)
    assert (about.start, about.end) == ((0, 0, 0, 2, 2), (1, 1, 1, 2, 2))


# What a file may ask for


def packed(data: bytes) -> str:
    return base64.b64encode(zlib.compress(data, 9)).decode()


def test_displacements_of_other_parts_are_not_unpacked(data: dict[str, Any], peak: Peak) -> None:
    states, parts = len(data["steps"]) + 1, 100_000
    entry = {"parts": parts, "increments": 1, "zlib_base64": packed(b"\0" * (states * parts * 48))}

    def read() -> None:
        with pytest.raises(PlanError, match=r"displacements.parts is 100000; the plan has 5 parts"):
            plan_from_dict(data | {"displacements": entry})

    assert peak(read) < 8_000_000


@pytest.mark.parametrize("entry", ["zlib_base64", "changes_zlib_base64"])
def test_forces_take_no_more_than_their_text_allows(entry: str, peak: Peak) -> None:
    """Claims beyond the room for them are refused, wherever the size is claimed."""
    states, points, room = 7, 100_000, 1 << 21
    rows = np.arange(points, dtype="<u4")[::32].tobytes()
    many = np.full(states, points // 32, "<u4").tobytes() + rows * states + b"\0" * (points // 32 * states * 24)
    few = np.zeros(states, "<u4").tobytes()
    texts = [b"\0" * (states * points * 24)] if entry == "zlib_base64" else [few, many]

    def read(text: str, points: int) -> None:
        with pytest.raises(ValueError, match="does not hold forces"):
            unpack_proofs(entry, text, (states, points, 3), "forces", room=room)

    for text in texts:
        short = packed(text)
        assert peak(lambda: read(short, points)) < 8_000_000  # noqa: B023
    within = packed(b"\0" * (states * 3 * 24))
    assert unpack_proofs("zlib_base64", within, (states, 3, 3), "forces", room=room).shape == (states, 3, 3)


def test_a_plan_of_too_many_states_is_refused(data: dict[str, Any]) -> None:
    more = 40_000 - 5
    large = copy.deepcopy(data)
    large["structure"]["parts"] += [f"more {number}" for number in range(more)]
    large["structure"]["boundary"] += range(5, 5 + more)
    large["start"]["state"] += [2] * more
    large["end"] += [2] * more
    large["steps"] *= 5_000

    with pytest.raises(PlanError, match="it has 30000 steps of 40000 parts; at most 1073741824 entries are read"):
        plan_from_dict(large)


def test_an_entry_may_not_occur_twice(plan: Plan, tmp_path: Path) -> None:
    """Wherever it is: programs differ in which of the two they read."""
    path = tmp_path / "plan.json"
    save_plan(plan, path)
    text = path.read_text()
    for key in ("robots", "friction", "part", "gravity", "residual"):
        twice = re.sub(rf'("{key}": [^,}}\]]+)', r"\1, \1", text, count=1)
        assert twice != text
        path.write_text(twice)
        with pytest.raises(PlanError, match=f"has the entry '{key}' twice"):
            load_plan(path)
