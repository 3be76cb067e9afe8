"""Discrete-element method with explicit dynamic relaxation, as an independent stability check.

Rigid parts touch at the contact points of the structure through normal springs without tension and tangential springs
with Coulomb friction, whose force is incremental and so depends on the slip history (Cundall and Strack 1979). Local
damping dissipates energy until the parts come to rest or move away (Cundall 1987). Displacements are small: lever arms
and contact frames are those of the undeformed structure. Masses are scaled by the springs, not by the parts: every
degree of freedom gets half the row sum of its stiffness, so that a unit time step is stable for all of them and
rest is reached within a few thousand steps. A state at rest is in equilibrium under its true weight; a state that does
not come to rest moves on until it has collapsed.

A robot that holds a part is a spring too, of the stiffness that it has, and bears what balances the part when it takes
it. Where it presses, a wrench is added slowly to what it bears. A rigid hold fixes its part.

The method shares only the assembly, and the description of holds, with the solvers of this package: no optimisation, no
linear algebra, no criterion but rest. Lengths are divided by the size of a typical part and forces by its weight, so
neither scale nor density matters; the stiffness of robots is that of the holds, in these units.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.loads import GRAVITY
from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, REMOVED, States, as_states
from falsework.errors import InputError
from falsework.stability.holds import PRESS_STIFFNESS, HoldMode, HoldSettings, Press
from falsework.stability.judges.relaxation import FALLS, STANDS, JudgedHolds, Model, relax
from falsework.stability.stiffness import LEAST_AREA

Array = NDArray[np.float64]

SOFT, STIFF = 2e-5, 2e-7
"""Settlement of a typical part under its weight on eight typical contact points, in part sizes: soft and stiff springs.
"""
POINTS = 8
"""Number of contact points that carry a typical part."""


@dataclass(frozen=True)
class DiscreteElementSettings:
    """Springs, damping, and the number of steps."""

    sinks: tuple[float, ...] = (SOFT, STIFF)
    """Springs of contacts to try in turn until a structure does not collapse on them: the settlement of a typical part
    under its weight on eight typical contact points, in part sizes. Between joints nearly parallel to the load, parts
    slip by thousands of times this settlement before they jam. What collapses on the soft springs, which need the
    fewest steps, is therefore checked again on the stiff ones."""
    tangential: float = 0.7
    """Ratio of tangential to normal stiffness; Mindlin's theory of elastic spheres gives 0.67 to 1."""
    damping: float = 0.7
    """Coefficient of local damping: share of the unbalanced force that opposes the velocity."""
    ramp: int = 2000
    """Steps over which an unbalanced force, such as gravity on the unstressed structure, is ramped up; more where the
    springs of robots are so soft that held parts would swing."""
    slower: int = 10
    """Ratio by which the ramp is lengthened for a second attempt at a state that collapses, which counts as a collapse
    if it collapses again; 1 for none. Under a load that comes quickly, the inertia of moving parts carries friction
    past its limit; building is the limit of slow loads."""
    steps: int = 30000
    """Steps after which a state that has neither come to rest nor collapsed is left undecided."""
    friction_share: float = 0.0
    """Share of their limit from which tangential forces are redrawn, uniformly in a disc of this radius, before a
    structure at rest is checked; 0 leaves friction as the history has left it."""
    seed: int = 0
    """Seed of these draws."""

    def __post_init__(self) -> None:
        if not self.sinks or not all(np.isfinite(sink) and sink > 0 for sink in self.sinks):
            raise InputError(f"sinks of springs are {self.sinks}; give positive numbers such as {STIFF}")
        if not (np.isfinite(self.tangential) and self.tangential > 0):
            raise InputError(f"tangential stiffness ratio is {self.tangential}; give a positive number such as 0.7")
        for name, value in (("damping", self.damping), ("friction_share", self.friction_share)):
            if not 0 <= value <= 1:
                raise InputError(f"{name} is {value}; give a number from 0 to 1")
        for name, count in (("ramp", self.ramp), ("slower", self.slower), ("steps", self.steps)):
            if count < 1:
                raise InputError(f"{name} is {count}; give at least 1")


