"""Models of requests and answers, from which the checks of requests and the OpenAPI description derive."""

from __future__ import annotations

from typing import Annotated, Any, Literal, TypeVar

import numpy as np
from msgspec import UNSET, Meta, UnsetType, structs

from falsework.assembly.assembly_model import Count
from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.errors import InputError, StateError
from falsework.replanning.named_state import named_state
from falsework.search.plans.plan_model import HoldStiffness, NotNegative, PlanFile, Positive
from falsework.service.settings import LONGEST_DEADLINE, ServiceSettings
from falsework.stability.holds import HoldMode, HoldSettings
from falsework.stability.verdict import Criterion
from falsework.utils.json_text import parse_json
from falsework.utils.models import FileModel, model_schemas, read_model

SHORTEST_DEADLINE = 10
"""Milliseconds."""
MOST_ROBOTS, MOST_ALTERNATIVES = 64, 8
"""Robots and plans that a request may ask for."""
MOST_RESERVE = 100.0
"""Largest reserve of friction that a request may ask for."""
MOST_FRAMES, NARROWEST, WIDEST = 24, 80, 1600
"""States of a contact sheet, and pixels across each."""

PartName = Count | Annotated[str, Meta(max_length=1000)]
Parts = Annotated[list[PartName], Meta(extra_json_schema={"uniqueItems": True})]


class Holds(FileModel, frozen=True):
    """What robots that hold parts can do, as in plan files; under the criterion contact."""

    stiffness: HoldStiffness | None = None
    """Of a hold, N/m; null, the default, for robots that keep the pose of a part."""
    force: NotNegative | UnsetType | None = UNSET
    """Largest force on a held part, N; by default fifty weights of the heaviest part, null for no limit."""
    moment: Positive | UnsetType | None = UNSET
    """Largest moment about the centre of mass of a held part, N m; by default twice the force times the largest radius
    of gyration, null for no limit."""
    mode: HoldMode = HoldSettings().mode
    """What robots control while a part is released: the pose (they never press), the wrench of a part that they press,
    or its force along one direction and its pose across it."""


class NamedState(FileModel, frozen=True):
    """A state by its parts, numbers or names; all others are removed, boundary parts apart."""

    standing: Parts = []
    """Parts that stand by themselves."""
    held: Parts = []
    """Parts that robots hold."""


class SiteActions(FileModel, frozen=True):
    """What was done on site after the last step of a plan that is done; the next steps of the new plan."""

    props: Parts = []
    """Parts under each of which a prop was placed."""
    held: Parts = []
    """Parts that stand, of which a robot has taken hold."""
    released: Parts = []
    """Held parts of which the robot has let go."""


State = Annotated[list[Literal[0, 1, 2]], Meta(min_length=1)] | Literal["complete", "empty"] | NamedState
"""One value a part: 0 removed, 1 installed, 2 held; boundary parts are always 2."""


class ReplanRequest(FileModel, frozen=True):
    """Current state, target, and constraints of a new plan."""

    state: State | UnsetType = UNSET
    """Current state, one value a part: 0 removed, 1 installed, 2 held (boundary parts are always 2), or by its parts;
    by default complete."""
    plan: dict[str, Any] | None = None
    """A plan as in an answer, which is being carried out, in place of a state; the new one begins with the steps that
    are done."""
    step: Annotated[int, Meta(ge=0, lt=2**31)] | None = None
    """Last step of the plan that is done; 0 for none."""
    since: SiteActions = SiteActions()
    """What was done on site after that step."""
    target: State | None = None
    """Target state; by default complete in assembly, else empty."""
    direction: Literal["assembly", "disassembly"] | None = None
    """Assembly adds parts, disassembly removes them; by default the direction of the target, assembly if the state
    lacks the missing parts, else disassembly."""
    missing: Parts = []
    """Parts not delivered yet, numbers or names; they are placed as late as possible."""
    fixed: Parts = []
    """Parts that must not be held or removed."""
    robots: Annotated[int, Meta(ge=1, le=MOST_ROBOTS)] | UnsetType = UNSET
    """Parts that can be held at a time; by default those of the plan, else those of the run that is served, else 2."""
    alternatives: Annotated[int, Meta(ge=1, le=MOST_ALTERNATIVES)] = 1
    """Number of plans."""
    removable_only_if_clear: bool = False
    """Move parts along collision-free straight lines only; so too where the run that is served does."""
    holds: Holds | UnsetType = UNSET
    """What robots that hold parts can do."""
    reserve: Annotated[float, Meta(ge=1, le=MOST_RESERVE)] | UnsetType = UNSET
    """Number by which friction is divided; by default that of the plan, else 1.1 under the criterion contact."""
    seed: Annotated[int, Meta(ge=0, lt=2**31)] = 0
    """Same seed, same answer."""
    deadline: Annotated[int, Meta(ge=SHORTEST_DEADLINE, le=round(1000 * LONGEST_DEADLINE))] | None = None
    """Milliseconds until the response, with the best certified plan so far; by default that of the service."""


