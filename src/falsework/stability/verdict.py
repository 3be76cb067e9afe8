"""Stability verdicts and their proofs."""

from __future__ import annotations

from dataclasses import dataclass, replace
from enum import IntEnum
from functools import cache
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
from numpy.typing import NDArray

from falsework.utils.display.notebook import Displayed
from falsework.utils.quantity import counted

if TYPE_CHECKING:
    from falsework.assembly.model import Assembly
    from falsework.assembly.state import States

Criterion = Literal["contact", "equilibrium"]
"""`equilibrium`: some admissible contact forces balance gravity (the paper's). `contact`: parts come to rest on
compliant contacts without prestress."""


class Verdict(IntEnum):
    """Stability of a partial structure."""

    TIPS = -3
    """Rest position that a small motion leaves, such as a cube on its edge: an unstable equilibrium. Only under the
    criterion `contact`; it counts as not stable."""
    SLIDES = -2
    """Forces in equilibrium exist, but no displacement was found that produces them: the iterations follow parts
    that move away. Only under the criterion `contact`; it counts as not stable."""
    UNSTABLE = -1
    UNDECIDED = 0
    STABLE = 1

    def __str__(self) -> str:
        return self.name.lower()

    def __format__(self, form: str) -> str:
        return format(int(self), form) if form else str(self)

    @property
    def words(self) -> str:
        """What a structure with this verdict does."""
        return {
            Verdict.TIPS: "tips, as its equilibrium is unstable",
            Verdict.SLIDES: "slides",
            Verdict.UNSTABLE: "is unstable",
            Verdict.UNDECIDED: "could be proved neither stable nor unstable",
            Verdict.STABLE: "is stable",
        }[self]


class Proof(IntEnum):
    """Kind of proof behind a verdict."""

    NONE = 0
    FORCES = 1
    """Contact forces inside the friction cones that balance every part (stable)."""
    VELOCITY = 2
    """A virtual velocity that no admissible forces can stop (unstable)."""
    DISPLACEMENT = 3
    """A displacement whose contact forces balance every part (stable from rest under the criterion `contact`)."""
    HISTORY = 5
    """Displacements in the steps of a build whose contact forces balance every part (stable as built)."""
    MOTION = 4
    """Such a displacement, and a motion from there that grows (`growth_of_motion`)."""


class Solver(IntEnum):
    """Solver that found a proof."""

    NONE = 0
    CPU = 1
    GPU = 2
    EXACT = 3
    RULE = 4
    """A proof of another state that holds for this one: the two monotonicity rules of the cache."""
    SHARED_INVERSE = 5
    """The paper's method, which proves nothing."""


