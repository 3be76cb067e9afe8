"""Computations of the Grasshopper components, without Grasshopper."""

from __future__ import annotations

import hashlib
import tempfile
import weakref
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from falsework_client.errors import ClientError
from falsework_client.rhino import blocks_of
from falsework_client.structure import HELD, REMOVED, Plan, Structure, shared_structure

_plans: weakref.WeakKeyDictionary[Structure, dict[int, Plan]] = weakref.WeakKeyDictionary()
"""Plans by structure and number of robots, so that a slider of steps does not plan again."""


@dataclass(frozen=True)
class StabilityOracle:
    """Outputs of the component Stability."""

    stable: bool
    verdict: str
    """The verdict and what falsework remarks on the blocks, a line each."""
    moving: list[Any]
    """Geometry that moves, the fastest first."""
    picture: str | None
    """Path of a PNG."""


@dataclass(frozen=True)
class Assembly:
    """Outputs of the component Plan."""

    outcome: str
    """`found`, or why there is no plan."""
    steps: list[str]
    """A line a step."""
    placed: list[Any]
    """Geometry that stands by itself after the step, supports included."""
    held: list[Any]
    """Geometry that is held after the step."""
    picture: str | None
    """Path of a PNG."""


def judge(
    blocks: Sequence[Any] | None,
    supports: Sequence[Any] | None,
    *,
    unit: str,
    friction: float | None = None,
    density: float | None = None,
    draw: bool = False,
) -> StabilityOracle:
    """Return the verdict on the complete structure.

    Args:
        blocks: Rhino geometry.
        supports: Rhino geometry that is fixed for ever.
        unit: of the coordinates.
        friction: coefficient of friction of every contact.
        density: kg/m3.
        draw: whether the picture is made.

    Raises:
        ClientError: no structure, or no service for it; one line.
    """
    structure, items = _open(blocks, supports, unit, friction, density)
    verdict = structure.stability()
    lines = [verdict.verdict + ("" if verdict.stable else f": {len(verdict.moving)} blocks move")]
    picture = _saved(structure.picture(proof=True)) if draw else None
    return StabilityOracle(
        verdict.stable, "\n".join([*lines, *structure.warnings]), [items[part] for part in verdict.moving], picture
    )


def assemble(
    blocks: Sequence[Any] | None,
    supports: Sequence[Any] | None,
    *,
    unit: str,
    robots: int | None = None,
    step: int | None = None,
    friction: float | None = None,
    density: float | None = None,
    draw: bool = False,
) -> Assembly:
    """Return a plan that assembles the structure, and its state after a step.

    Args:
        blocks: Rhino geometry.
        supports: Rhino geometry that is fixed for ever.
        unit: of the coordinates.
        robots: parts that can be held at a time; 2 if None.
        step: that is shown, 0 for the beginning; the end if None.
        friction: coefficient of friction of every contact.
        density: kg/m3.
        draw: whether the picture is made: of the step, or of the whole plan without one.

    Raises:
        ClientError: no structure, or no service for it; one line.
    """
    structure, items = _open(blocks, supports, unit, friction, density)
    hands = 2 if robots is None else int(robots)
    known = _plans.setdefault(structure, {})
    plan = known.get(hands) or structure.plan(robots=hands)
    if plan.outcome != "not_yet":  # more time may find one
        known[hands] = plan
    if not plan.found:
        return Assembly(f"{plan.outcome}: {plan.reason}", [], [], [], None)
    last = len(plan.steps)
    place = last if step is None else min(max(int(step), 0), last)
    state = plan.state_after(place)
    first = len(blocks or ())
    held = [part for part in range(first) if state[part] == HELD]
    placed = [part for part in range(len(items)) if state[part] != REMOVED and part not in held]
    lines = [f"{number}: {done.words}" for number, done in enumerate(plan.steps, 1)]
    picture = _saved(structure.picture(plan=plan.plan, step=None if step is None else place)) if draw else None
    outcome = f"found, without a reserve: {plan.reason}" if plan.reason else "found"
    return Assembly(outcome, lines, [items[part] for part in placed], [items[part] for part in held], picture)


def _open(
    blocks: Sequence[Any] | None,
    supports: Sequence[Any] | None,
    unit: str,
    friction: float | None,
    density: float | None,
) -> tuple[Structure, list[Any]]:
    """Return the structure, and the geometry of each part."""
    if not blocks or not supports:
        raise ClientError(f"no {'supports' if blocks else 'blocks'}; connect at least one")
    structure = shared_structure(blocks_of(blocks, supports), unit=unit, friction=friction, density=density)
    return structure, [*blocks, *supports]


def _saved(picture: bytes) -> str:
    """Write a picture where others of the same content are, and return its path."""
    folder = Path(tempfile.gettempdir()) / "falsework-pictures"
    path = folder / f"{hashlib.sha256(picture).hexdigest()[:16]}.png"
    try:
        folder.mkdir(exist_ok=True)
        path.write_bytes(picture)
    except OSError as error:
        raise ClientError(f"cannot write {path}: {error.strerror or error}; free it, or do not draw") from None
    return str(path)
