"""Request validation and the OpenAPI schema."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, create_model
from pydantic.json_schema import models_json_schema

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.errors import InputError, StateError
from falsework.replanning.named_state import named_state
from falsework.search.plans.plan_file import plan_schema
from falsework.service.settings import LONGEST_DEADLINE, ServiceSettings
from falsework.service.worker import NOT_YET
from falsework.stability.holds import FORCE_WEIGHTS, HoldSettings, limits_of
from falsework.stability.verdict import Criterion

SHORTEST_DEADLINE = 10
"""Milliseconds."""
MOST_ROBOTS, MOST_ALTERNATIVES = 64, 8
"""Robots and plans that a request may ask for."""
MOST_RESERVE = 100.0
"""Largest reserve of friction that a request may ask for."""
MOST_FRAMES, NARROWEST, WIDEST = 24, 80, 1600
"""States of a contact sheet, and pixels across each."""
_NAME = 1000
"""Characters of the name of a part."""
_SHOWN = 160
"""Characters of an error message that quote the input."""
_REF = "#/components/schemas/{model}"


def _whole(value: Any) -> Any:
    """Convert a whole number: 2.0 is the number 2 in JSON; 2.5, "2" and true are refused."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _whole_values(value: Any) -> Any:
    return [_whole(entry) for entry in value] if isinstance(value, list) else value


def whole(least: int, most: int) -> Any:
    """Return a whole number between two bounds; the bounds come first, or the description would not have them."""
    return Annotated[int, Field(ge=least, le=most), BeforeValidator(_whole)]


def _degrees(most: float) -> Any:
    return Annotated[float, Field(ge=-most, le=most, allow_inf_nan=False)]


def _by_structure() -> None:
    """Return the default of a limit that depends on the structure; the description shows no default of a function."""


class Strict(BaseModel):
    """Base of request models that forbid unknown fields."""

    model_config = ConfigDict(extra="forbid", strict=True)


class Holds(Strict):
    """What robots that hold parts can do, as in plan files; under the criterion contact."""

    stiffness: Annotated[float, Field(gt=0, allow_inf_nan=False)] | None = Field(
        default=None, description="of a hold, N/m; null, the default, for robots that keep the pose of a part"
    )
    force: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = Field(
        default_factory=_by_structure,
        description=f"largest force on a held part, N; by default {FORCE_WEIGHTS:g} weights of the heaviest part, null "
        "for no limit",
    )
    moment: Annotated[float, Field(ge=0, allow_inf_nan=False)] | None = Field(
        default_factory=_by_structure,
        description="largest moment about the centre of mass of a held part, N m; by default twice the force times the "
        "largest radius of gyration, null for no limit",
    )
    mode: Literal["locked", "force", "hybrid"] = Field(
        default=HoldSettings().mode.value,
        description="what robots control while a part is released: the pose (they never press), the wrench of a part "
        "that they press, or its force along one direction and its pose across it",
    )


@dataclass(frozen=True)
class Models:
    """Request models for one structure."""

    replan: type[BaseModel]
    stability: type[BaseModel]
    picture: type[BaseModel]


