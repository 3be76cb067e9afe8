"""Stability as a service reports it: it says by which criterion, and calls what slides by its name."""

from __future__ import annotations

import json
from typing import Any

import jsonschema
import numpy as np
import pytest
from msgspec import convert

pytest.importorskip("fastapi", reason="the service needs fastapi; pip install 'falsework[service]'")

from falsework import Assembly
from falsework.assembly.library.blocks import box, gather
from falsework.errors import InputError
from falsework.service.schema import Holds, components, read_holds
from falsework.service.worker import Item, WorkerConfig, _Judge, _Planner
from falsework.stability import HoldSettings
from falsework.stability.holds import HoldMode


class Pipe:
    """Keeps what a worker sends."""

    def __init__(self) -> None:
        self.answers: dict[int, Any] = {}

    def send(self, done: Any) -> None:
        self.answers[done.number] = json.loads(done.body)


@pytest.fixture(scope="module")
def clamp() -> Assembly:
    """A cube between two fixed walls with nothing below it."""
    walls = [box("left", (-1, 0, -1), (0, 1, 2), fixed=True), box("right", (1, 0, -1), (2, 1, 2), fixed=True)]
    made = gather([box("cube", (0, 0, 0), (1, 1, 1)), *walls])
    return Assembly.from_meshes(made.meshes, boundary=made.boundary)


@pytest.mark.parametrize(
    ("criterion", "verdict", "proof", "moving"),
    [("contact", "slides", "forces", [0]), ("equilibrium", "stable", "forces", [])],
)
def test_verdicts(criterion: Any, verdict: str, proof: str, moving: list[int], clamp: Assembly) -> None:
    judge, pipe = _Judge(WorkerConfig(clamp, "stability", None, criterion)), Pipe()
    states = np.array([[1, 2, 2], [2, 2, 2]], dtype=np.uint8)
    judge.answer([Item(0, (states, True), 10.0), Item(1, (states, False), 10.0)], pipe)  # type: ignore[arg-type]
    for number in (0, 1):
        answer = pipe.answers[number]
        assert answer["criterion"] == criterion
        first, held = answer["verdicts"]
        assert (first["verdict"], first["proof"]) == (verdict, proof)
        assert held["verdict"] == "stable"
        assert held["proof"] == ("displacement" if criterion == "contact" else "forces")
        schemas = components()
        jsonschema.validate(answer, {**schemas["StabilityAnswer"], "components": {"schemas": schemas}})
    assert [record["moving"] for record in pipe.answers[0]["verdicts"]] == [moving, []]


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_plans(criterion: Any, clamp: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    """Where the walls must press by themselves the cube cannot be let go of; where they do, it can."""
    monkeypatch.setattr("os.nice", lambda _: None)
    planner, pipe = _Planner(WorkerConfig(clamp, "replan", None, criterion)), Pipe()
    state = np.array([1, 2, 2], dtype=np.uint8)
    planner.answer([Item(0, {"state": state}, 10.0)], pipe)  # type: ignore[arg-type]
    answer = pipe.answers[0]
    assert answer["criterion"] == criterion
    assert (answer["outcome"] == "found") == (criterion == "equilibrium")
    schemas = components()
    jsonschema.validate(answer, {**schemas["ReplanAnswer"], "components": {"schemas": schemas}})
    assert [plan["stability"]["criterion"] for plan in answer["plans"]] == ["equilibrium"] * len(answer["plans"])


def test_robots_have_limits_under_contact_alone(clamp: Assembly) -> None:
    for given, holds in (
        ({}, HoldSettings()),
        ({"holds": {}}, HoldSettings()),
        ({"holds": {"force": 1e6, "mode": "locked"}}, HoldSettings(force=1e6, mode=HoldMode.LOCKED)),
        ({"holds": {"stiffness": None, "force": None}}, HoldSettings(np.inf, np.inf)),
    ):
        assert read_holds(convert(given.get("holds", {}), Holds), "contact") == holds
    assert read_holds(Holds(), "equilibrium") == HoldSettings()
    with pytest.raises(InputError, match="holds: under equilibrium robots hold with any force"):
        read_holds(Holds(mode=HoldMode.LOCKED), "equilibrium")
