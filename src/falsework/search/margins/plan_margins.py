"""Margins of the states of a plan, as plans and plan files carry them."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Literal, get_args

import numpy as np

from falsework.assembly.state import States
from falsework.search.margins.demands import Demands
from falsework.stability.margins.brackets import ACCURACY
from falsework.stability.margins.claims import MarginClaims
from falsework.stability.margins.state_margins import StateMargins
from falsework.stability.oracle import StabilityOracle
from falsework.utils.quantity import format_quantity

Measured = Literal["friction", "tilt", "horizontal", "push"]
MEASURED: tuple[Measured, ...] = get_args(Measured)
"""Margins that plans record as numbers."""


@dataclass(frozen=True, eq=False)
class PlanMargins:
    """Required margins of a plan, and the measured margins of each of its states."""

    demands: Demands
    measured: dict[str, tuple[float | None, ...]]
    """By kind, one entry a state in the order of the plan, SI units: `friction` the least coefficient, `tilt` in rad,
    `horizontal` in shares of gravity, `push` in N; None where there is no bound."""
    maximised: Measured | None = None
    """Margin whose weakest step was maximised."""
    bound: float | None = None
    """No plan has a weakest step stronger than this, in the units of `measured`; None where none is known."""

    @classmethod
    def from_oracle(
        cls, oracle: StabilityOracle, states: States, demands: Demands, also: Measured | None = None
    ) -> PlanMargins:
        """Measure the required margins, and one more.

        Args:
            states: of the plan, shape (states, parts).
            demands: margins required of the plan.
            also: another margin to measure.
        """
        kinds = [kind for kind in MEASURED if kind == also or getattr(demands, kind) is not None]
        return cls.from_states(oracle.margins(states, tuple(kinds)) if kinds else [], kinds, demands)

    @classmethod
    def from_states(
        cls, found: Sequence[StateMargins], kinds: Sequence[Measured] = MEASURED, demands: Demands = Demands()
    ) -> PlanMargins:
        """Take the margins of each state of a plan as they were measured, in the order of the plan.

        Args:
            found: one entry a state, each of which is stable by itself.
            demands: margins required of the plan.
        """
        measured: dict[str, tuple[float | None, ...]] = {}
        for kind in kinds:
            bounds = [getattr(margins, kind) for margins in found]
            measured[kind] = tuple(None if bound is None else bound.value for bound in bounds)
        return cls(demands, measured)

    def weakest(self, kind: str) -> tuple[int, float] | None:
        """Return the state with the weakest margin of a kind, and the margin; None where no state has a bound."""
        values = np.array([np.nan if value is None else value for value in self.measured.get(kind, ())], float)
        if not np.isfinite(values).any():
            return None
        row = int(np.nanargmax(values) if kind == "friction" else np.nanargmin(values))
        return row, float(values[row])

    def words(self, row: int, kind: str | None = None) -> str:
        """Describe the margins of a state, such as `friction 0.31, tilt 3.2 deg`, or one of them.

        Args:
            row: of the state, in the order of the plan.
            kind: of the margin; all that were measured if not given.
        """
        texts = []
        for name, values in self.measured.items():
            if kind not in (None, name):
                continue
            value, found = values[row], self.weakest(name)
            text = f"{name} without bound" if value is None else f"{name} {quantity_text(name, value)}"
            texts.append(f"{text} (weakest)" if found is not None and found[0] == row else text)
        return ", ".join(texts)

    def to_dict(self) -> dict[str, Any]:
        """Return the entry `margins` of a plan file."""
        rounded = {
            kind: [None if value is None else float(f"{value:.9g}") for value in values]
            for kind, values in self.measured.items()
        }
        record: dict[str, Any] = {"demands": self.demands.to_dict(), "measured": rounded}
        if self.maximised is not None:
            record |= {"maximised": self.maximised, "bound": self.bound}
        return record

    def overstated(self, oracle: StabilityOracle, states: States) -> tuple[int, str] | None:
        """Return the first state that is not stable at a recorded margin, and the reason; None if all are.

        Args:
            states: of the plan, in its order, shape (states, parts).
        """
        claims = MarginClaims(oracle.prober)
        for kind, values in self.measured.items():
            for row, value in enumerate(values):
                if not claims.holds(states[row], kind, value):
                    said = "without bound" if value is None else f"of {quantity_text(kind, value)}"
                    return row, f"does not stand at the recorded {kind} {said}"
        weakest = None if self.maximised is None or self.bound is None else self.weakest(self.maximised)
        if self.maximised is not None and self.bound is not None and weakest is not None:
            row, value = weakest
            stronger, weaker = (self.bound, value) if self.maximised == "friction" else (value, self.bound)
            if stronger > (1 + 3 * ACCURACY) * weaker:  # neither is more exact than that
                said = quantity_text(self.maximised, self.bound)
                return row, f"has a larger margin of {self.maximised} than {said}, which the plan says no plan has"
        return None


def quantity_text(kind: str, value: float) -> str:
    """Return a margin with its unit, such as `3.2 deg`."""
    kinds = {"friction": "factor", "tilt": "angle", "horizontal": "share of gravity", "push": "force"}
    return format_quantity(value, kinds[kind])
