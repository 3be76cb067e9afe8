"""Robots that press, and the reserve of plans, on the command line: what works with them, and what is refused."""

from __future__ import annotations

import json
import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import pytest

from falsework import StabilitySettings, find_plans, load_structure
from falsework.assembly import HELD
from falsework.cli.hold_options import HoldOptions
from falsework.errors import InputError
from falsework.robots.model.cell_holds import CellScale
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import load_plan
from falsework.stability import HoldSettings
from falsework.stability.holds import HoldMode

Run = Callable[..., Any]
ARCH = "arch:blocks=9"
SOFT = ("--hold-stiffness", "1e5")
"""Robots so soft that an arch of nine blocks cannot be built unless they press."""


def refused(finished: Any, *words: str) -> None:
    """One line for a person that contains every word."""
    assert finished.code == 2, finished.error
    assert finished.error.startswith("falsework: ")
    assert finished.error.count("\n") == 1, finished.error
    for word in words:
        assert word in finished.error


@pytest.fixture
def pressing(planned_once: Callable[..., bytes], tmp_path: Path) -> Path:
    """A plan in which robots press."""
    out = tmp_path / "pressing.json"
    out.write_bytes(planned_once(ARCH, *SOFT, "--search-from", "beginning"))
    assert presses(json.loads(out.read_text()))
    return out


def presses(data: dict[str, Any]) -> list[dict[str, Any]]:
    """Steps of a plan file in which robots press."""
    return [step for step in data["steps"] if step.get("presses")]


@pytest.mark.parametrize(
    "options",
    [
        ("--alternatives", 2),
        ("--missing", 4, "--width", 4),
        ("--margin", "friction=1.2,tilt=1deg"),
        ("--allow-regrasp",),
        ("--proofs",),
        ("--robots", "auto", "--deadline", 20),
    ],
    ids=lambda options: options[0],
)
def test_every_kind_of_plan_presses(falsework: Run, tmp_path: Path, options: tuple[Any, ...]) -> None:
    """Each is built anew by the check, with its presses and its reserve."""
    out = tmp_path / "plan.json"
    done = falsework("plan", ARCH, *SOFT, *options, "--out", out)
    assert done.code == 0, done.error
    assert "with the true friction and with friction / 1.1" in done.out
    assert "robots press in " in done.out
    data = json.loads(out.read_text())
    assert presses(data)
    assert data["stability"]["reserve"] == 1.1
    checked = falsework("check", out, "--reserve", 1.1)
    assert checked.code == 0, checked.error


def test_without_presses_there_is_no_plan(falsework: Run, tmp_path: Path) -> None:
    done = falsework("plan", ARCH, *SOFT, "--no-press", "--width", 4, "--out", tmp_path / "plan.json")
    assert done.code == 1
    assert "no plan was found" in done.error


@pytest.mark.parametrize("order", ["assembly", "disassembly"])
def test_replan_presses(falsework: Run, tmp_path: Path, order: str) -> None:
    out, state = tmp_path / "plan.json", "empty" if order == "assembly" else "complete"
    options = ("--state", state, "--order", order, "--out", out)
    done = falsework("replan", ARCH, *SOFT, *options)
    assert done.code == 0, done.error
    assert "with the true friction and with friction / 1.1" in done.out
    assert "robots press in " in done.out
    plan = load_plan(out)
    assert any(plan.presses)
    assert plan.claim.holds.stiffness == 1e5
    assert validate_plan(plan, load_structure(ARCH), StabilitySettings(reserve=1.1)).good
    record = falsework("replan", ARCH, *SOFT, *options, "--json").answer
    assert record["direction"] == order
    assert record["reserve"] == 1.1
    assert record["presses"] == sum(map(bool, plan.presses))


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_the_reserve_that_no_plan_keeps(falsework: Run, tmp_path: Path, criterion: str) -> None:
    """The best plan is delivered with what it keeps and why, and the exit code says so, whatever asks for it."""
    under = ("--criterion", criterion)
    for command in (("plan",), ("plan", "--robots", "auto"), ("replan",)):
        out = tmp_path / f"{len(command)}-{command[0]}.json"
        done = falsework(command[0], "arch:blocks=5", *command[1:], "--reserve", 5, *under, "--out", out)
        assert done.code == 1
        assert "no plan was found with the reserve of 5: the " in done.error
        assert "stable with friction divided by 5; this one keeps 1" in done.error
        assert json.loads(out.read_text())["stability"]["reserve"] == 1.0
        assert falsework("check", out, *under).code == 0
        asked = falsework("check", out, "--reserve", 1.2, *under)
        assert asked.code == 1
        assert "the plan claims a reserve of 1; 1.2 is asked" in asked.error


