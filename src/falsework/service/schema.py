"""Request validation and the OpenAPI schema."""

from __future__ import annotations

import json
from dataclasses import dataclass
from typing import Annotated, Any, Literal, get_args

import numpy as np
from pydantic import BaseModel, BeforeValidator, ConfigDict, Field, ValidationError, create_model
from pydantic.json_schema import models_json_schema

from falsework.assembly.model import Assembly
from falsework.assembly.state import States, as_states, complete_state, empty_state
from falsework.errors import InputError, StateError
from falsework.search.plans.plan_file import plan_schema
from falsework.service.settings import ServiceSettings
from falsework.service.worker import NOT_YET
from falsework.stability.verdict import Criterion

SHORTEST_DEADLINE = 10
"""Milliseconds."""
MOST_ROBOTS, MOST_ALTERNATIVES = 64, 8
_SHOWN = 160
"""Characters of a complaint that quote what came in."""
_REF = "#/components/schemas/{model}"


def _whole(value: Any) -> Any:
    """2.0 is the number 2 in JSON; 2.5, "2" and true are not."""
    return int(value) if isinstance(value, float) and value.is_integer() else value


def _whole_values(value: Any) -> Any:
    return [_whole(entry) for entry in value] if isinstance(value, list) else value


def whole(least: int, most: int) -> Any:
    """Return a whole number between two bounds; the bounds come first, or the description would not have them."""
    return Annotated[int, Field(ge=least, le=most), BeforeValidator(_whole)]


class Strict(BaseModel):
    """Base of request models that forbid unknown fields."""

    model_config = ConfigDict(extra="forbid", strict=True)


@dataclass(frozen=True)
class Schema:
    """Requests and answers for one structure and the bounds of a service."""

    assembly: Assembly
    settings: ServiceSettings
    replan: type[BaseModel]
    stability: type[BaseModel]

    @classmethod
    def of(cls, assembly: Assembly, settings: ServiceSettings) -> Schema:
        """Return the schema of a structure, which says how long a state is, under the bounds of a service."""
        return cls(assembly, settings, *_models(assembly, settings))

    def parse_replan(self, body: bytes) -> tuple[dict[str, Any], float]:
        """Return a request for plans, states as arrays, and its deadline in seconds.

        Raises:
            InputError: what is wrong with it, in one line.
        """
        wanted = self._parsed(self.replan, body)
        deadline = wanted.pop("deadline") / 1000
        return wanted | {name: self._state(wanted[name]) for name in ("state", "target") if wanted[name]}, deadline

    def parse_stability(self, body: bytes) -> tuple[tuple[States, bool], float]:
        """Return states to judge, shape (states, parts), whether to explain, and the seconds for it.

        Raises:
            InputError: what is wrong with the request, in one line.
        """
        wanted, rows = self._parsed(self.stability, body), []
        for number, value in enumerate(wanted["states"]):
            try:
                rows.append(self._state(value))
            except StateError as error:
                raise StateError(f"states {number}: {error}") from None
        return (np.stack(rows), wanted["explain"]), self.settings.stability_seconds

    def _parsed(self, model: type[BaseModel], body: bytes) -> dict[str, Any]:
        try:
            return model.model_validate_json(body).model_dump()
        except ValidationError as error:
            raise InputError(_complaint(error, self.assembly.part_count)) from None

    def _state(self, value: Any) -> States:
        if value == "complete":
            return complete_state(self.assembly.boundary)
        if value == "empty":
            return empty_state(self.assembly.boundary)
        return as_states(value, self.assembly.boundary)[0]

    def components(self) -> dict[str, Any]:
        """Return schemas of everything that goes in and out, by name, for the OpenAPI description."""
        _, generated = models_json_schema(
            [(self.replan, "validation"), (self.stability, "validation")], ref_template=_REF
        )
        number, count = {"type": "number", "minimum": 0}, {"type": "integer", "minimum": 0}
        numbers = {"type": "array", "items": count}
        verdict = {
            "verdict": {
                "enum": ["stable", "slides", "unstable", "undecided"],
                "description": "slides: forces in balance exist, but the contacts do not bring them about; the state "
                "does not stand",
            },
            "proof": {
                "enum": ["displacement", "forces", "velocity", "none"],
                "description": "displacement: of a state that is stable under the criterion contact; forces: of "
                "balance, of a state that slides or that is stable under the criterion equilibrium",
            },
            "residual": {"description": "share of gravity", "anyOf": [{"type": "number"}, {"type": "null"}]},
            "moving": {**numbers, "description": "parts that move, the fastest first; only on request"},
        }
        criterion = {
            "enum": list(get_args(Criterion)),
            "description": "what stable means. contact: compliant contacts without prestress bring every part to rest; "
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
            "steps": {"description": "actions to the target", "anyOf": [count, {"type": "null"}]},
            "reached": {"description": "actions of the longest stable way that was found", **count},
            "seconds": number,
            "deadline_passed": {"type": "boolean", "description": "more time might give a plan, or a better one"},
            "reason": {"type": "string", "description": "why there is no plan"},
            "moving": {**numbers, "description": "parts that move where the search broke off"},
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
            "Error": _object({"error": {"type": "string", "description": "one line that says what to do"}}),
        }

    def structure_record(self, *, policy: bool) -> dict[str, Any]:
        """Return the answer to `GET /structure`."""
        assembly = self.assembly
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