@dataclass(frozen=True, eq=False)
class Settling:
    """Results of the relaxation, one entry per state."""

    stands: NDArray[np.int8]
    """1 stable, -1 collapses, 0 undecided at the step limit. Shape (states,)."""
    moved: Array
    """Largest displacement of a part, metres: of its centre of mass, plus rotation times half the diagonal of its
    bounding box; infinite for a part without contacts. Shape (states,)."""
    part: NDArray[np.int32]
    """Part that moved most; -1 where no part is free to move. Shape (states,)."""


def settle(
    assembly: Assembly,
    states: ArrayLike,
    settings: DiscreteElementSettings = DiscreteElementSettings(),
    forces: ArrayLike | None = None,
) -> Settling:
    """Check states: gravity is ramped up on an unstressed structure, which is stable if it comes to rest.

    Args:
        assembly: the structure.
        states: one state (parts,) or a batch (batch, parts).
        settings: springs, damping and step limit.
        forces: initial contact forces, none by default, N, shape (batch, points, 3), such as those of a verdict.
            Where the verdict is right, the state is at rest with them from the first step.

    Raises:
        InputError: forces of the wrong shape.
        StateError: states of the wrong shape or with wrong values.
    """
    batch = as_states(states, assembly.boundary)
    size, models = models_of(assembly, settings)
    answers = _Answers(size)
    points = len(assembly.contacts.points)
    begin = (
        np.zeros((len(batch), points, 3)) if forces is None else np.asarray(forces, float) / typical_weight(assembly)
    )
    if begin.shape != (len(batch), points, 3):
        raise InputError(f"forces have shape {begin.shape}; expected {(len(batch), points, 3)}")
    for row, state in enumerate(batch):
        for model in models:
            gap, friction = -begin[row, :, 0] / model.stiffness, begin[row, :, 1:].copy()
            grip = _no_grip(assembly)
            answer = _relax(model, state, gap, friction, grip, settings)
            if settings.friction_share and answer[0] == STANDS:
                _redraw(model, gap, friction, settings, row)
                answer = _relax(model, state, gap, friction, grip, settings)
            if answer[0] != FALLS:
                break
        answers.add(answer)
    return answers.settling()


def replay_by_discrete_elements(
    assembly: Assembly,
    states: ArrayLike,
    settings: DiscreteElementSettings = DiscreteElementSettings(),
    *,
    presses: Sequence[Sequence[Press]] | None = None,
    holds: HoldSettings = HoldSettings(),
) -> Settling:
    """Build a structure state by state, keeping compression and slip of every contact point.

    Parts come in held and unstressed: a new contact carries no force, however far its neighbours have settled. A part
    that a robot releases is loaded slowly with what the robot carried; one that a robot grasps again stays where it
    is. The history of the contacts of a removed part is dropped.

    Args:
        assembly: the structure.
        states: in assembly order, shape (steps + 1, parts); the first one has no history.
        settings: springs of contacts, damping and step limit.
        presses: those of the step that leads to each state, one entry a state; none by default.
        holds: stiffness and mode of the robots; the stiffness with which one presses is at most `PRESS_STIFFNESS`.
            Their limits are not checked.

    Returns:
        An entry for each state up to the first that collapses, which is the last entry; an undecided one does not end
        the replay. `moved` is relative to the previous state.

    Raises:
        InputError: presses of the wrong number, or on a part that is not held before and after its step.
        StateError: states of the wrong shape or with wrong values.
    """
    batch = as_states(states, assembly.boundary)
    added = added_wrenches(assembly, batch, presses)
    size, models = models_of(assembly, settings)
    for model in models:
        found = _replay(batch, added, Build(assembly, size, model, settings, holds), size)
        if found.last != FALLS:
            break
    return found.settling()


@dataclass(eq=False)
class ContactForces:
    """What contacts and robots bear in a state."""

    gap: Array
    friction: Array
    grip: JudgedHolds

    def copy(self) -> ContactForces:
        """Return a copy that shares nothing."""
        grip = self.grip
        copies = (grip.stiffness.copy(), grip.fresh.copy(), grip.wrench.copy())
        held = JudgedHolds(*copies, grip.line.copy(), grip.across.copy())
        return ContactForces(self.gap.copy(), self.friction.copy(), held)


