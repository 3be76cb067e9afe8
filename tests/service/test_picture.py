"""Pictures over HTTP: of states with their proofs, of plans, and what cannot be drawn."""

from __future__ import annotations

import base64
import io
import multiprocessing
import tracemalloc
import zlib
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, find_plans, load_structure, make_task
from falsework.search.plans.plan_file import plan_to_dict
from falsework.service.worker import Done, Item, WorkerConfig, _Painter

pillow = pytest.importorskip("PIL.Image", reason="needs Pillow; pip install 'falsework[picture]'")

SMALL = {"width": 160}
NO_KEYSTONE = [1, 1, 0, 1, 1, 2, 2]


def drawn(assembly: Assembly, order: dict[str, Any]) -> Done:
    """What a worker answers that draws in this process."""
    mine, theirs = multiprocessing.Pipe()
    usual = {"state": np.where(assembly.boundary, 2, 1).astype(np.uint8), "plan": None, "step": None, "frames": 1}
    usual |= {"proof": False, "width": 80, "azimuth": -58.0, "elevation": 24.0}
    _Painter(WorkerConfig(assembly, "picture")).answer([Item(7, usual | order, 1.0)], theirs)
    return mine.recv()


def pixels_of(reply: Any) -> NDArray[np.uint8]:
    """The picture in an answer, shape (height, width, 3)."""
    assert reply.status_code == 200, reply.text
    assert reply.headers["content-type"] == "image/png"
    return np.asarray(pillow.open(io.BytesIO(reply.content)).convert("RGB"))


def test_a_state_is_drawn_with_and_without_its_proof(live: Any) -> None:
    plain = pixels_of(live.post("/picture", {"state": "complete", **SMALL}))
    assert plain.shape[1] == 160
    assert np.array_equal(plain, pixels_of(live.post("/picture", SMALL)))
    proof = pixels_of(live.post("/picture", {"state": "complete", "proof": True, **SMALL}))
    fallen = pixels_of(live.post("/picture", {"state": NO_KEYSTONE, "proof": True, **SMALL}))
    turned = pixels_of(live.post("/picture", {"azimuth": 20, **SMALL}))
    for other in (proof, turned):
        assert other.shape[1] == plain.shape[1]  # a legend of forces may take more rows
        assert not np.array_equal(other, plain)
    assert not np.array_equal(fallen, proof)


@pytest.mark.parametrize("elevation", [0.0, -0.0, 1e-300, -30.0, 89.0])
def test_a_camera_at_any_height(elevation: float, live: Any) -> None:
    assert pixels_of(live.post("/picture", {"elevation": elevation, **SMALL})).min() < 200  # something is drawn


def test_a_plan_is_drawn_as_a_sheet_or_one_step(live: Any) -> None:
    (plan,) = live.post("/replan", {"state": "empty", "direction": "assembly"}).json()["plans"]
    sheet = pixels_of(live.post("/picture", {"plan": plan, "frames": 4, **SMALL}))
    assert sheet.shape[1] == 4 * 160
    first, last = (
        pixels_of(live.post("/picture", {"plan": plan, "step": step, **SMALL})) for step in (0, len(plan["steps"]))
    )
    assert not np.array_equal(first, last)


@pytest.mark.parametrize(
    ("content", "hints"),
    [
        ({"step": 1}, ("step", "plan")),
        ({"plan": {}}, ("plan",)),
        ({"plan": {"format": "falsework.plan/9"}}, ("falsework.plan/9",)),
        ({"state": [1, 1]}, ("state", "7 values")),
        ({"state": [1, 1, 1, 1, 1, 2, 1]}, ("6", "boundary")),
        ({"width": 10}, ("width",)),
        ({"frames": 1000}, ("frames",)),
        ({"azimuth": "north"}, ("azimuth",)),
        ({"colour": "red"}, ("colour",)),
    ],
)
def test_what_cannot_be_drawn(content: dict[str, Any], hints: tuple[str, ...], live: Any) -> None:
    reply = live.post("/picture", content)
    assert reply.status_code == 422
    assert reply.headers["content-type"] == "application/json"
    error = reply.json()["error"]
    assert "\n" not in error
    for hint in hints:
        assert hint in error, error


def test_a_step_or_a_structure_that_does_not_fit_the_plan(live: Any) -> None:
    (plan,) = live.post("/replan", {}).json()["plans"]
    reply = live.post("/picture", {"plan": plan, "step": 999})
    assert reply.status_code == 422
    assert "999" in reply.json()["error"]
    plan["structure"]["identity"] = "0" * len(plan["structure"]["identity"])
    assert live.post("/picture", {"plan": plan}).status_code == 422


@pytest.mark.parametrize("claim", ["displacements", "forces", "parts"])
def test_a_short_plan_takes_little_memory(claim: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Of 250 kB that would unpack to 150 MB and more."""
    assembly = load_structure("arch:blocks=3")
    (plan,) = find_plans(assembly, make_task(assembly, 2)).plans
    content, count = plan_to_dict(plan), 400_000
    if claim == "parts":
        content["structure"]["parts"] = [str(number) for number in range(count // 10)]
        content["steps"] = content["steps"] * 500
    else:
        zeros = zlib.compress(bytes(count * 8 * 6 * (len(plan) + 1)))
        counted = "parts" if claim == "displacements" else "points"
        content[claim] = {counted: count, "zlib_base64": base64.b64encode(zeros).decode()}
    monkeypatch.setattr("os.nice", lambda _: 0)
    drawn(assembly, {"plan": None})  # imports take memory too
    tracemalloc.start()
    try:
        done = drawn(assembly, {"plan": content, "step": 0})
        if claim == "parts":
            assert done.status == 422
            assert b"the plan is of 40000 parts, arch:blocks=3 has 5" in done.body
        else:
            assert (done.status, done.body[:4]) == (200, b"\x89PNG")
        assert tracemalloc.get_traced_memory()[1] < 40e6
    finally:
        tracemalloc.stop()


def test_pictures_do_not_count_as_workers_for_requests(live: Any) -> None:
    pixels_of(live.post("/picture", SMALL))
    assert set(live.client.get("/health").json()) == {"status", "planners", "judges", "waiting"}
    assert [worker.kind for worker in live.pool.workers].count("picture") == 1


def test_without_pillow_the_extra_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    import sys

    monkeypatch.setitem(sys.modules, "PIL", None)
    monkeypatch.setattr("os.nice", lambda _: 0)
    done = drawn(load_structure("arch:blocks=3"), {})
    assert (done.number, done.status) == (7, 501)
    assert b"falsework[picture]" in done.body
