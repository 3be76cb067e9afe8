"""Margins of a state, each with a certificate on both sides of its bound."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from falsework.stability.margins.conditions import Condition
from falsework.stability.verdict import Verdict, Verdicts
from falsework.utils.quantity import format_quantity

Array = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class Bound:
    """Bound of a family of conditions, proven from both sides."""

    value: float | None
    """Last value at which the state is proven stable; None where there is no bound."""
    outside: float | None
    """First value at which it is not stable, within 1 %; None where there is none."""
    inside_proof: Verdicts
    """Verdict under `inside_condition`, a batch of one, with its certificate."""
    outside_proof: Verdicts | None
    """Verdict at `outside`: unstable, or sliding under `contact`; undecided where nothing could be proven."""
    inside_condition: Condition
    """Friction and loads at `value`; where there is no bound, at the largest value that is tried, of the first load."""
    outside_condition: Condition | None
    monotone: bool = True
    """Whether the state is stable at all values probed from its own to the bound: a theorem under `equilibrium`, not
    under `contact`, where the bound is the one before the first failing value."""
    part: int | None = None
    """Part that the weakest load of the family acts on."""
    direction: tuple[float, float, float] | None = None
    """Direction of the weakest load."""
    finished: bool = True
    """Whether the search ended before the deadline. If not, `value` is what has been proven so far, with any load of
    the family, and `outside` may be far from it, without proof, or None."""

    @property
    def proven(self) -> bool:
        """Whether certificates on both sides, as far as there is a bound, were accepted."""
        failed = self.outside_proof is None or self.outside_proof.verdict[0] in (Verdict.UNSTABLE, Verdict.SLIDES)
        return bool(self.inside_proof.stable[0]) and failed and self.finished


@dataclass(frozen=True)
class HeldLoad:
    """Force and moment that a robot exerts on a part that it holds, according to the certificate of the state."""

    part: int
    force: tuple[float, float, float]
    """Force of the robot on the part, N."""
    moment: tuple[float, float, float]
    """Moment about the centre of mass of the part, Nm."""

    @property
    def force_n(self) -> float:
        """Magnitude of the force, N."""
        return float(np.linalg.norm(self.force))

    @property
    def moment_nm(self) -> float:
        """Magnitude of the moment, Nm."""
        return float(np.linalg.norm(self.moment))


@dataclass(frozen=True, eq=False)
class StateMargins:
    """Margins of one state; those that were not requested are None."""

    stands: bool
    """Whether the unmodified state is stable. If not, only `friction` may be given; `to_dict` has 0 for the rest."""
    kinds: tuple[str, ...] = ()
    """Margins that were requested."""
    friction: Bound | None = None
    """Least coefficient of friction, with those of joints in proportion; 0 where the state is stable without friction,
    None where joints have friction but the structure has none."""
    tilt: Bound | None = None
    """Largest tilt of the ground in the worst direction, rad; loads other than weight keep their direction."""
    horizontal: Bound | None = None
    """Largest horizontal acceleration in the worst direction, shares of gravity."""
    load_factor: Bound | None = None
    """Largest factor on the weight of a single part, for the weakest part."""
    total_load_factor: Bound | None = None
    """Largest factor on the weight of all parts."""
    push: Bound | None = None
    """Largest force on a free face of a part along its normal, for the weakest face, N."""
    held: tuple[HeldLoad, ...] = ()
    """One entry for each part that a robot holds."""
    polygon: Array | None = None
    """Largest tilt in each of 36 directions from x to y, rad; infinite where there is no bound. Shape (36,)."""
    settlement: tuple[tuple[int, float | None], ...] = ()
    """Boundary parts with their largest settlement, m; None where there is no bound."""
    unfinished: tuple[str, ...] = ()
    """Margins that a deadline cut short: those with a value have what has been proven so far."""

    def __repr__(self) -> str:
        units = {"friction": "factor", "tilt": "angle", "horizontal": "share of gravity", "push": "force"}
        bounds = {kind: getattr(self, kind, None) for kind in self.kinds}
        known = {kind: bound.value for kind, bound in bounds.items() if isinstance(bound, Bound)}
        words = [f"{k} {format_quantity(v, units.get(k, 'factor'))}" for k, v in known.items() if v is not None]
        return f"<StateMargins: {', '.join(words)}>" if self.stands else "<StateMargins: does not stand>"

    def to_dict(self, names: tuple[str, ...]) -> dict[str, Any]:
        """Return the margins as a JSON object: those that were requested, null where there is no bound.

        For those that a deadline cut short, `fails_at` has values at which the state fails, without proof.
        """
        data: dict[str, Any] = {"stands": self.stands}
        fails: dict[str, float] = {}
        for kind, key, bound, scale in (
            ("friction", "friction", self.friction, 1.0),
            ("tilt", "tilt_deg", self.tilt, 180.0 / np.pi),
            ("load_factor", "load_factor", self.load_factor, 1.0),
            ("load_factor", "total_load_factor", self.total_load_factor, 1.0),
            ("horizontal", "horizontal_g", self.horizontal, 1.0),
            ("push", "push_n", self.push, 1.0),
        ):
            if kind in self.kinds:
                value = None if bound is None or bound.value is None else bound.value * scale
                data[key] = value if self.stands or key == "friction" else 0.0
                if bound is not None and not bound.finished and bound.outside is not None:
                    fails[key] = bound.outside * scale
        if "push" in self.kinds:
            data["push_part"] = None if self.push is None else self.push.part
            data["push_name"] = None if self.push is None or self.push.part is None else names[self.push.part]
        if "load_factor" in self.kinds:
            data["load_part"] = None if self.load_factor is None else self.load_factor.part
        if "held" in self.kinds:
            data["held"] = [
                {"part": load.part, "name": names[load.part], "force_n": load.force_n, "moment_nm": load.moment_nm}
                | {"force_xyz_n": list(load.force), "moment_xyz_nm": list(load.moment)}
                for load in self.held
            ]
        if self.polygon is not None:
            degrees = np.degrees(self.polygon)
            data["tilt_polygon_deg"] = [angle if np.isfinite(angle) else None for angle in degrees.tolist()]
        if self.settlement:
            data["settlement_m"] = {names[part]: depth for part, depth in self.settlement}
        bounds = [self.friction, self.tilt, self.horizontal, self.load_factor, self.total_load_factor, self.push]
        given = [bound for bound in bounds if bound is not None]
        data["proven"] = all(bound.proven for bound in given)
        data["monotone"] = all(bound.monotone for bound in given)
        if self.unfinished:
            data["proven"] = False
            data["unfinished"], data["fails_at"] = list(self.unfinished), fails
        return data


def triple(values: Array) -> tuple[float, float, float]:
    """Return three numbers as a tuple."""
    return float(values[0]), float(values[1]), float(values[2])