class Build:
    """Structure that is built state by state on contact springs of one stiffness."""

    def __init__(
        self, assembly: Assembly, size: float, model: Model, settings: DiscreteElementSettings, holds: HoldSettings
    ) -> None:
        self._assembly, self._size, self._model = assembly, size, model
        self._settings, self._stiffness = settings, holds.stiffness
        self._hybrid = holds.mode is HoldMode.HYBRID
        self._ends = model.parts[np.repeat(np.arange(len(model.parts)), np.diff(model.start))]
        self._typical = typical_weight(assembly)
        self.forces = self.nothing()

    def nothing(self) -> ContactForces:
        """Return no forces."""
        points = len(self._model.local)
        return ContactForces(np.zeros(points), np.zeros((points, 2)), _no_grip(self._assembly))

    def step(self, state: NDArray[np.uint8], press: dict[int, Array], row: int) -> tuple[int, float, int]:
        """Build the next state, with the wrenches that robots add on the way, and return how it goes."""
        now, size, settings = self.forces, self._size, self._settings
        gone = (state[self._ends] == REMOVED).any(axis=1)
        now.gap[gone], now.friction[gone] = 0.0, 0.0
        if settings.friction_share:
            _redraw(self._model, now.gap, now.friction, settings, row)
        held = (state == HELD) & ~self._assembly.immovable
        spring = np.where(held & np.isfinite(self._stiffness), self._stiffness, 0.0)
        spring[list(press)] = min(self._stiffness, PRESS_STIFFNESS)
        fresh = now.grip.stiffness == 0.0
        wrench = np.where((held & ~fresh)[:, None], now.grip.wrench, 0.0)
        for part, more in press.items():
            wrench[part] += more / (self._typical * np.repeat([1.0, size], 3))
        line, across = np.zeros((len(state), 3)), np.full(len(state), self._stiffness * size / self._typical)
        for part, more in press.items() if self._hybrid else ():
            line[part] = more[:3] / max(float(np.linalg.norm(more[:3])), 1e-300)
        now.grip = JudgedHolds(spring * size / self._typical, fresh, wrench, line, across)
        return _relax(self._model, state, now.gap, now.friction, now.grip, settings)


def _replay(batch: States, added: Sequence[dict[int, Array]], build: Build, size: float) -> _Answers:
    """Build a structure up to the first state that collapses."""
    answers = _Answers(size)
    for row, (state, press) in enumerate(zip(batch, added, strict=True)):
        answers.add(build.step(state, press, row))
        if answers.last == FALLS:
            break
    return answers


def added_wrenches(
    assembly: Assembly, batch: States, presses: Sequence[Sequence[Press]] | None
) -> list[dict[int, Array]]:
    """Return the wrenches that robots add in the step to each state, by part, N and N m."""
    if presses is None:
        return [{} for _ in batch]
    if len(presses) != len(batch):
        raise InputError(f"presses are given for {len(presses)} states; expected {len(batch)}, one entry a state")
    for row, some in enumerate(presses):
        for press in some:
            held = row and (batch[row - 1 : row + 1, press.part] == HELD).all()
            if not held or assembly.immovable[press.part]:
                name = assembly.names[press.part]
                raise InputError(f"a robot presses {name} in the step to state {row}, but does not hold it throughout")
    return [{press.part: np.asarray(press.wrench, float) for press in some} for some in presses]


def _no_grip(assembly: Assembly) -> JudgedHolds:
    """Return the springs of robots where none holds a part that can move."""
    parts = assembly.part_count
    nothing = np.zeros(parts)
    return JudgedHolds(nothing, np.ones(parts, bool), np.zeros((parts, 6)), np.zeros((parts, 3)), nothing.copy())


class _Answers:
    """Results of the compiled loop, in metres."""

    def __init__(self, size: float) -> None:
        self._size = size
        self._rows: list[tuple[int, float, int]] = []

    def add(self, answer: tuple[int, float, int]) -> None:
        self._rows.append(answer)

    @property
    def last(self) -> int:
        return self._rows[-1][0]

    def settling(self) -> Settling:
        stands, moved, part = zip(*self._rows, strict=True) if self._rows else ((), (), ())
        return Settling(np.array(stands, np.int8), np.array(moved, float) * self._size, np.array(part, np.int32))


