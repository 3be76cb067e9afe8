"""Margins that every state of a plan must keep, and an oracle that checks them."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import replace
from functools import cached_property
from typing import Annotated

import numpy as np
from msgspec import Meta, to_builtins
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.assembly_model import MOST
from falsework.assembly.loads import Loads
from falsework.assembly.model import Assembly
from falsework.assembly.state import INSTALLED, States, as_states
from falsework.errors import InputError
from falsework.stability.margins.conditions import Answer, Condition
from falsework.stability.margins.placement import check_detectable, moved_assembly
from falsework.stability.margins.pushes import Pushes
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings
from falsework.stability.verdict import Verdict, Verdicts
from falsework.utils.models import FileModel
from falsework.utils.quantity import format_number, parse_quantity

_KINDS: dict[str, str] = {
    "friction": "factor",
    "tilt": "angle",
    "horizontal": "share of gravity",
    "push": "force",
    "load": "force",
    "placement": "length",
}
STEEPEST = math.radians(80)
"""Tilt that is too steep to be demanded, rad."""
Limit = Annotated[float, Meta(gt=0, le=MOST)] | None
_CORNERS = 8
"""Horizontal directions that are checked, each so far out that their polygon encloses the required circle: if a state
is stable at all of them, under `equilibrium` it is in every direction."""
_DRAWS = 8
"""Random placements in each of which every state must be stable."""


class Demands(FileModel, frozen=True):
    """Margins that every state of a plan must keep; None where nothing is required."""

    friction: Annotated[float, Meta(ge=1, le=MOST)] | None = None
    """Factor of safety: states are stable with all coefficients of friction, those of joints too, divided by it."""
    tilt: Annotated[float, Meta(gt=0, lt=STEEPEST)] | None = None
    """Tilt of the ground in any direction, rad."""
    horizontal: Limit = None
    """Horizontal acceleration in any direction, shares of gravity."""
    push: Limit = None
    """Force along the inward normal of any free face of an installed part, N."""
    load: Limit = None
    """Force downwards on any installed part at its centre of mass, such as a worker's or a gripper's, N."""
    placement: Limit = None
    """Error of placement in m; states are stable in each of some random placements with contacts found anew."""

    @classmethod
    def from_text(cls, text: str) -> Demands:
        """Read demands such as `friction=1.25,tilt=2deg,push=20N,placement=1mm`.

        Raises:
            InputError: a margin that does not exist or is given twice, or a quantity that cannot be used.
        """
        given: dict[str, float] = {}
        for item in text.split(","):
            name, equals, quantity = (piece.strip() for piece in item.partition("="))
            if not equals or name not in _KINDS:
                wrong = f"there is no margin {name!r}" if equals else f"{item.strip()!r} is no margin with its quantity"
                raise InputError(f"--margin: {wrong}; give {', '.join(f'{key}=...' for key in _KINDS)}")
            if name in given:
                raise InputError(f"--margin {text}: {name} is given twice; give it once")
            given[name] = parse_quantity(quantity, _KINDS[name], f"--margin {name}")
            _check_range(name, given[name], f"--margin {name}")
        return cls(**given)

    def to_dict(self) -> dict[str, float]:
        """Return the required margins, in SI units."""
        return to_builtins(self)

    def __bool__(self) -> bool:
        return bool(self.to_dict())

    def __str__(self) -> str:
        words = {
            "tilt": lambda v: f"{format_number(np.degrees(v), 4)}deg",
            "placement": lambda v: f"{format_number(v * 1e3, 4)}mm",
        }
        units = {"horizontal": "g", "push": "N", "load": "N", "friction": ""}
        return ", ".join(
            f"{key}={words[key](value) if key in words else f'{format_number(value, 4)}{units[key]}'}"
            for key, value in self.to_dict().items()
        )

    def variants(self, assembly: Assembly) -> list[tuple[str, Assembly]]:
        """Return the structures in which states must be stable too, each with the margin that requires it.

        Raises:
            InputError: displaced parts that make no assembly, or contacts that were given, which cannot be detected
                again for them, or joints with friction in a structure without.
        """
        found: list[tuple[str, Assembly]] = []
        if self.friction is not None and not assembly.has_common_friction:
            raise InputError(
                "only joints have friction, so a factor has no coefficient to divide; set --friction above 0"
            )
        if self.friction is not None and self.friction > 1.0:
            found.append(("friction", assembly.at_friction(assembly.friction / self.friction)))
        angle = 2 * np.pi * np.arange(_CORNERS) / _CORNERS
        outwards = np.stack([np.cos(angle), np.sin(angle), np.zeros(_CORNERS)], axis=1)
        if self.tilt is not None:
            tilt = np.arctan(np.tan(self.tilt) / np.cos(np.pi / _CORNERS))
            turned = np.sin(tilt) * outwards + [0, 0, 1 - np.cos(tilt)]
            found += [("tilt", _accelerated(assembly, vector)) for vector in turned]
        if self.horizontal is not None:
            pulled = self.horizontal / np.cos(np.pi / _CORNERS) * outwards
            found += [("horizontal", _accelerated(assembly, vector)) for vector in pulled]
        if self.placement is not None:
            check_detectable(assembly)
            random = np.random.default_rng(0)
            for _ in range(_DRAWS):
                moved = moved_assembly(assembly, self.placement, random)
                if moved is None:
                    raise InputError(
                        f"parts placed within {self.placement * 1e3:g} mm lose their contacts or run into each other; "
                        "demand a smaller error of placement"
                    )
                found.append(("placement", moved))
        return found


class MarginOracle(StabilityOracle):
    """Stability oracle for searches in which states must keep margins, which count from the true friction.

    `verdicts`, as searches ask, counts a state that does not keep them as sliding, or as unstable where a velocity
    proves it; with certificates, it proves states as they are. Pushes and loads on single parts are checked near the
    parts in which a state differs from a near one, which keeps the margins; `keeps` checks all of them.
    """

    def __init__(
        self, assembly: Assembly, settings: StabilitySettings = StabilitySettings(), demands: Demands = Demands()
    ) -> None:
        super().__init__(assembly, settings)
        self.demands = demands
        self.premises |= {"demands": demands.to_dict()}
        true = replace(settings, reserve=1.0)
        self._variants = [(name, StabilityOracle(changed, true)) for name, changed in demands.variants(assembly)]
        self._known: dict[bytes, int] = {}
        self._start: tuple[bytes, Answer] | None = None
        near = np.eye(assembly.part_count, dtype=bool)
        first, second = assembly.contacts.parts.T
        near[first, second] = near[second, first] = True
        self._near = near

    @cached_property
    def _pushes(self) -> Pushes:
        return Pushes.from_assembly(self.assembly)

    def verdicts(
        self, states: ArrayLike, *, near: ArrayLike | None = None, require_certificate: bool = False
    ) -> Verdicts:
        """Return verdicts on states; without certificates, those that do not keep the margins do not count as stable.

        Arguments and errors as for `StabilityOracle.verdicts`.
        """
        batch = as_states(states, self.assembly.boundary)
        origins = None if near is None else as_states(near, self.assembly.boundary)
        verdicts = super().verdicts(batch, near=origins, require_certificate=require_certificate)
        if require_certificate or not self.demands:
            return verdicts
        known = [self._known.get(state.tobytes()) for state in batch]
        stable = np.flatnonzero(verdicts.stable).tolist()
        rows = np.array([row for row in stable if known[row] is None], int)
        for row in stable:
            verdicts.verdict[row] = self._known.get(batch[row].tobytes(), Verdict.STABLE)
        if len(rows):
            found = self._ask(batch[rows], None if origins is None else origins[rows], everywhere=False)
            self._known |= {batch[row].tobytes(): value for row, value in zip(rows, found.tolist(), strict=True)}
            verdicts.verdict[rows] = found
        return verdicts

    def plausible(self, states: States, parents: States) -> NDArray[np.bool_]:
        """Return which states a replay may find at rest, and keep the margins; see `StabilityOracle.plausible`."""
        found = super().plausible(states, parents)
        rows = np.flatnonzero(found)
        if self.demands and len(rows):
            found[rows] = self._ask(states[rows], parents[rows], everywhere=False) == Verdict.STABLE
        return found

    def keeps(self, states: ArrayLike) -> NDArray[np.bool_]:
        """Return whether states keep the margins at every part. Shape (batch,)."""
        batch = as_states(states, self.assembly.boundary)
        found = self._ask(batch, None, everywhere=True)
        self._known |= {state.tobytes(): value for state, value in zip(batch, found.tolist(), strict=True)}
        return found == Verdict.STABLE

    def broken(self, state: States) -> str:
        """Return the first margin that a state does not keep, with the load that violates it; empty if it keeps all."""
        for name, oracle in self._variants:
            if not oracle.verdicts(state[None]).stable[0]:
                return str(Demands(**{name: getattr(self.demands, name)}))
        for name, part, normal, load in self._single(state, None):
            if not self._answer(state, load).stands:
                where = f" on part {self.assembly.names[part]}"
                towards = "" if name == "load" else f" towards ({', '.join(f'{x:.2f}' for x in normal)})"
                return f"{Demands(**{name: getattr(self.demands, name)})}{where}{towards}"
        return ""

    def _ask(self, states: States, parents: States | None, *, everywhere: bool) -> NDArray[np.int8]:
        """Return `STABLE` if all margins are kept, `UNSTABLE` if it is proven that one is not, else `SLIDES`."""
        found = np.full(len(states), Verdict.STABLE, np.int8)
        for name, oracle in self._variants:
            rows = np.flatnonzero(found == Verdict.STABLE)
            if not len(rows):
                break
            verdicts = oracle.verdicts(states[rows], near=None if parents is None else parents[rows])
            # Tilts and accelerations are checked a little further out than required: no proof that they fail.
            failed = np.where(verdicts.unstable & (name == "friction"), Verdict.UNSTABLE, Verdict.SLIDES)
            found[rows] = np.where(verdicts.stable, Verdict.STABLE, failed)
        if self.demands.push is None and self.demands.load is None:
            return found
        for row in np.flatnonzero(found == Verdict.STABLE):
            looked_at = None
            if parents is not None and not everywhere:
                looked_at = np.asarray(self._near[states[row] != parents[row]].any(axis=0))
            for *_, load in self._single(states[row], looked_at):
                answer = self._answer(states[row], load)
                if not answer.stands:
                    found[row] = Verdict.SLIDES if answer.velocity is None else Verdict.UNSTABLE
                    break
        return found

    def _single(
        self, state: States, parts: NDArray[np.bool_] | None
    ) -> list[tuple[str, int, Sequence[float], NDArray[np.float64]]]:
        """Return the loads on single parts, of some parts or of all: name, part, direction, wrenches."""
        found: list[tuple[str, int, Sequence[float], NDArray[np.float64]]] = []
        chosen = (state == INSTALLED) & (True if parts is None else parts)
        if self.demands.load is not None:
            for part in np.flatnonzero(chosen).tolist():
                load = np.zeros((len(state), 6))
                load[part, 2] = -self.demands.load
                found.append(("load", part, (0.0, 0.0, -1.0), load))
        if self.demands.push is not None:
            rows = self._pushes.exposed(state)
            rows = rows[chosen[self._pushes.part[rows]]]
            loads = self.demands.push * self._pushes.loads(rows, len(state))
            found += [
                ("push", int(self._pushes.part[row]), self._pushes.normal[row].tolist(), load)
                for row, load in zip(rows, loads, strict=True)
            ]
        return found

    def _answer(self, state: States, load: NDArray[np.float64]) -> Answer:
        key = state.tobytes()
        if self._start is None or self._start[0] != key:
            self._start = key, self.prober.ask(state, self.prober.own())
        return self.prober.ask(state, Condition(self.assembly.friction, load), self._start[1])


def _check_range(name: str, value: float, place: str) -> None:
    """Refuse a margin that no number of its kind can mean; a tilt of a whole turn would be none."""
    if name == "friction" and value < 1.0:
        raise InputError(f"{place}={value:g}: a factor of safety is at least 1")
    if name == "tilt" and value >= STEEPEST:
        raise InputError(f"{place}: {np.degrees(value):g} degrees is too steep; give less")
    if value > MOST:
        raise InputError(f"{place}={value:g}: no state keeps that; give at most {MOST:g}")


def _accelerated(assembly: Assembly, vector: NDArray[np.float64]) -> Assembly:
    own = assembly.loads or Loads.from_arrays(assembly.part_count)
    loads = Loads.from_arrays(assembly.part_count, wrench=own.wrench, acceleration=own.acceleration + vector)
    return replace(assembly, loads=loads)  # in this form also where parts are joined