def models_of(assembly: Assembly, settings: ServiceSettings) -> Models:
    """Return the request models for a structure and the bounds of a service.

    Args:
        assembly: gives the length of a state.
        settings: bounds.
    """
    parts = assembly.part_count
    values = Annotated[
        list[Literal[0, 1, 2]],
        BeforeValidator(_whole_values),
        Field(min_length=parts, max_length=parts, description="one value a part: 0 removed, 1 installed, 2 held"),
    ]
    part: Any = whole(0, parts - 1) | Annotated[str, Field(max_length=_NAME)]
    numbers = Annotated[list[part], Field(max_length=parts, json_schema_extra={"uniqueItems": True})]  # type: ignore[valid-type]
    named: Any = create_model(
        "NamedState",
        __base__=Strict,
        __doc__="A state by its parts, numbers or names; all others are removed, boundary parts apart.",
        standing=(numbers, Field(default=[], description="parts that stand by themselves")),
        held=(numbers, Field(default=[], description="parts that robots hold")),
    )
    state = values | Literal["complete", "empty"] | named
    longest = round(1000 * LONGEST_DEADLINE)
    replan: dict[str, Any] = {
        "state": (state, Field(default="complete", description="current state; boundary parts are always 2")),
        "plan": (
            dict[str, Any] | None,
            Field(
                default=None,
                description="a plan as in an answer, which is being carried out, in place of a state; the new one "
                "begins with the steps that are done",
            ),
        ),
        "step": (
            whole(0, 2**31 - 1) | None,
            Field(default=None, description="last step of the plan that is done; 0 for none"),
        ),
        "target": (
            state | None,
            Field(default=None, description="target state; by default complete in assembly, else empty"),
        ),
        "direction": (
            Literal["assembly", "disassembly"] | None,
            Field(
                default=None,
                description="assembly adds parts, disassembly removes them; by default the direction of the target, "
                "assembly if the state lacks the missing parts, else disassembly",
            ),
        ),
        "missing": (
            numbers,
            Field(
                default=[], description="parts not delivered yet, numbers or names; they are placed as late as possible"
            ),
        ),
        "fixed": (numbers, Field(default=[], description="parts that must not be held or removed")),
        "robots": (
            whole(1, MOST_ROBOTS),
            Field(default=2, description="parts that can be held at a time; by default those of the plan, else 2"),
        ),
        "alternatives": (whole(1, MOST_ALTERNATIVES), Field(default=1, description="number of plans")),
        "removable_only_if_clear": (
            bool,
            Field(default=False, description="move parts along collision-free straight lines only"),
        ),
        "holds": (Holds, Field(default_factory=Holds, description="what robots that hold parts can do")),
        "reserve": (
            Annotated[float, Field(ge=1, le=MOST_RESERVE, allow_inf_nan=False)],
            Field(default=1.0, description="number by which friction is divided"),
        ),
        "seed": (whole(0, 2**31 - 1), Field(default=0, description="same seed, same answer")),
        "deadline": (
            whole(SHORTEST_DEADLINE, longest),
            Field(
                default=round(1000 * settings.deadline),
                description="milliseconds until the response, with the best certified plan so far",
            ),
        ),
    }
    stability: dict[str, Any] = {
        "states": (Annotated[list[state], Field(min_length=1, max_length=settings.states)], ...),
        "explain": (bool, Field(default=False, description="list the parts that move in states that are not stable")),
    }
    picture: dict[str, Any] = {
        "state": (state, Field(default="complete", description="drawn unless there is a plan")),
        "plan": (
            dict[str, Any] | None,
            Field(default=None, description="a plan as in an answer; drawn as a contact sheet of its states"),
        ),
        "step": (
            whole(0, 2**31 - 1) | None,
            Field(
                default=None,
                description="draws the state in which this many steps of the plan are done alone; 0 is the beginning",
            ),
        ),
        "frames": (whole(1, MOST_FRAMES), Field(default=12, description="states of a contact sheet")),
        "proof": (
            bool,
            Field(default=False, description="draw the forces of a single state, or the motion if it does not stand"),
        ),
        "width": (
            whole(NARROWEST, WIDEST) | None,
            Field(default=None, description="pixels across each state; by default 1200, on a contact sheet 480"),
        ),
        "azimuth": (_degrees(360.0), Field(default=-58.0, description="of the camera, degrees about z")),
        "elevation": (_degrees(89.0), Field(default=24.0, description="of the camera, degrees above the horizon")),
    }
    return Models(
        create_model(
            "ReplanRequest",
            __base__=Strict,
            __doc__="Current state, target, and constraints of a new plan.",
            **replan,
        ),
        create_model("StabilityRequest", __base__=Strict, __doc__="States to check.", **stability),
        create_model("PictureRequest", __base__=Strict, __doc__="A state or a plan to draw.", **picture),
    )


