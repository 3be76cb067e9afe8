"""Pictures of states and plans for the service, as PNG."""

from __future__ import annotations

import io
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.errors import PlanError
from falsework.search.plans.plan import Plan
from falsework.search.plans.plan_file import plan_from_dict
from falsework.stability.oracle import StabilityOracle


@dataclass(frozen=True)
class PictureOrder:
    """Contents of a picture, as a request gives them."""

    state: States
    """Drawn if there is no plan, shape (parts,)."""
    plan: dict[str, Any] | None
    """JSON values of a plan file."""
    step: int | None
    """State of the plan that is drawn; None for a contact sheet."""
    frames: int
    """States of a contact sheet."""
    proof: bool
    """Whether a single state is drawn with the proof of its verdict."""
    width: int | None
    """Pixels across each state; None for the default."""
    azimuth: float
    """Of the camera, degrees."""
    elevation: float
    """Of the camera, degrees."""


_UNSEEN = frozenset({"forces", "displacements"})
"""Entries of a plan that the service does not use; packed in a short text they may take any amount of memory."""


def draw_png(oracle: StabilityOracle, order: PictureOrder) -> bytes:
    """Draw one state, or the contact sheet of a plan.

    Args:
        oracle: of the structure; gives the proof.
        order: picture to draw.

    Raises:
        DependencyError: the extra `picture` is not installed.
        PlanError: the plan is malformed or of another structure.
        InputError: a step that the plan does not have.
    """
    from falsework.viewer.arrows import PRESSES, arrows_of_step
    from falsework.viewer.pictures.contact_sheet import (
        CELL,
        WHOLE,
        caption,
        check_places,
        contact_sheet,
        import_pillow,
        legend,
        one_state,
    )
    from falsework.viewer.pictures.render import Camera
    from falsework.viewer.proof import BuildProofs, proof_of_state
    from falsework.viewer.timeline import Timeline

    pillow = import_pillow()
    plan = None if order.plan is None else read_plan(order.plan, oracle.assembly)
    if plan is None:
        timeline = Timeline.from_state(oracle.assembly, order.state)
    else:
        timeline = Timeline.from_plan(plan, oracle.assembly)
    place = 0 if order.plan is None else order.step
    usual = CELL if place is None else WHOLE
    width = order.width or usual.width
    camera = Camera(order.azimuth, order.elevation, width, round(width * usual.height / usual.width), usual.zoom)
    if place is None:
        pixels = contact_sheet(timeline, frames=order.frames, camera=camera)
    else:
        check_places(timeline, [place])
        row, proof = timeline.row(place), None
        if order.proof and plan is not None and oracle.settings.criterion == "contact":
            proof = BuildProofs(plan, oracle).at(row)
        elif order.proof:
            proof = proof_of_state(oracle, timeline.states[row])
        drawn = arrows_of_step(timeline, place) | ({} if proof is None else proof.arrows)
        shown = {kind: some for kind, some in drawn.items() if len(some)}
        key = legend(timeline, pressing=PRESSES in shown)
        if proof is not None and shown:
            key = [(some.color, kind) for kind, some in shown.items()]
        pixels = one_state(
            timeline,
            place,
            camera,
            arrows=list(shown.values()),
            key=key,
            words=caption(timeline, place, proof),
            marks=None if proof is None else proof.marks,
        )
    file = io.BytesIO()
    pillow.Image.fromarray(pixels).save(file, format="PNG", optimize=True)
    return file.getvalue()


def read_plan(values: Mapping[str, Any], assembly: Assembly) -> Plan:
    """Return the plan of a request, whose states take as much memory as its number of parts says.

    Raises:
        PlanError: it is malformed or of another number of parts.
    """
    structure = values.get("structure")
    names = structure.get("parts") if isinstance(structure, dict) else None
    if isinstance(names, list) and len(names) != assembly.part_count:
        raise PlanError(
            f"the plan is of {len(names)} parts, {assembly.name} has {assembly.part_count}; send a plan of this service"
        )
    return plan_from_dict({key: value for key, value in values.items() if key not in _UNSEEN})