def _relax(
    model: Model,
    state: NDArray[np.uint8],
    gap: Array,
    friction: Array,
    grip: JudgedHolds,
    settings: DiscreteElementSettings,
) -> tuple[int, float, int]:
    """Relax a state, and once more under slower loads if it collapses; as `relax`."""
    start = gap.copy(), friction.copy(), grip.wrench.copy()
    answer = relax(
        model, state, gap, friction, grip, settings.tangential, settings.damping, settings.ramp, settings.steps
    )
    if answer[0] != FALLS or settings.slower == 1 or not np.isfinite(answer[1]):
        return answer
    gap[:], friction[:], grip.wrench[:] = start
    ramp = settings.ramp * settings.slower
    return relax(model, state, gap, friction, grip, settings.tangential, settings.damping, ramp, settings.steps + ramp)


def _redraw(model: Model, gap: Array, friction: Array, settings: DiscreteElementSettings, row: int) -> None:
    """Replace the tangential forces by random ones, uniform in a disc within their limits."""
    random = np.random.default_rng((settings.seed, row))
    limit = model.friction * model.stiffness * np.maximum(0.0, -gap)
    length = settings.friction_share * limit * np.sqrt(random.random(len(gap)))
    angle = 2 * np.pi * random.random(len(gap))
    friction[:, 0], friction[:, 1] = length * np.cos(angle), length * np.sin(angle)


def typical_weight(assembly: Assembly) -> float:
    """Return the mean weight of the parts that are not boundary, N."""
    loose = ~assembly.boundary
    return float(GRAVITY * assembly.mass.mass[loose if loose.any() else slice(None)].mean())


def _boxes(assembly: Assembly) -> Array:
    """Return the sides of the bounding boxes of the parts, shape (parts, 3)."""
    return np.array([np.ptp(mesh.bounds, axis=0) for mesh in assembly.meshes])


def typical_size(assembly: Assembly) -> float:
    """Return the median of the longest sides of the parts, m."""
    return float(np.median(_boxes(assembly).max(axis=1)))


def models_of(assembly: Assembly, settings: DiscreteElementSettings) -> tuple[float, list[Model]]:
    """Return the size of a typical part, metres, and models in units of it, one for each stiffness of springs."""
    if assembly.joints is not None:
        raise InputError("the discrete-element method does not support joints; replay by the contact law instead")
    contacts, mass = assembly.contacts.flat(), assembly.mass
    boxes, size = _boxes(assembly), typical_size(assembly)
    typical = typical_weight(assembly)
    weight = GRAVITY * mass.mass / typical
    count = np.diff(contacts.start)
    owner = contacts.contact_of_point
    middle = np.zeros((len(contacts), 3))
    np.add.at(middle, owner, contacts.points)
    middle /= np.maximum(count, 1)[:, None]
    area = (contacts.areas / np.maximum(count, 1))[owner]
    mean = area.mean() if len(area) else 1.0
    unit = Model(
        parts=np.ascontiguousarray(contacts.parts, np.int32),
        start=np.ascontiguousarray(contacts.start, np.int32),
        frames=np.ascontiguousarray(contacts.frames),
        arm_a=(middle - mass.center[contacts.parts[:, 0]]) / size,
        arm_b=(middle - mass.center[contacts.parts[:, 1]]) / size,
        local=np.einsum("pij,pj->pi", contacts.frames[owner], contacts.points - middle[owner]) / size,
        stiffness=np.maximum(area / mean, LEAST_AREA) / POINTS,
        weight=np.ascontiguousarray(weight),
        applied=assembly.applied_wrench(GRAVITY) / (typical * np.repeat([1.0, size], 3)),
        radius=np.linalg.norm(boxes, axis=1) / (2 * size),
        gyration=mass.inertia / (mass.mass[:, None, None] * size**2),
        friction=float(assembly.friction),
    )
    return size, [unit._replace(stiffness=unit.stiffness / sink) for sink in settings.sinks]