def read_state(value: Any, assembly: Assembly) -> States:
    """Return a state in a request as an array, shape (parts,).

    Raises:
        InputError: a boundary part that is not 2, or a name that no part has.
    """
    return named_state(value, assembly)


def read_states(values: list[Any], assembly: Assembly) -> States:
    """Return states in a request as an array, shape (states, parts).

    Raises:
        StateError: a boundary part that is not 2.
    """
    rows = []
    for number, value in enumerate(values):
        try:
            rows.append(read_state(value, assembly))
        except InputError as error:
            raise StateError(f"states {number}: {error}") from None
    return np.stack(rows)


def read_holds(request: BaseModel, assembly: Assembly, criterion: Criterion) -> HoldSettings:
    """Return what robots of a request for a plan can do.

    Raises:
        InputError: robots that cannot carry a part, or limits under a criterion that has none.
    """
    values: dict[str, Any] = request.model_dump(include={"holds"}, exclude_unset=True).get("holds", {})
    if values and criterion != "contact":
        raise InputError(f"holds: under {criterion} robots hold with any force; leave the entry out")
    given: dict[str, Any] = {name: np.inf if value is None else value for name, value in values.items()}
    holds = HoldSettings(**given)
    try:
        limits_of(assembly, holds)
    except InputError as error:
        raise InputError(f"holds: {error}") from None
    return holds