class StabilityRequest(FileModel, frozen=True):
    """States to check."""

    states: Annotated[list[State], Meta(min_length=1)]
    """Each with one value a part: 0 removed, 1 installed, 2 held (boundary parts are always 2), or by its parts."""
    explain: bool = False
    """List the parts that move in states that are not stable."""


class PictureRequest(FileModel, frozen=True):
    """A state or a plan to draw."""

    state: State = "complete"
    """Drawn unless there is a plan."""
    plan: dict[str, Any] | None = None
    """A plan as in an answer; drawn as a contact sheet of its states."""
    step: Annotated[int, Meta(ge=0, lt=2**31)] | None = None
    """Draws the state in which this many steps of the plan are done alone; 0 is the beginning."""
    frames: Annotated[int, Meta(ge=1, le=MOST_FRAMES)] = 12
    """States of a contact sheet."""
    proof: bool = False
    """Draw the forces of a single state, or the motion if it does not stand."""
    width: Annotated[int, Meta(ge=NARROWEST, le=WIDEST)] | None = None
    """Pixels across each state; by default 1200, on a contact sheet 480."""
    azimuth: Annotated[float, Meta(ge=-360, le=360)] = -58.0
    """Of the camera, degrees about z."""
    elevation: Annotated[float, Meta(ge=-89, le=89)] = 24.0
    """Of the camera, degrees above the horizon."""


class ReplayRecord(FileModel, frozen=True):
    """Replay of a plan with contact history, as far as the deadline allowed."""

    stands: bool | None
    """Whether every state comes to rest; null where the deadline came first: the rest was judged from rest."""
    steps: Count
    """Steps of assembly that were replayed and came to rest."""
    of: Count
    """Steps of the plan."""
    moved_mm: NotNegative
    """Largest movement of a part."""


class ReplanAnswer(FileModel, frozen=True):
    """Plans, or why there is none."""

    criterion: Criterion
    """Contact: compliant contacts without prestress bring every part to rest; equilibrium: contact forces in balance
    exist."""
    outcome: Literal["found", "proved_impossible", "not_found", "not_yet"]
    """not_yet: the deadline passed before there was a plan, or a proof that there is none."""
    decided_by: str
    direction: Literal["assembly", "disassembly"] | None
    built: Count
    """Steps that are done, with which the plans begin."""
    steps: Count | None
    """Actions to the target."""
    reached: Count
    """Actions of the longest stable path found."""
    seconds: NotNegative
    deadline_passed: bool
    """More time might give a plan, or a better one."""
    reason: str
    """Why there is no plan."""
    moving: list[Count]
    """Parts that move where the search ended."""
    plans: list[PlanFile]
    unreserved: str
    """Why no plan keeps the reserve that was asked for, so that those here keep none; empty if they keep it."""
    replays: list[ReplayRecord]
    """One for each plan under the criterion contact. Changes of settings are not tried."""
    distances: list[list[NotNegative]]


class VerdictRecord(FileModel, frozen=True):
    """Verdict on a state."""

    verdict: Literal["stable", "slides", "tips", "unstable", "undecided"]
    """slides: forces in balance exist, but the contacts do not produce them; tips: at rest, but a small motion grows,
    which is only looked for on request; neither is stable."""
    proof: Literal["displacement", "forces", "velocity", "motion", "none"]
    """displacement: of a state that is stable under the criterion contact; forces: of balance, of a state that slides
    or that is stable under the criterion equilibrium; motion: from rest, of a state that tips."""
    residual: float | None
    """Share of gravity."""
    on_tolerance: bool
    """Whether the verdict depends on the tolerance, as the residual is near it."""
    moving: list[Count] | UnsetType = UNSET
    """Parts that move, the fastest first; only on request."""