@dataclass(frozen=True, eq=False)
class Verdicts(Displayed):
    """Verdicts of a batch of states."""

    verdict: NDArray[np.int8]
    """`Verdict` of each state, shape (batch,)."""
    proof: NDArray[np.int8]
    """`Proof` of each state, shape (batch,)."""
    residual: NDArray[np.float64]
    """Largest acceleration of a part as a share of gravity, angular acceleration times the part's largest radius
    of gyration: shape (batch,). Stable: left by the forces, at most the tolerance; unstable: a lower bound for all
    admissible forces, above the tolerance unless `on_tolerance`."""
    iterations: NDArray[np.int32]
    """Iterations of the solver that decided, shape (batch,)."""
    decided_by: NDArray[np.int8]
    """`Solver` of each state, shape (batch,)."""
    on_tolerance: NDArray[np.bool_]
    """Whether the verdict depends on the tolerance, shape (batch,). That of an unstable state does where the bound that
    is proven on the residual is not above the tolerance, that of a stable one where neither forces were found whose
    residual is well below it, nor a proof that there are none."""
    forces: NDArray[np.float64] | None = None
    """Contact forces `(n, t1, t2)` in N, shape (batch, points, 3); only meaningful where stable or sliding."""
    velocity: NDArray[np.float64] | None = None
    """Virtual velocity `(linear, angular)` about the centres of mass, shape (batch, parts, 6); only meaningful
    where unstable. Where a state tips, the motion that grows."""
    displacement: NDArray[np.float64] | None = None
    """Displacement `(translation, rotation)` of the parts about their centres of mass in m and rad, shape
    (batch, parts, 6); only under the criterion `contact`. Stable, or tips: rest position; sliding: position at which
    parts were seen to move away, which shows the moving parts and their directions; otherwise meaningless."""
    assembly: Assembly | None = None
    """Structure of the states, where `StabilityOracle.check` was asked; notebooks draw it."""
    states: States | None = None
    """The states, shape (batch, parts), where `StabilityOracle.check` was asked."""

    @classmethod
    def all_undecided(
        cls, batch: int, *, points: int | None = None, parts: int | None = None, displaced: bool = False
    ) -> Verdicts:
        """Return undecided verdicts to be filled in.

        Args:
            points: number of contact points, if forces are to be stored.
            parts: number of parts, if velocities are to be stored.
            displaced: whether displacements are to be stored too.
        """
        return cls(
            verdict=np.zeros(batch, np.int8),
            proof=np.zeros(batch, np.int8),
            residual=np.full(batch, np.nan),
            iterations=np.zeros(batch, np.int32),
            decided_by=np.zeros(batch, np.int8),
            on_tolerance=np.zeros(batch, bool),
            forces=None if points is None else np.zeros((batch, points, 3)),
            velocity=None if parts is None else np.zeros((batch, parts, 6)),
            displacement=np.zeros((batch, parts, 6)) if displaced and parts is not None else None,
        )

    @property
    def kinds(self) -> tuple[Verdict, ...]:
        """`Verdict` of each state, which prints as a word such as `stable`."""
        return tuple(map(Verdict, self.verdict.tolist()))

    @property
    def stable(self) -> NDArray[np.bool_]:
        """Whether each state is stable, shape (batch,)."""
        return self.verdict == Verdict.STABLE

    @property
    def unstable(self) -> NDArray[np.bool_]:
        """Whether each state is unstable, shape (batch,)."""
        return self.verdict == Verdict.UNSTABLE

    @property
    def slides(self) -> NDArray[np.bool_]:
        """Whether each state slides, shape (batch,)."""
        return self.verdict == Verdict.SLIDES

    @property
    def tips(self) -> NDArray[np.bool_]:
        """Whether each state tips, shape (batch,)."""
        return self.verdict == Verdict.TIPS

    @property
    def undecided(self) -> NDArray[np.bool_]:
        """Whether each state is undecided, shape (batch,)."""
        return self.verdict == Verdict.UNDECIDED

    @property
    def depends_on_path(self) -> NDArray[np.bool_]:
        """Whether each state may stand as it is built though not from rest: it slides, or is undecided, (batch,)."""
        return self.slides | self.undecided

    def __len__(self) -> int:
        return len(self.verdict)

    def __repr__(self) -> str:
        counts = ((int((self.verdict == kind).sum()), kind.name.lower()) for kind in Verdict)
        found = ", ".join(f"{count} {name}" for count, name in counts if count)
        return f"<Verdicts of {counted(len(self), 'state')}{found and f': {found}'}>"

    def __getitem__(self, index: int | slice | NDArray) -> Verdicts:
        """Return verdicts of selected states, as a batch."""
        if isinstance(index, (int, np.integer)):
            index = np.arange(len(self))[[index]]
        picked: dict[str, Any] = {
            name: None if array is None else array[index] for name, array in self._arrays().items()
        }
        states = None if self.states is None else self.states[index]
        return Verdicts(**picked, assembly=self.assembly, states=states)

    def put(self, rows: NDArray, other: Verdicts) -> None:
        """Overwrite the verdicts of some states."""
        given = other._arrays()
        for name, mine in self._arrays().items():
            if mine is not None and (theirs := given[name]) is not None:
                mine[rows] = theirs

    def without_certificates(self) -> Verdicts:
        """Return the same verdicts without forces, velocity and displacement."""
        return replace(self, forces=None, velocity=None, displacement=None)

    def _arrays(self) -> dict[str, Any]:
        """Return the arrays with one entry a state, but the states themselves; None for those that are absent."""
        return {name: value for name, value in vars(self).items() if name not in ("assembly", "states")}


def proof_of(verdict: NDArray[np.int8], criterion: Criterion = "equilibrium") -> NDArray[np.int8]:
    """Return the kind of proof of each verdict; for `SLIDES` the forces that prove equilibrium."""
    return _proofs(criterion)[verdict.astype(np.intp) - min(Verdict)]


@cache
def _proofs(criterion: Criterion) -> NDArray[np.int8]:
    """Return the kind of proof by verdict, starting from the least verdict."""
    by_verdict = {Verdict.UNSTABLE: Proof.VELOCITY, Verdict.STABLE: Proof.FORCES}
    if criterion == "contact":
        by_verdict |= {
            Verdict.TIPS: Proof.MOTION,
            Verdict.SLIDES: Proof.FORCES,
            Verdict.STABLE: Proof.DISPLACEMENT,
        }
    return np.array([by_verdict.get(kind, Proof.NONE) for kind in sorted(Verdict)], dtype=np.int8)