def _models(assembly: Assembly, settings: ServiceSettings) -> tuple[type[BaseModel], type[BaseModel]]:
    """Return the models of the requests for plans and for verdicts."""
    parts = assembly.part_count
    values = Annotated[
        list[Literal[0, 1, 2]],
        BeforeValidator(_whole_values),
        Field(min_length=parts, max_length=parts, description="one value a part: 0 removed, 1 installed, 2 held"),
    ]
    state = values | Literal["complete", "empty"]
    numbers = Annotated[list[whole(0, parts - 1)], Field(max_length=parts, json_schema_extra={"uniqueItems": True})]
    longest = round(1000 * settings.longest_deadline)
    replan: dict[str, Any] = {
        "state": (state, Field(default="complete", description="where things stand; boundary parts are always 2")),
        "target": (
            state | None,
            Field(default=None, description="where they shall go; by default complete in assembly, else empty"),
        ),
        "direction": (
            Literal["assembly", "disassembly"] | None,
            Field(
                default=None,
                description="assembly adds parts, disassembly takes them away; by default what leads to the target, "
                "assembly where parts are missing that the state does not have, else disassembly",
            ),
        ),
        "missing": (
            numbers,
            Field(default=[], description="parts not delivered yet; they go in as late as can be"),
        ),
        "fixed": (numbers, Field(default=[], description="parts that must not be held or removed")),
        "robots": (whole(1, MOST_ROBOTS), Field(default=2, description="parts that can be held at a time")),
        "alternatives": (whole(1, MOST_ALTERNATIVES), Field(default=1, description="plans wanted")),
        "removable_only_if_clear": (
            bool,
            Field(default=False, description="move parts along free straight ways only"),
        ),
        "seed": (whole(0, 2**31 - 1), Field(default=0, description="same seed, same answer")),
        "deadline": (
            whole(SHORTEST_DEADLINE, longest),
            Field(
                default=round(1000 * settings.deadline),
                description="milliseconds until the answer: the best proven one so far",
            ),
        ),
    }
    stability: dict[str, Any] = {
        "states": (Annotated[list[state], Field(min_length=1, max_length=settings.states)], ...),
        "explain": (bool, Field(default=False, description="name the parts that move in states that do not stand")),
    }
    return (
        create_model(
            "ReplanRequest",
            __base__=Strict,
            __doc__="Where things stand, where they shall go, and what has changed.",
            **replan,
        ),
        create_model("StabilityRequest", __base__=Strict, __doc__="States to judge.", **stability),
    )


def _complaint(error: ValidationError, parts: int) -> str:
    """Return the first thing that is wrong with a request, in one line."""
    first = error.errors(include_url=False, include_context=False, include_input=False)[0]
    place = [str(piece) for piece in first["loc"]]
    if not place:
        return f"the request is no JSON object as it must be: {first['msg'][:_SHOWN]}; /docs says what it may hold"
    if place[0] in ("state", "target", "states"):
        where = f"states {place[1]}" if place[0] == "states" and len(place) > 1 else place[0]
        return f"{where}: give {parts} values 0 (removed), 1 (installed) or 2 (held), one a part, or complete or empty"
    if first["type"] == "extra_forbidden":
        return f"there is no entry {ascii(place[0])[:_SHOWN]} in this request; /docs lists those that there are"
    return f"{' '.join(place)[:_SHOWN]}: {first['msg'][:_SHOWN]}"


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