@pytest.mark.parametrize("command", ["plan", "replan"])
@pytest.mark.parametrize(
    ("options", "words"),
    [
        (("--hold-force=-1",), "the largest force of holds is -1 N; give 0 or more"),
        (("--hold-force=nan",), "the largest force of holds is nan N"),
        (("--hold-force=1N",), "with at most 1 N cannot carry part voussoir-0, which weighs"),
        (("--hold-force=0.001kN",), "with at most 1 N cannot carry part voussoir-0, which weighs"),
        (("--hold-force=3kg",), "--hold-force: '3kg' has the unit kg; give 2N or 2kN"),
        (("--hold-moment=much",), "--hold-moment: 'much' is no moment; give 2Nm or 2kNm"),
        (("--hold-force=1",), "with at most 1 N cannot carry part voussoir-0, which weighs"),
        (("--hold-stiffness=0",), "the stiffness of holds is 0 N/m; give 1e-09 or more, inf for rigid"),
        (("--hold-stiffness=-1",), "the stiffness of holds is -1 N/m"),
        (("--hold-stiffness=nan",), "the stiffness of holds is nan N/m"),
        (("--reserve=0.9",), "--reserve is 0.9; give 1 for none, or more"),
        (("--reserve=nan",), "--reserve is nan"),
        (("--criterion=equilibrium", "--no-press"), "leave out the options of holds"),
        (("--criterion=equilibrium", "--hold-force=1e4"), "leave out the options of holds"),
    ],
)
def test_wrong_options(falsework: Run, tmp_path: Path, command: str, options: tuple[str, ...], words: str) -> None:
    out = ("--out", tmp_path / "plan.json")
    refused(falsework(command, "arch:blocks=5", *options, *out), words)
    assert not list(tmp_path.iterdir())


@pytest.mark.parametrize("option", ["--hold-force", "--hold-moment"])
def test_a_check_with_a_limit_of_nothing_is_refused(falsework: Run, tmp_path: Path, option: str) -> None:
    out = tmp_path / "plan.json"
    assert falsework("plan", "arch:blocks=5", "--out", out).code == 0
    refused(falsework("check", out, option, 0), f"{option} is 0, which limits nothing; give more than 0")


