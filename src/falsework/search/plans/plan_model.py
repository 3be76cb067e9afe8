"""Model of plan files, from which reading, writing, messages and the JSON Schema derive."""

from __future__ import annotations

from typing import Annotated, Any, Literal

import numpy as np
from msgspec import Meta

from falsework.assembly.assembly_model import MOST, Count, Earthquake, LoadEntry, Prop
from falsework.geometry.clearance.moves import MOST_MOVES
from falsework.search.margins.demands import Demands
from falsework.search.plans.plan import PartDeadline
from falsework.search.plans.steps import Action
from falsework.stability.holds import LEAST_STIFFNESS, HoldLoad, HoldMode, Press
from falsework.stability.judges.judgement import Judgement
from falsework.utils.models import FileModel, model_schema

FORMAT = "falsework.plan/4"
UNPROVEN: dict[str, Any] = {"verdict": "undecided", "proof": "none", "residual": None}
"""Entries of a state that is not proven, in a plan whose replay fails."""

Part = Annotated[int, Meta(ge=0)]
Parts = Annotated[tuple[Part, ...], Meta(extra_json_schema={"uniqueItems": True})]
NotNegative = Annotated[float, Meta(ge=0)]
Positive = Annotated[float, Meta(gt=0)]
HoldStiffness = Annotated[float, Meta(ge=LEAST_STIFFNESS)]
"""Stiffness of a hold that gives way, N/m."""
Limit = Annotated[float, Meta(gt=0, le=MOST)] | None
Bounds = tuple[Annotated[float, Meta(ge=0, le=MOST)] | None, ...] | None
PartValues = Annotated[
    tuple[Literal[0, 1, 2], ...],
    Meta(min_length=1, description="For each part 0 removed, 1 installed, 2 held; boundary parts are always 2."),
]
Word = Annotated[
    Literal["stable", "undecided"],
    Meta(
        description="undecided: not proven, in a plan whose replay fails; then the proof is none and the residual null."
    ),
]
ProofWord = Annotated[
    Literal["history", "forces", "none"],
    Meta(
        description="history: as the state is reached in the plan, the contact forces of the displacements in each "
        "step hold every part; forces: contact forces inside the friction cones do."
    ),
]
Residual = Annotated[
    Annotated[float, Meta(ge=0)] | None,
    Meta(
        description="Largest acceleration of a part that these forces leave, as a share of gravity; an angular "
        "acceleration counts times the part's largest radius of gyration."
    ),
]


def _one_of(*names: str) -> dict[str, Any]:
    """Return what a schema says of an object, or null, that has exactly one of some entries."""
    return {"if": {"type": "object"}, "then": {"oneOf": [{"required": [name]} for name in names]}}


class SourceEntry(FileModel, frozen=True):
    """Where a structure came from, and what replaced its own description."""

    built_in: str | None = None
    """Name and parameters, such as arch:blocks=15."""
    path: str | None = None
    """Folder or file, relative to this file, with forward slashes."""
    unit: str | None = None
    """Unit of the meshes."""
    density: Positive | None = None
    """kg/m3, of every part."""
    friction: NotNegative | None = None
    boundary: tuple[int | str, ...] | None = None
    ground: bool = False
    """Whether a fixed ground was put under the lowest point."""
    interfaces: Literal["found", "stored", "compare"] | None = None
    """Source of the contacts: found from the meshes, or stored in the file."""
    settle: NotNegative | None = None
    """Largest motion with which parts settled into their clearance, m."""
    groups: tuple[tuple[int | str, ...], ...] | None = None
    """Groups of parts that are one part each, handled as one by robots; the part that is held comes first."""
    loads: tuple[LoadEntry, ...] | None = None
    earthquake: Earthquake | None = None
    """Pseudo-static horizontal acceleration along x, or along x and y, in shares of gravity."""


class StructureEntry(FileModel, frozen=True):
    """Structure of a plan."""

    name: str
    identity: str
    """Digest of geometry, boundary, density, friction and loads, as the structure gives it."""
    friction: NotNegative
    boundary: Parts
    """Parts that are fixed for ever."""
    parts: Annotated[tuple[str, ...], Meta(min_length=1)]
    """Names of all parts; steps and states refer to parts by their place in this list, from 0."""
    props: tuple[Prop, ...] = ()
    """Props, which are the last entries of parts: passive posts that a step inserts or removes and that need no
    robot."""
    source: Annotated[SourceEntry | None, Meta(extra_json_schema=_one_of("built_in", "path"))] = None
    """Where the structure came from: either built_in or path."""


