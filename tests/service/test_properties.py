"""The service keeps to its own OpenAPI description, whatever is sent: requests made up from it, and against it."""

from __future__ import annotations

import json
from typing import Any

import jsonschema
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

schemathesis = pytest.importorskip("schemathesis", reason="needs schemathesis, of the dependency group test")
openapi_checks = pytest.importorskip("schemathesis.specs.openapi.checks")

LONGEST_DEADLINE = 60_000
"""Milliseconds, as described."""
FEW = settings(
    max_examples=20,
    deadline=None,
    database=None,
    derandomize=True,
    suppress_health_check=[HealthCheck.function_scoped_fixture, HealthCheck.too_slow, HealthCheck.filter_too_much],
)
FINE = {200, 400, 413, 415, 422}


def check(case: Any, live: Any) -> None:
    """Send a case and compare the answer with what the description says of it."""
    deadline = case.body.get("deadline") if isinstance(case.body, dict) and case.path == "/replan" else None
    if isinstance(deadline, int) and 300 < deadline <= LONGEST_DEADLINE:  # a longer one is to be refused
        case.body["deadline"] = 300
    if isinstance(case.body, dict) and case.path == "/picture" and isinstance(case.body.get("width", 0), int):
        case.body["width"] = min(case.body.get("width", 80), 80)  # large pictures take long
    reply = case.call(base_url=live.url, timeout=30)
    # What is described is not yet what makes sense: a boundary part must be 2, a plan needs a robot that is free.
    excluded = [openapi_checks.positive_data_acceptance]
    if reply.status_code == 413:  # refused before it is read, which the check does not count as refused
        excluded.append(openapi_checks.negative_data_rejection)
    case.validate_response(reply, excluded_checks=excluded)
    assert reply.status_code in FINE


@pytest.fixture(scope="module")
def description(live: Any) -> Any:
    """The operations that the service describes."""
    return schemathesis.openapi.from_dict(live.client.get("/openapi.json").json())


@pytest.mark.parametrize("path", ["/replan", "/stability", "/picture"])
def test_requests_as_described(path: str, description: Any, live: Any) -> None:
    operation = description[path]["POST"]

    @FEW
    @given(case=operation.as_strategy(generation_mode=schemathesis.GenerationMode.POSITIVE))
    def holds(case: Any) -> None:
        check(case, live)

    holds()


@pytest.mark.parametrize("path", ["/replan", "/stability", "/picture"])
def test_requests_against_the_description(path: str, description: Any, live: Any) -> None:
    operation = description[path]["POST"]

    @FEW
    @given(case=operation.as_strategy(generation_mode=schemathesis.GenerationMode.NEGATIVE))
    def holds(case: Any) -> None:
        check(case, live)

    holds()


ANYTHING = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=20),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=8), inner, max_size=4),
    max_leaves=12,
)
NAMES = ("state", "target", "direction", "missing", "fixed", "robots", "alternatives", "seed", "deadline", "states")
NAMES += ("holds", "reserve")
PATHS = ("/replan", "/stability", "/picture")


@FEW
@given(
    content=st.dictionaries(st.sampled_from(NAMES), ANYTHING, max_size=5),
    path=st.sampled_from(PATHS),
)
def test_any_json_at_all(content: dict[str, Any], path: str, live: Any) -> None:
    reply = live.client.post(path, content=json.dumps(content), headers={"Content-Type": "application/json"})
    assert reply.status_code in FINE
    assert "Traceback" not in reply.text


@FEW
@given(content=st.binary(max_size=400), path=st.sampled_from(["/replan", "/stability", "/structure", "/health"]))
def test_any_bytes_at_all(content: bytes, path: str, live: Any) -> None:
    reply = live.client.post(path, content=content, headers={"Content-Type": "application/json"})
    assert reply.status_code in FINE | {405}


VALUES = st.lists(st.integers(0, 2), min_size=5, max_size=5).map(lambda values: [*values, 2, 2])


@FEW
@given(
    state=VALUES,
    target=st.none() | VALUES,
    robots=st.integers(1, 4),
    parts=st.lists(st.integers(0, 6), unique=True, max_size=2),
    which=st.sampled_from(["missing", "fixed"]),
    alternatives=st.integers(1, 2),
)
def test_states_as_a_site_has_them(
    state: Any, target: Any, robots: int, parts: Any, which: str, alternatives: int, live: Any
) -> None:
    """Most of these make sense: the answer is a plan between the states, a proof that there is none, or a reason."""
    content = {"state": state, "target": target, "robots": robots, which: parts, "alternatives": alternatives}
    reply = live.post("/replan", {**content, "deadline": 3000})
    assert reply.status_code in (200, 422), reply.text
    if reply.status_code == 422:
        assert reply.json()["error"]
        return
    answer = reply.json()
    document = live.client.get("/openapi.json").json()
    jsonschema.validate(answer, {"$ref": "#/components/schemas/ReplanAnswer", "components": document["components"]})
    for plan in answer["plans"]:
        ends = plan["start"]["state"], plan["end"]  # in the order of assembly, also of a plan to take apart
        begin, end = ends if answer["direction"] == "assembly" else ends[::-1]
        assert begin == state
        if target is not None:
            assert end == target
    assert bool(answer["plans"]) == (answer["outcome"] == "found")
    assert bool(answer["reason"]) == (not answer["plans"])