def complaint(error: ValidationError, parts: int) -> str:
    """Return the first thing that is wrong with a request, in one line."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    place = [str(piece) for piece in first["loc"]]
    if not place:
        return f"the request is not a valid JSON object: {first['msg'][:_SHOWN]}; /docs says what it may hold"
    if first["type"] == "extra_forbidden":
        inside = place[-2] if len(place) > 1 else "this request"
        return f"there is no entry {ascii(place[-1])[:_SHOWN]} in {inside}; /docs lists those that there are"
    if place == ["holds"]:
        return "holds: give an object with any of stiffness, force, moment and mode"
    if place == ["states"]:
        return f"states: give a list of states ({first['msg'][:_SHOWN]})"
    if place[0] in ("state", "target", "states"):
        where = f"states {place[1]}" if place[0] == "states" and len(place) > 1 else place[0]
        return (
            f"{where}: give {parts} values 0 (removed), 1 (installed) or 2 (held), one a part, complete or empty, or "
            "an object with the parts standing and held"
        )
    if place[0] in ("missing", "fixed") and len(place) > 1:
        return f"{place[0]} {place[1][:_SHOWN]}: give numbers from 0 to {parts - 1} or names of parts"
    return f"{' '.join(place)[:_SHOWN]}: {first['msg'][:_SHOWN]}"


def components(models: Models) -> dict[str, Any]:
    """Return schemas of all requests and responses, by name, for the OpenAPI description."""
    _, generated = models_json_schema(
        [(model, "validation") for model in (models.replan, models.stability, models.picture)], ref_template=_REF
    )
    number, count = {"type": "number", "minimum": 0}, {"type": "integer", "minimum": 0}
    numbers = {"type": "array", "items": count}
    verdict = {
        "verdict": {
            "enum": ["stable", "slides", "tips", "unstable", "undecided"],
            "description": "slides: forces in balance exist, but the contacts do not produce them; tips: at rest, but "
            "a small motion grows, which is only looked for on request; neither is stable",
        },
        "proof": {
            "enum": ["displacement", "forces", "velocity", "motion", "none"],
            "description": "displacement: of a state that is stable under the criterion contact; forces: of balance, "
            "of a state that slides or that is stable under the criterion equilibrium; motion: from rest, of a state "
            "that tips",
        },
        "residual": {"description": "share of gravity", "anyOf": [{"type": "number"}, {"type": "null"}]},
        "on_tolerance": {
            "type": "boolean",
            "description": "whether the verdict depends on the tolerance, as the residual is near it",
        },
        "moving": {**numbers, "description": "parts that move, the fastest first; only on request"},
    }
    criterion = {
        "enum": list(get_args(Criterion)),
        "description": "stability criterion. contact: compliant contacts without prestress bring every part to rest; "
        "equilibrium: contact forces in balance exist",
    }
    answer = {
        "criterion": criterion,
        "outcome": {
            "enum": ["found", "proved_impossible", "not_found", NOT_YET],
            "description": f"{NOT_YET}: the deadline passed before there was a plan, or a proof that there is none",
        },
        "decided_by": {"type": "string"},
        "direction": {"enum": ["assembly", "disassembly", None]},
        "built": {"description": "steps that are done, with which the plans begin", **count},
        "steps": {"description": "actions to the target", "anyOf": [count, {"type": "null"}]},
        "reached": {"description": "actions of the longest stable path found", **count},
        "seconds": number,
        "deadline_passed": {"type": "boolean", "description": "more time might give a plan, or a better one"},
        "reason": {"type": "string", "description": "why there is no plan"},
        "moving": {**numbers, "description": "parts that move where the search ended"},
        "plans": {"type": "array", "items": {"$ref": _REF.format(model="Plan")}},
        "distances": {"type": "array", "items": {"type": "array", "items": number}},
    }
    part = {"part": count, "name": {"type": "string"}, "boundary": {"type": "boolean"}, "mass": number}
    part |= {"center": {"type": "array", "items": {"type": "number"}, "minItems": 3, "maxItems": 3}}
    structure = {
        "name": {"type": "string"},
        "identity": {"type": "string"},
        "friction": number,
        "contacts": count,
        "policy": {"type": "boolean", "description": "whether a trained policy proposes actions"},
        "parts": {"type": "array", "items": _object(part)},
    }
    health = {"status": {"enum": ["ok", "starting"]}, "planners": count, "judges": count, "waiting": count}
    return {
        **generated.get("$defs", {}),
        **_plan_components(),
        "ReplanAnswer": _object(answer),
        "Verdict": _object(verdict, optional=("moving",)),
        "StabilityAnswer": _object(
            {"criterion": criterion, "verdicts": {"type": "array", "items": {"$ref": _REF.format(model="Verdict")}}}
        ),
        "Structure": _object(structure),
        "Health": _object(health),
        "Error": _object({"error": {"type": "string", "description": "one line with a remedy"}}),
    }


def structure_record(assembly: Assembly, *, policy: bool) -> dict[str, Any]:
    """Return the answer to `GET /structure`."""
    return {
        "name": assembly.name,
        "identity": assembly.identity,
        "friction": assembly.friction,
        "contacts": len(assembly.contacts),
        "policy": policy,
        "parts": [
            {
                "part": part,
                "name": name,
                "boundary": bool(assembly.boundary[part]),
                "mass": float(f"{assembly.mass.mass[part]:.6g}"),
                "center": [float(f"{value:.6g}") for value in assembly.mass.center[part]],
            }
            for part, name in enumerate(assembly.names)
        ],
    }


def _plan_components() -> dict[str, Any]:
    """Return the published schema of plans, its definitions among the components."""
    schema = plan_schema()
    text = json.dumps({name: value for name, value in schema.items() if name not in ("$schema", "$id", "$defs")})
    found: dict[str, Any] = {"Plan": text}
    found |= {f"Plan{name.capitalize()}": json.dumps(value) for name, value in schema["$defs"].items()}
    for name, written in found.items():
        for other in schema["$defs"]:
            written = written.replace(f'"#/$defs/{other}"', f'"{_REF.format(model=f"Plan{other.capitalize()}")}"')
        found[name] = json.loads(written)
    return found


def _object(properties: dict[str, Any], optional: tuple[str, ...] = ()) -> dict[str, Any]:
    return {
        "type": "object",
        "additionalProperties": False,
        "required": [name for name in properties if name not in optional],
        "properties": properties,
    }