class RulesEntry(FileModel, frozen=True):
    """Rules that the steps keep."""

    fixed: Parts
    """Parts that no step touches."""
    missing: Parts
    """Parts not delivered when the plan was made, which assembly does without as long as possible."""
    removable_only_if_clear: bool
    """Whether every part that is removed has a straight way out past the others."""
    support: bool = False
    """Whether parts that stand may be held again, and props inserted and removed."""
    props: Annotated[int, Meta(ge=0)] = 0
    """Props that may stand at a time."""
    parts_at_once: Annotated[int, Meta(ge=1)] = 1
    """Parts that a step may insert at most."""
    moves: Annotated[int, Meta(ge=1, le=MOST_MOVES)] = 1
    """Moves of a way out at most."""
    turns: bool = False
    """Whether parts may turn on their ways out."""
    waiting: bool = False
    """Whether parts that no robot holds may be carried aside on ways out, and wait there."""


RULE_FIELDS = dict(zip(RulesEntry.__struct_fields__, RulesEntry.__struct_fields__, strict=True)) | {
    "support": "allow_regrasp",
    "props": "prop_limit",
}
"""Fields of a plan by the entries of its rules."""


class HoldsEntry(FileModel, frozen=True):
    """What robots that hold parts can do."""

    stiffness: HoldStiffness | None
    """N/m; null for holds that never give way."""
    force: NotNegative | None
    """Largest force on a held part, N; null for no limit."""
    moment: Positive | None
    """Largest moment about the centre of mass of a held part, N m; null for no limit."""
    mode: HoldMode
    """What robots control while a part is released: the pose (they never press), the wrench of a part that they press,
    or its force along one direction and its pose across it."""


class StabilityEntry(FileModel, frozen=True):
    """What stable means."""

    criterion: Literal["contact", "equilibrium"]
    """contact: compliant contacts without prestress bring every part to rest; equilibrium: contact forces in balance
    exist."""
    stiffness_ratio: Annotated[float, Meta(gt=0)]
    """Tangential over normal stiffness of a contact, under the criterion contact."""
    cone: Literal["octagon", "quadratic"]
    """Friction cone."""
    gravity: Annotated[float, Meta(gt=0)]
    """m/s2 along -z."""
    tolerance: Annotated[float, Meta(gt=0)]
    """Largest residual of a stable state, a share of gravity."""
    force_bound: Annotated[float, Meta(gt=0)]
    """Bound on the sum of all normal forces, in weights of the structure."""
    reserve: Annotated[float, Meta(gt=0)]
    """Number by which friction is divided; under contact states come to rest with the true friction too."""
    holds: HoldsEntry | None = None
    """Robots that hold parts; under the criterion contact, and only there."""


Bears = Annotated[
    tuple[HoldLoad, ...],
    Meta(
        description="What robots bear in this state for the parts that they hold, the larger of what it is under the "
        "true friction and with the reserve; under the criterion contact only."
    ),
]


class StartEntry(FileModel, frozen=True):
    """State before the first step."""

    state: PartValues
    verdict: Word
    proof: ProofWord
    residual: Residual
    bears: Bears = ()


class MoveEntry(FileModel, frozen=True):
    """Move on the way out of a part: a straight line, a turn about an axis, or both at once, which is a screw."""

    direction: tuple[float, float, float]
    """Unit vector along the line or the axis."""
    distance: NotNegative
    """Along it, m."""
    angle: float | None = None
    """About it by the right-hand rule, rad; with point."""
    point: tuple[float, float, float] | None = None
    """On the axis, m."""
    parts: Parts | None = None
    """What moves, as one body, if not the inserted part alone: it, or others that robots hold and that go back when it
    is out."""


class StepEntry(FileModel, frozen=True):
    """Step of a plan, with the verdict on the state that it leads to."""

    do: Action
    """insert: bring a part to its place and hold it; release: let go of it; hold: hold a part that stands; remove: take
    a prop away."""
    part: Part
    verdict: Word
    proof: ProofWord
    residual: Residual
    parts: Annotated[Parts, Meta(min_length=2)] | None = None
    """All parts that the step inserts, part first, where they are several."""
    held: Annotated[int, Meta(ge=1)] | None = None
    """With parts: how many of them, from the first on, robots hold: all, or one, which carries the others."""
    exit_path: Annotated[tuple[MoveEntry, ...], Meta(max_length=MOST_MOVES)] = ()
    """Moves in which the inserted part would leave, where it has no straight way out: the step undoes them, the last
    one first."""
    presses: tuple[Press, ...] = ()
    """Robots that press on parts that they hold while this step releases a part."""
    bears: Bears = ()


class MeasuredEntry(FileModel, frozen=True):
    """Margins of every state in the order of the plan; null where there is no bound."""

    friction: Bounds = None
    """Least coefficient of friction."""
    tilt: tuple[Annotated[float, Meta(ge=0, le=np.pi / 2)] | None, ...] | None = None
    """rad."""
    horizontal: Bounds = None
    """Acceleration, in shares of gravity."""
    push: Bounds = None
    """Force on the weakest free face, N."""


