"""Stability of rest positions to second order: small motions that grow (docs/decisions/contact-law.md)."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly
from falsework.assembly.state import States
from falsework.stability.contact_geometry import geometry_of
from falsework.stability.criterion import StabilityCriterion
from falsework.stability.second_order.growth import NEUTRAL, growth_of_motion
from falsework.stability.second_order.springs import Springs, closing_points, springs_of_displacement
from falsework.stability.state_memory import REMEMBERED
from falsework.stability.strength import strength_of
from falsework.stability.verdict import Proof, Verdict, Verdicts

if TYPE_CHECKING:
    from scipy.sparse import csc_array, csr_array

Array = NDArray[np.float64]
Mask = NDArray[np.bool_]

_NEAREST = 4
"""Eigenvalues that are found of an unsymmetric stiffness: negative ones are those near zero."""
_TRIALS = 24
"""Stiffness matrices that are tried for one state."""


class SecondOrder:
    """Test of rest positions of one structure under the criterion `contact`.

    The stiffness of a state is that of its contact springs plus that of forces whose points turn with the parts. It is
    first taken without the contact points that bear no force, and without friction where that is at its limit. Mostly
    it is positive definite, which one sparse factorisation tells. Else friction at its limit, which makes it
    unsymmetric, is taken into account, and the motion of its least eigenvalue is followed in both directions: points
    that it would close, and friction that it would reverse, are added until the motion grows or the stiffness is
    positive.
    """

    def __init__(self, assembly: Assembly, claim: StabilityCriterion) -> None:
        """Prepare what does not depend on the state.

        Args:
            claim: cone, gravity and stiffness ratio.
        """
        self.assembly, self.claim = assembly, claim
        self.firm: set[bytes] = set()
        """States with a rest position from which no motion was found to grow."""
        geometry = self._geometry = geometry_of(assembly.contacts, assembly.mass)
        self._axes = assembly.contacts.point_frames
        points, parts = len(self._axes), assembly.part_count
        self._friction = strength_of(assembly, claim.gravity, claim.reserve).friction
        self._motion = geometry.motion.data.reshape(points, 3, 12)
        self._columns = geometry.motion.indices.reshape(points, 3, 12)
        self._own = np.zeros((parts, 6, 6))
        self._own[:, :3, :3] = assembly.mass.mass[:, None, None] * np.eye(3)
        self._own[:, 3:, 3:] = assembly.mass.inertia
        self._own *= (claim.gravity / geometry.gyration)[:, None, None]

    def revise(self, states: States, verdicts: Verdicts) -> None:
        """Change the verdict on stable states whose rest position a small motion leaves.

        Args:
            states: shape (batch, parts).
            verdicts: in and out, with certificates.
        """
        if verdicts.displacement is None or verdicts.velocity is None:
            return
        for row in np.flatnonzero(verdicts.stable):
            key = states[row].tobytes()
            if key in self.firm:
                continue
            motion = self.growing_motion(states[row], verdicts.displacement[row])
            if motion is None:
                if len(self.firm) >= REMEMBERED:
                    self.firm.clear()
                self.firm.add(key)
            else:
                verdicts.velocity[row] = motion
                verdicts.verdict[row], verdicts.proof[row] = Verdict.TIPS, Proof.MOTION

    def growing_motion(self, state: States, displacement: Array, springs: Springs | None = None) -> Array | None:
        """Return a small motion from a rest position that grows; None if none is found.

        Args:
            state: shape (parts,).
            displacement: of the parts at rest, shape (parts, 6), m and rad.
            springs: contact points at rest, a batch of one, where their history is known.

        Returns:
            `(linear, angular)` about the centres of mass, largest entry 1, shape (parts, 6), with a `growth_of_motion`
            above `NEUTRAL`.
        """
        free = state == 1
        if not free.any() or not len(self._axes):
            return None
        around = self._geometry.points_on(np.flatnonzero(free))
        known = state[None], np.where(free[:, None], displacement, 0.0)[None]
        history, springs = springs, springs or springs_of_displacement(self.assembly, *known, self.claim)
        turning = self._turning(springs, around)
        none, trials = np.zeros(len(self._axes), dtype=bool), 0
        waiting = [(none, none, lean) for lean in self._leaning(springs, around)]
        while waiting and trials < _TRIALS:
            closed, gripped, lean = waiting.pop()
            trials += 1
            law = self._law(springs, closed, gripped, around)
            if _is_positive(self._matrix(law, turning + NEUTRAL * self._own, lean, around, free)):
                continue
            own = _diagonal(self._own[free])
            dragged = self._dragged(springs, gripped, around)
            stiffness = self._matrix(law if dragged is None else law + dragged, turning, lean, around, free)
            least = _lowest(stiffness, own, symmetric=dragged is None)
            if least is None:
                continue
            motion = np.zeros((1, len(state), 6))
            motion[0, free] = least.reshape(-1, 6)
            for way in (motion, -motion):
                if growth_of_motion(self.assembly, *known, way, self.claim, history)[0] > NEUTRAL:
                    return way[0] / np.abs(way).max()
            for way in (-motion, motion):
                relative = self._geometry.relative(way)
                closes = closing_points(self.assembly, springs, way, relative)[0] | closed
                grips = ((springs.pull[0] * relative[0, :, 1:]).sum(axis=1) > 0.0) | gripped
                if (closes & ~closed).any() or (grips & ~gripped).any():
                    waiting.append((closes, grips, lean))
        return None

    def _law(self, springs: Springs, closed: Mask, gripped: Mask, at: NDArray[np.int64]) -> Array:
        """Return the stiffness of contact springs in their frames, shape (points around, 3, 3).

        Args:
            springs: at rest.
            closed: open points that count as closed, without friction, shape (points,).
            gripped: points whose friction at its limit counts as sticking, shape (points,).
            at: points of parts that can move, shape (points around,).
        """
        bears, pull, grips = springs.closed[0, at], springs.pull[0, at], gripped[at]
        law = np.zeros((len(at), 3, 3))
        law[:, 0, 0] = np.where(bears | closed[at], springs.normal[0, at], 0.0)
        along = pull[:, :, None] * pull[:, None, :]
        across = np.where(grips, 1.0, springs.across[0, at])[:, None, None] * (np.eye(2) - along)
        lateral = across + np.where(grips, 1.0, 0.0)[:, None, None] * along
        law[:, 1:, 1:] = np.where(bears, springs.tangential[0, at], 0.0)[:, None, None] * lateral
        return law

    def _dragged(self, springs: Springs, gripped: Mask, at: NDArray[np.int64]) -> Array | None:
        """Return what friction at its limit adds, since it follows the normal force; None where there is none.

        Unsymmetric, shape (points around, 3, 3).
        """
        friction = self._friction[at]
        slips = springs.closed[0, at] & springs.slips[0, at, 0] & ~gripped[at] & (friction > 0.0)
        if not slips.any():
            return None
        law = np.zeros((len(at), 3, 3))
        law[slips, 1:, 0] = (friction * springs.normal[0, at])[slips, None] * springs.pull[0, at][slips]
        return law

    def _matrix(self, law: Array, own: Array, lean: csr_array | None, at: NDArray[np.int64], free: Mask) -> csc_array:
        """Return the stiffness of contact points, and another one of each part, in the motions of free parts.

        Args:
            law: in their frames, shape (points around, 3, 3).
            own: of each part, shape (parts, 6, 6).
            lean: stiffness of normal forces that turn with a surface, of all parts.
            at: points of parts that can move, shape (points around,).
            free: shape (parts,).
        """
        from scipy.sparse import bsr_array

        count = int(free.sum())
        place = np.where(free, np.cumsum(free) - 1, count)  # what does not move has a place too, the last
        ends = place[[self._geometry.part_a[at], self._geometry.part_b[at]]].T
        first = np.flatnonzero(np.append(True, (ends[1:] != ends[:-1]).any(axis=1)))  # points of a pair are in a row
        motion = self._motion[at]
        pairs = np.add.reduceat(motion.transpose(0, 2, 1) @ (law @ motion), first)
        blocks = np.zeros((count + 1, 6, 6))
        blocks[:count] = own[free]
        one, other = ends[first].T
        np.add.at(blocks, one, pairs[:, :6, :6])
        np.add.at(blocks, other, pairs[:, 6:, 6:])
        row, column = np.concatenate([np.arange(count), one, other]), np.concatenate([np.arange(count), other, one])
        some = np.flatnonzero((row < count) & (column < count))
        some = some[np.lexsort((column[some], row[some]))]
        values = np.concatenate([blocks[:count], pairs[:, :6, 6:], pairs[:, 6:, :6]])[some]
        start = np.searchsorted(row[some], np.arange(count + 1))
        whole = bsr_array((values, column[some], start), shape=(6 * count, 6 * count)).tocsc()
        if lean is None:
            return whole
        moving = np.flatnonzero(np.repeat(free, 6))
        return whole + lean.tocsc()[:, moving][moving]

    def _rows(self, entries: Array, columns: NDArray[np.integer]) -> csr_array:
        """Return a matrix in the motions of all parts by its rows, shapes (..., entries of a row)."""
        from scipy.sparse import csr_array

        count = entries[..., 0].size
        start = entries.shape[-1] * np.arange(count + 1)
        return csr_array((entries.ravel(), columns.ravel(), start), shape=(count, 6 * self.assembly.part_count))

    def _turning(self, springs: Springs, at: NDArray[np.int64]) -> Array:
        """Return the stiffness of contact forces whose points turn with the parts, shape (parts, 6, 6)."""
        force = np.einsum("pi,pij->pj", springs.forces[0, at], self._axes[at])
        virial = np.zeros((self.assembly.part_count, 3, 3))
        for part, sign in ((self._geometry.part_a[at], -1.0), (self._geometry.part_b[at], 1.0)):
            arm = self.assembly.contacts.points[at] - self.assembly.mass.center[part]
            np.add.at(virial, part, sign * force[:, :, None] * arm[:, None, :])
        turning = np.zeros((len(virial), 6, 6))
        turning[:, 3:, 3:] = np.einsum("pii->p", virial)[:, None, None] * np.eye(3)
        turning[:, 3:, 3:] -= 0.5 * (virial + virial.transpose(0, 2, 1))
        return turning

    def _leaning(self, springs: Springs, at: NDArray[np.int64]) -> list[csr_array | None]:
        """Return the stiffness of normal forces that turn with the surface of part `a`, and of `b`, without friction.

        The same for both, none, where every point has friction.
        """
        smooth = at[springs.closed[0, at] & (self._friction[at] == 0.0)]
        if not len(smooth):
            return [None]
        tangents, columns = self._motion[smooth, 1:], self._columns[smooth, 1:]
        # The normal turns by `w x n`: along `t1` by the rotation about `t2`, along `t2` by minus that about `t1`.
        about = np.stack([-self._axes[smooth, 2], self._axes[smooth, 1]], axis=1)
        turned = springs.forces[0, smooth, :1, None] * about
        found: list[csr_array | None] = []
        for first in (3, 9):  # columns of the rotation of `a`, and of `b`
            half = self._rows(turned, columns[..., first : first + 3]).T @ self._rows(tangents, columns)
            found.append(half + half.T)
        return found


def _diagonal(blocks: Array) -> csc_array:
    """Return blocks of shape (parts, 6, 6) along a diagonal."""
    from scipy.sparse import bsr_array, csc_array

    each = np.arange(len(blocks) + 1)
    return csc_array(bsr_array((blocks, each[:-1], each)))


def _is_positive(matrix: csc_array) -> bool:
    """Return whether a symmetric matrix is positive definite: whether all pivots are positive."""
    from scipy.sparse.linalg import splu

    options = {"SymmetricMode": True}
    try:
        factor = splu(matrix, permc_spec="MMD_AT_PLUS_A", diag_pivot_thresh=0.0, options=options)
    except RuntimeError:  # singular
        return False
    return bool((factor.U.diagonal() > 0.0).all() and (factor.perm_r == factor.perm_c).all())


def _lowest(matrix: csc_array, own: csc_array, *, symmetric: bool) -> Array | None:
    """Return the eigenvector of the least eigenvalue of `matrix x = e own x`; None if that is above `-NEUTRAL`."""
    from scipy.sparse.linalg import ArpackError, eigs, eigsh

    count = matrix.shape[0]
    begin = np.ones(count)  # not at random
    try:
        if symmetric:
            below = 1.0
            while not _is_positive(matrix + below * own):
                below *= 2.0
            values, vectors = eigsh(matrix, k=1, M=own, sigma=-below, which="LM", v0=begin)
        else:
            values, vectors = eigs(matrix, k=min(_NEAREST, count - 2), M=own, sigma=-1.0, which="LM", v0=begin)
    except (ArpackError, RuntimeError):  # no convergence, or singular
        return None
    least = int(np.argmin(values.real))
    return None if values[least].real > -NEUTRAL else np.ascontiguousarray(vectors[:, least].real)