class StabilityAnswer(FileModel, frozen=True):
    """Verdicts in the order of the states."""

    criterion: Criterion
    verdicts: list[VerdictRecord]


class PartRecord(FileModel, frozen=True):
    """Part of the structure."""

    part: Count
    name: str
    boundary: bool
    mass: NotNegative
    center: Annotated[list[float], Meta(min_length=3, max_length=3)]


class StructureRecord(FileModel, frozen=True):
    """The structure and its parts."""

    name: str
    identity: str
    friction: NotNegative
    contacts: Count
    policy: bool
    """Whether a trained policy proposes actions."""
    parts: list[PartRecord]


class Health(FileModel, frozen=True):
    """Readiness of the workers."""

    status: Literal["ok", "starting"]
    planners: Count
    judges: Count
    waiting: Count


class Refusal(FileModel, frozen=True):
    """Answer to a request that is refused."""

    error: str
    """One line with a remedy."""


Request = TypeVar("Request", ReplanRequest, StabilityRequest, PictureRequest)


def read_request(kind: type[Request], body: bytes) -> Request:
    """Return a request. Raises: InputError: no JSON, or entries that are missing, unknown or wrong; one line."""
    try:
        data = _whole(parse_json(body.decode()))
    except ValueError as error:
        raise InputError(
            f"the request is not a valid JSON object: {str(error)[:160]}; /docs says what it holds"
        ) from None
    if not isinstance(data, dict):
        raise InputError("the request is not a JSON object; /docs says what it may hold")
    return read_model(kind, data, "", InputError, remedy="; /docs lists the entries")


def _whole(value: Any) -> Any:
    """Convert whole numbers: 2.0 is the number 2 in JSON."""
    if isinstance(value, list):
        return [_whole(entry) for entry in value]
    if isinstance(value, dict):
        return {key: entry if key == "plan" else _whole(entry) for key, entry in value.items()}
    return int(value) if isinstance(value, float) and value.is_integer() else value


def state_of(value: Any, assembly: Assembly, place: str) -> States:
    """Return a state in a request as an array, shape (parts,)."""
    if isinstance(value, list) and len(value) != assembly.part_count:
        raise StateError(
            f"{place}: give {assembly.part_count} values 0 (removed), 1 (installed) or 2 (held), one a part, complete "
            "or empty, or an object with the parts standing and held"
        )
    try:
        return named_state(structs.asdict(value) if isinstance(value, NamedState) else value, assembly)
    except InputError as error:
        raise StateError(f"{place}: {error}") from None


def read_states(values: list[Any], assembly: Assembly, settings: ServiceSettings) -> States:
    """Return states in a request as an array, shape (states, parts)."""
    if len(values) > settings.states:
        raise StateError(f"states: there are {len(values)}; give at most {settings.states}")
    return np.stack([state_of(value, assembly, f"states[{number}]") for number, value in enumerate(values)])


def read_holds(given: Holds, criterion: Criterion) -> HoldSettings:
    """Return what robots of a request for a plan can do."""
    if given != Holds() and criterion != "contact":
        raise InputError(f"holds: under {criterion} robots hold with any force; leave the entry out")
    limits = {name: getattr(given, name) for name in ("stiffness", "force", "moment")}
    finite: dict[str, Any] = {
        name: np.inf if value is None else value for name, value in limits.items() if value is not UNSET
    }
    return HoldSettings(**finite, mode=given.mode)


def components() -> dict[str, Any]:
    """Return schemas of all requests and responses, by name, for the OpenAPI description."""
    answers = (ReplanAnswer, StabilityAnswer, StructureRecord, Health, Refusal)
    return model_schemas((ReplanRequest, StabilityRequest, PictureRequest, *answers), "#/components/schemas/{name}")


def structure_record(assembly: Assembly, *, policy: bool) -> StructureRecord:
    """Return the answer to `GET /structure`."""
    parts = [
        PartRecord(
            part=part,
            name=name,
            boundary=bool(assembly.boundary[part]),
            mass=float(f"{assembly.mass.mass[part]:.6g}"),
            center=[float(f"{value:.6g}") for value in assembly.mass.center[part]],
        )
        for part, name in enumerate(assembly.names)
    ]
    return StructureRecord(
        name=assembly.name,
        identity=assembly.identity,
        friction=assembly.friction,
        contacts=len(assembly.contacts),
        policy=policy,
        parts=parts,
    )