class MarginsEntry(FileModel, frozen=True):
    """Margins that the states keep, in SI units."""

    demands: Demands
    measured: MeasuredEntry
    maximised: Literal["friction", "tilt", "horizontal", "push"] | None = None
    """Margin whose weakest step was made strongest."""
    bound: Annotated[float, Meta(ge=0, le=MOST)] | None = None
    """No plan has a weakest step stronger than this; null where none is known."""


class ReplayEntry(FileModel, frozen=True):
    """How the plan went when it was replayed with contact history."""

    stands: bool
    """Whether every state comes to rest."""
    moved: Annotated[float, Meta(ge=0)]
    """Largest movement of a part in a state that comes to rest, m."""
    part: Annotated[int, Meta(ge=-1)]
    """The part that moved that far, -1 if none moved."""
    falls_at: Count | None
    """First state that does not come to rest, from 0; null if all do."""
    varied: bool = False
    """Whether it also comes to rest under each of some changes of all settings: stiffness ratio, damping, release,
    stiffness of holds, initial friction, and presses that err."""
    judgement: Judgement | None = None


class DisplacementsEntry(FileModel, frozen=True):
    """Proof of every state under the criterion contact.

    Displacements (translation in m, rotation in rad) of every part about its centre of mass in the increments of the
    step that leads to the state.
    """

    parts: Annotated[int, Meta(ge=1)]
    increments: Annotated[int, Meta(ge=1, le=64)]
    """Increments of a step."""
    zlib_base64: Annotated[str, Meta(extra_json_schema={"contentEncoding": "base64"})]
    """Little-endian float64 of shape (states, increments, parts, 6), packed by zlib, in base64."""


class ForcesEntry(FileModel, frozen=True):
    """Proof of every state under the criterion equilibrium.

    Contact forces (normal, first and second tangent) in newtons at every contact point of the structure; of large plans
    only what changes from state to state.
    """

    points: Annotated[int, Meta(ge=0)]
    """Contact points."""
    zlib_base64: Annotated[str | None, Meta(extra_json_schema={"contentEncoding": "base64"})] = None
    """Little-endian float64 of shape (states, points, 3), packed by zlib."""
    changes_zlib_base64: Annotated[str | None, Meta(extra_json_schema={"contentEncoding": "base64"})] = None
    """For each state the number of points whose force is not that of the state before (of the first state: not zero),
    as little-endian uint32; then for one state after the other the numbers of these points, ascending, as uint32; then
    in the same order their forces, three float64 each. Packed by zlib."""


_UNPROVEN_ONLY_WITHOUT_PROOF = {
    "if": {"properties": {"verdict": {"const": "undecided"}}, "required": ["verdict"]},
    "then": {"properties": {"proof": {"const": "none"}, "residual": {"type": "null"}}},
    "else": {"properties": {"proof": {"enum": ["history", "forces"]}, "residual": {"type": "number"}}},
}
_SEVERAL = {"dependentRequired": {"parts": ["held"], "held": ["parts"]}}
_HELD_AGAIN_ONLY_WITH_SUPPORT = {
    "if": {"not": {"properties": {"rules": {"properties": {"support": {"const": True}}, "required": ["support"]}}}},
    "then": {"properties": {"steps": {"items": {"properties": {"do": {"enum": ["insert", "release"]}}}}}},
}


class PlanFile(FileModel, frozen=True):
    """Plan file."""

    format: Literal["falsework.plan/4"]
    structure: StructureEntry
    robots: Annotated[int, Meta(ge=1)]
    """Parts that can be held at once."""
    rules: RulesEntry
    stability: StabilityEntry
    start: Annotated[StartEntry, Meta(extra_json_schema=_UNPROVEN_ONLY_WITHOUT_PROOF)]
    steps: tuple[Annotated[StepEntry, Meta(extra_json_schema=_UNPROVEN_ONLY_WITHOUT_PROOF | _SEVERAL)], ...]
    """Actions in the order of assembly. Steps are numbered from 1."""
    end: PartValues
    """State that the steps lead to."""
    needs: tuple[PartDeadline, ...]
    """When each missing part is needed, the first needed first."""
    replay: ReplayEntry | None = None
    margins: MarginsEntry | None = None
    displacements: DisplacementsEntry | None = None
    forces: Annotated[ForcesEntry | None, Meta(extra_json_schema=_one_of("zlib_base64", "changes_zlib_base64"))] = None


def plan_schema() -> dict[str, Any]:
    """Return the JSON Schema (2020-12) of plan files."""
    about = (
        "The steps in which a structure of rigid parts is assembled, every state of it proven stable. Units are SI. "
        "Who takes the structure apart undoes the last step first."
    )
    return model_schema(PlanFile, "plan-4", "falsework plan, version 4", about) | _HELD_AGAIN_ONLY_WITH_SUPPORT