def test_robots_of_no_force_never_press(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    done = falsework("plan", "arch:blocks=5", "--hold-force", 0, "--out", out)
    assert done.code == 0, done.error
    assert "press" not in done.out
    assert json.loads(out.read_text())["stability"]["holds"]["mode"] == "locked"


@pytest.mark.parametrize("scale", [CellScale(1.0, 1.0), CellScale(0.5, 0.125)], ids=["as it is", "in a cell"])
@pytest.mark.parametrize("moment", [None, 2500.0], ids=["moment that follows", "moment given"])
@pytest.mark.parametrize(
    ("options", "given"),
    [
        ({"reserve": 1.2}, {}),
        ({"hold_force": 7000}, {"force": 7000}),
        ({"hold_moment": 5000}, {"moment": 5000}),
        ({"hold_stiffness": math.inf}, {"stiffness": math.inf}),
        ({"press_mode": "hybrid"}, {"mode": HoldMode.HYBRID}),
        ({"no_press": True}, {"mode": HoldMode.LOCKED}),
    ],
    ids=lambda entry: next(iter(entry), ""),
)
def test_what_is_not_given_is_as_in_the_plan_that_goes_on(
    options: dict[str, Any], given: dict[str, Any], moment: float | None, scale: CellScale
) -> None:
    """Also what no option says, such as gravity; a moment that followed from the force follows from the new one."""
    assembly = load_structure("arch:blocks=5")
    old = StabilitySettings(
        gravity=9.0, tolerance=5e-5, reserve=1.3, holds=HoldSettings(1e7, 8000.0, moment, HoldMode.FORCE)
    )
    plan = find_plans(assembly, stability=old).unwrap()
    units = {"hold_force": scale.force, "hold_moment": scale.moment}
    texts: dict[str, Any] = {
        name: str(value * units[name]) if name in units else value for name, value in options.items()
    }
    found = HoldOptions(**texts).settings_from(plan, assembly, None, scale=scale)
    holds = scale.inverse.holds(found.holds).resolved(assembly, 9.0)
    assert holds == replace(old.holds, **given).resolved(assembly, 9.0)
    assert replace(found, cone=None, holds=old.holds) == replace(old, reserve=options.get("reserve", 1.3))
    other = HoldOptions().settings_from(plan, assembly, "equilibrium")
    assert (other.gravity, other.tolerance, other.reserve) == (9.0, 5e-5, 1.0)


def test_wrong_settings() -> None:
    wrong = (("force", -1.0), ("force", math.nan), ("moment", -1.0), ("stiffness", 0.0), ("stiffness", math.nan))
    for name, value in wrong:
        options: dict[str, Any] = {name: value}
        with pytest.raises(InputError, match="of holds is"):
            HoldSettings(**options)
    for reserve in (0.9, 0.0, math.nan):
        with pytest.raises(InputError, match="reserve is"):
            StabilitySettings(reserve=reserve)


def test_the_check_limits_robots(falsework: Run, pressing: Path) -> None:
    """A plan for stronger robots than allowed is refused, whatever its own claim is changed to."""
    limited = falsework("check", pressing, "--hold-force", 900)
    assert limited.code == 1
    assert "more than it can" in limited.error
    data = json.loads(pressing.read_text())
    data["stability"]["holds"]["force"] = 900
    pressing.write_text(json.dumps(data))
    assert falsework("check", pressing).code == 1  # its presses are no longer within its claim
    data["stability"]["holds"]["force"] = 1
    pressing.write_text(json.dumps(data))
    refused(falsework("check", pressing), "cannot carry part voussoir-0")
    refused(falsework("check", pressing, "--hold-force=-1"), "the largest force of holds is -1 N")
    refused(falsework("check", pressing, "--reserve=0.5"), "reserve is 0.5")


@pytest.mark.parametrize(
    ("part", "wrench", "code", "words"),
    [
        ("free", [0, 0, 10, 0, 0, 0], 1, ", which it does not hold"),
        ("boundary", [0, 0, 10, 0, 0, 0], 1, "a robot presses abutment-9, which it does not hold"),
        (99, [0, 0, 10, 0, 0, 0], 2, "presses[0].part is 99; it must be a part from 0 to 10"),
        ("held", [0, 0, 1e6, 0, 0, 0], 1, "does not come to rest with friction divided by 1.1 at step"),
        ("held", [0, 0, math.nan, 0, 0, 0], 2, "presses[0].wrench[2] is not finite"),
        ("held", [0, 0, math.inf, 0, 0, 0], 2, "presses[0].wrench[2] is not finite"),
        ("held", [0, 0, "1", 0, 0, 0], 2, "presses[0].wrench[2] is '1'; give a number"),
        ("held", [0, 0, 1], 2, "presses[0].wrench is [0, 0, 1]; give a list of length >= 6"),
    ],
)
def test_wrong_presses_in_a_plan(
    falsework: Run, pressing: Path, part: str | int, wrench: list[Any], code: int, words: str
) -> None:
    data = json.loads(pressing.read_text())
    step = presses(data)[0]
    held = step["presses"][0]["part"]
    number = {"free": step["part"], "boundary": 9, "held": held}.get(part, part) if isinstance(part, str) else part
    step["presses"] = [{"part": number, "wrench": wrench}]
    pressing.write_text(json.dumps(data))
    finished = falsework("check", pressing)
    assert finished.code == code, finished.error
    assert finished.error.count("\n") == 1
    assert words in finished.error


def test_presses_against_the_rules(falsework: Run, pressing: Path) -> None:
    """One robot presses once, and only while a part is released."""
    plan, text = load_plan(pressing), pressing.read_text()
    data = json.loads(text)
    presses(data)[0]["presses"] *= 2
    pressing.write_text(json.dumps(data))
    assert "a robot presses a part twice" in falsework("check", pressing).error
    data, held = json.loads(text), plan.states == HELD
    both = held[:-1] & held[1:] & ~plan.boundary
    step = next(row for row, action in enumerate(plan.actions) if action >= len(plan.boundary) and both[row].any())
    data["steps"][step]["presses"] = [{"part": int(both[step].argmax()), "wrench": [0, 0, 1, 0, 0, 0]}]
    pressing.write_text(json.dumps(data))
    finished = falsework("check", pressing)
    assert finished.code == 1
    assert "robots press, but no part is released" in finished.error


def test_a_graph_knows_presses_if_it_is_asked_to(falsework: Run, tmp_path: Path) -> None:
    found = {}
    for name, options in (("plain", ()), ("pressing", ("--presses",))):
        out = tmp_path / f"{name}.npz"
        done = falsework("graph", "arch:blocks=5", "--width", 16, *options, "--device", "cpu", "--out", out, "--json")
        assert done.code == 0, done.error
        record = done.answer
        assert record["presses"] == (name == "pressing")
        found[name] = record["states"]
    assert found["pressing"] >= found["plain"]
    refused(falsework("graph", "arch:blocks=5", "--presses", "--criterion", "equilibrium"), "criterion contact alone")


def test_modes_of_presses(falsework: Run, tmp_path: Path) -> None:
    """Each has its way to be asked for, and is in the file; the modes exclude each other."""
    for options, mode in ((("--press-mode", "force"), "force"), ((), "hybrid"), (("--no-press",), "locked")):
        out = tmp_path / f"{mode}.json"
        assert falsework("plan", "arch:blocks=5", *options, "--out", out).code == 0
        assert json.loads(out.read_text())["stability"]["holds"]["mode"] == mode
    refused(falsework("plan", "arch:blocks=5", "--press-mode", "force", "--no-press"), "leave out one of")
    refused(falsework("plan", "arch:blocks=5", "--press-mode", "soft"), "soft")
    refused(falsework("plan", "arch:blocks=5", "--hold-moment=-1"), "the largest moment of holds is -1 N m")


def test_an_unknown_mode_is_refused() -> None:
    wrong: Any = "stiff"
    with pytest.raises(InputError, match="the mode of holds is 'stiff'; give locked, force, hybrid"):
        HoldSettings(mode=wrong)
