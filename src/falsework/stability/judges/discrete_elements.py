"""Discrete-element method with explicit dynamic relaxation, as an independent stability check.

Rigid parts touch at the contact points of the structure through normal springs without tension and tangential springs
with Coulomb friction, whose force is incremental and so depends on the slip history (Cundall and Strack 1979). Where
the two surfaces are inclined to each other, friction must bear the force on either. Local damping dissipates energy
until the parts come to rest or move away (Cundall 1987). Displacements are small: lever arms and contact frames are
those of the undeformed structure. Masses are scaled by the springs, not by the parts: every degree of freedom gets half
the row sum of its stiffness, so that a unit time step is stable for all of them and rest is reached within a few
thousand steps. A state at rest is in equilibrium under its true weight; a state that does not come to rest moves on
until it has collapsed.

A robot that holds a part is a spring too, of the stiffness that it has, and bears what balances the part when it takes
it. Where it presses, a wrench is added slowly to what it bears. A rigid hold fixes its part.

The method shares only the assembly, and the description of holds and stiffness, with the solvers of this package: no
optimisation, no linear algebra, no criterion but rest. Lengths are divided by the size of a typical part and forces by
its weight, so neither scale nor density matters.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from copy import deepcopy
from dataclasses import dataclass
from math import isqrt

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.loads import GRAVITY
from falsework.assembly.model import Assembly
from falsework.assembly.state import HELD, REMOVED, States, as_states
from falsework.errors import InputError
from falsework.geometry.contact.contacts import Contacts
from falsework.stability.holds import PRESS_STIFFNESS, HoldMode, HoldSettings, Press
from falsework.stability.judges.judgement import Judgement
from falsework.stability.judges.relaxation import FALLS, OPEN, JudgedHolds, Model, relax
from falsework.stability.stiffness import TANGENTIAL_RATIO, normal_stiffness
from falsework.utils.quantity import check_counts, check_positive

Array = NDArray[np.float64]


@dataclass(frozen=True)
class DiscreteElementSettings:
    """Springs, damping, and the number of steps."""

    stiffness: float = 1.0
    """Stiffness of contacts, in multiples of those of the criterion."""
    tangential: float = TANGENTIAL_RATIO
    """Ratio of tangential to normal stiffness."""
    damping: float = 0.7
    """Coefficient of local damping: share of the unbalanced force that opposes the velocity."""
    ramp: int = 2000
    """Steps over which an unbalanced force, such as gravity on the unstressed structure, is ramped up; more where the
    springs of robots are so soft that held parts would swing."""
    slower: int = 10
    """Ratio by which the ramp is lengthened for a second attempt at a state that collapses, which counts as a collapse
    if it collapses again; 1 for none. Under a load that comes quickly, the inertia of moving parts carries friction
    past its limit; building is the limit of slow loads."""
    steps: int = 100_000
    """Steps after which a state that has neither come to rest nor collapsed is left undecided."""
    fallen: float = 0.04
    """Displacement of a collapsed part, in sizes of a typical part."""
    rest: float = 1e-4
    """Largest unbalanced force of a part at rest, in weights of the part; moments are divided by the typical size."""

    def __post_init__(self) -> None:
        check_positive(self, "stiffness", "tangential", "fallen", "rest")
        if not 0 <= self.damping <= 1:
            raise InputError(f"damping is {self.damping}; give a number from 0 to 1")
        check_counts(self, "ramp", "slower", "steps")


@dataclass(eq=False)
class ContactForces:
    """What contacts and robots bear in a state."""

    gap: Array
    friction: Array
    grip: JudgedHolds


class Build:
    """Structure that is built state by state.

    Parts come in held and unstressed: a new contact carries no force, however far its neighbours have settled. A part
    that a robot releases is loaded slowly with what the robot carried; one that a robot grasps again stays where it
    is. The history of the contacts of a removed part is dropped.
    """

    def __init__(
        self,
        assembly: Assembly,
        settings: DiscreteElementSettings = DiscreteElementSettings(),
        holds: HoldSettings = HoldSettings(),
        gravity: float = GRAVITY,
    ) -> None:
        """Lay out the structure.

        Args:
            settings: springs of contacts, damping and step limit.
            holds: stiffness and mode of the robots; the stiffness with which one presses is at most `PRESS_STIFFNESS`.
                Their limits are not checked.
            gravity: m/s2.

        Raises:
            InputError: a structure with joints.
        """
        if assembly.joints is not None:
            raise InputError("the discrete-element method does not support joints; replay by the contact law instead")
        self._assembly, self._settings, self._holds, self._gravity = assembly, settings, holds, gravity
        loose = ~assembly.boundary
        self._weight = float(gravity * assembly.mass.mass[loose if loose.any() else slice(None)].mean())
        boxes = np.array([np.ptp(mesh.bounds, axis=0) for mesh in assembly.meshes])
        self._size = float(np.median(boxes.max(axis=1)))
        contacts = assembly.contacts.flat()  # curved contacts are one contact a point from here on
        self._model = self._scaled(boxes, contacts)
        self._ends = self._model.parts[contacts.contact_of_point]
        self.forces = self.unstressed()

    def unstressed(self, forces: Array | None = None) -> ContactForces:
        """Return no forces, or contact forces in N, shape (points, 3), that nothing has led to."""
        points, parts = len(self._model.local), self._assembly.part_count
        force = np.zeros((points, 3)) if forces is None else forces / self._weight
        nothing = np.zeros(parts)
        grip = JudgedHolds(nothing, np.ones(parts, bool), np.zeros((parts, 6)), np.zeros((parts, 3)), nothing.copy())
        stiffness = self._model.stiffness
        gap = np.divide(-force[:, 0], stiffness, out=np.zeros(points), where=stiffness > 0.0)
        return ContactForces(gap, force[:, 1:].copy(), grip)

    def step(self, state: States, press: dict[int, Array]) -> tuple[int, float, int]:
        """Build the next state, with the wrenches in N and N m that robots add on the way, by part.

        Returns:
            What becomes of it, the largest displacement of a part since the state before, m, and that part.
        """
        now, size, stiffness = self.forces, self._size, self._holds.stiffness
        gone = (state[self._ends] == REMOVED).any(axis=1)
        now.gap[gone], now.friction[gone] = 0.0, 0.0
        held = (state == HELD) & ~self._assembly.immovable
        spring = np.where(held & np.isfinite(stiffness), stiffness, 0.0)
        spring[list(press)] = min(stiffness, PRESS_STIFFNESS)
        fresh = now.grip.stiffness == 0.0
        wrench = np.where((held & ~fresh)[:, None], now.grip.wrench, 0.0)
        line, across = np.zeros((len(state), 3)), np.full(len(state), stiffness * size / self._weight)
        for part, more in press.items():
            wrench[part] += more / (self._weight * np.repeat([1.0, size], 3))
            if self._holds.mode is HoldMode.HYBRID:
                line[part] = more[:3] / max(float(np.linalg.norm(more[:3])), 1e-300)
        now.grip = JudgedHolds(spring * size / self._weight, fresh, wrench, line, across)
        answer, moved, part = self._relax(state)
        return answer, moved * size, part

    def _relax(self, state: States) -> tuple[int, float, int]:
        """Relax a state, and once more under slower loads if it collapses; as `relax`."""
        now, settings = self.forces, self._settings
        start, slower = (now.gap.copy(), now.friction.copy(), now.grip.wrench.copy()), settings.slower
        law, ends = (settings.tangential, settings.damping), (settings.fallen, settings.rest)
        answer = relax(self._model, state, now.gap, now.friction, now.grip, *law, settings.ramp, settings.steps, *ends)
        if answer[0] != FALLS or slower == 1 or not np.isfinite(answer[1]):
            return answer
        now.gap[:], now.friction[:], now.grip.wrench[:] = start
        ramp = settings.ramp * slower
        return relax(self._model, state, now.gap, now.friction, now.grip, *law, ramp, settings.steps + ramp, *ends)

    def _scaled(self, boxes: Array, contacts: Contacts) -> Model:
        """Return the structure in units of size and weight of a typical part; boxes have shape (parts, 3)."""
        assembly, mass, size, weight = self._assembly, self._assembly.mass, self._size, self._weight
        owner, count = contacts.contact_of_point, np.diff(contacts.start)
        middle = np.zeros((len(contacts), 3))
        np.add.at(middle, owner, contacts.points)
        middle /= np.maximum(count, 1)[:, None]
        stiffness = self._settings.stiffness * normal_stiffness(assembly, self._gravity) * size / weight
        return Model(
            parts=np.ascontiguousarray(contacts.parts, np.int32),
            start=np.ascontiguousarray(contacts.start, np.int32),
            frames=np.ascontiguousarray(contacts.frames),
            arm_a=(middle - mass.center[contacts.parts[:, 0]]) / size,
            arm_b=(middle - mass.center[contacts.parts[:, 1]]) / size,
            local=np.einsum("pij,pj->pi", contacts.frames[owner], contacts.points - middle[owner]) / size,
            stiffness=np.where(contacts.idle(assembly.friction), 0.0, stiffness),
            weight=np.ascontiguousarray(self._gravity * mass.mass / weight),
            applied=assembly.applied_wrench(self._gravity) / (weight * np.repeat([1.0, size], 3)),
            radius=np.linalg.norm(boxes, axis=1) / (2 * size),
            gyration=mass.inertia / (mass.mass[:, None, None] * size**2),
            friction=np.tan(np.maximum(np.arctan(assembly.friction) - contacts.point_lean, 0.0)),
        )


class BuildJudge:
    """Judge of plans, which builds each from where it differs from the one before."""

    def __init__(self, assembly: Assembly, holds: HoldSettings = HoldSettings(), gravity: float = GRAVITY) -> None:
        """Lay out the structure, with stiffness and mode of the robots, under a gravity; see `Build`."""
        self._assembly, self._build = assembly, Build(assembly, holds=holds, gravity=gravity)
        self._steps: list[tuple[bytes, tuple[Press, ...]]] = []
        self._answers: list[tuple[int, float, int]] = []
        self._kept: dict[int, ContactForces] = {}
        self._whole = True

    def judge(
        self, states: ArrayLike, presses: Sequence[Sequence[Press]], stop: Callable[[], bool] = lambda: False
    ) -> Judgement:
        """Build a plan under the true friction, up to the first state that collapses.

        Args:
            states: in assembly order, shape (steps + 1, parts).
            presses: those of the step that leads to each state, one entry a state.
            stop: asked before every state; true leaves the others out.

        Raises:
            InputError: presses of the wrong number, or on a part that is not held before and after its step.
            StateError: states of the wrong shape or with wrong values.
        """
        batch = as_states(states, self._assembly.boundary)
        added = added_wrenches(self._assembly, batch, presses)
        steps = [(state.tobytes(), tuple(press)) for state, press in zip(batch, presses, strict=True)]
        begin = self._backtrack(steps)
        every = isqrt(len(batch)) + 1  # as many are kept as are built again at most
        for row in range(begin, len(batch)):
            if (self._answers and self._answers[-1][0] == FALLS) or stop():
                break
            if row % every == 0:
                self._kept[row] = deepcopy(self._build.forces)
            self._whole = False  # where the keyboard interrupts the step
            answer = self._build.step(batch[row], added[row])
            self._steps.append(steps[row])
            self._answers.append(answer)
            self._whole = True
        found = [answer[0] for answer in self._answers]
        undecided = tuple(row for row, answer in enumerate(found) if answer == OPEN)
        if found and found[-1] == FALLS:
            return Judgement(len(found) - 1, len(batch), len(found) - 1, int(self._answers[-1][2]), undecided)
        return Judgement(len(found), len(batch), undecided=undecided)

    def _backtrack(self, steps: list[tuple[bytes, tuple[Press, ...]]]) -> int:
        """Return the state from which to build, the last with known forces before the first that differs."""
        same = 0
        while same < min(len(steps), len(self._steps)) and steps[same] == self._steps[same]:
            same += 1
        if self._whole and same == len(self._steps) and self._answers:
            return same  # goes on where it was stopped
        begin = max((row for row in self._kept if row <= same), default=0)
        self._build.forces = deepcopy(self._kept[begin]) if begin in self._kept else self._build.unstressed()
        self._kept = {row: forces for row, forces in self._kept.items() if row <= begin}
        del self._steps[begin:], self._answers[begin:]
        return begin


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
