"""Poses that rigid parts reach, by the fewest moves that lead there."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

from falsework.geometry.clearance.moves import ExitPath, PathMove, Poses
from falsework.geometry.paths.departure import Departure, Mask
from falsework.geometry.paths.motions import IN_PLACE
from falsework.geometry.paths.rigid_poses import Begun, RigidPoses
from falsework.utils.interruption import check_interruption

_POSES = 2000
"""Poses from which moves are tried, at most."""


@dataclass(frozen=True, eq=False)
class _Node:
    """Pose that moves lead to."""

    at: Poses
    move: PathMove | None = None
    before: _Node | None = None
    touches: bool = True
    """Whether the last move was as long as it can be, so that the part that moved touches another."""

    def way(self, last: PathMove | None = None) -> ExitPath:
        """Return the moves from home, and one more."""
        moves = [] if last is None else [last]
        node: _Node | None = self
        while node is not None and node.move is not None:
            moves.append(node.move)
            node = node.before
        return tuple(reversed(moves))


class PoseLayers:
    """Poses that as many moves lead to, and no fewer; of one layer after the other, see `CellLayers`."""

    def __init__(self, poses: RigidPoses) -> None:
        self._poses = poses
        self._front, self._seen, self._tried = [_Node(IN_PLACE)], {poses.key(IN_PLACE)}, 0
        self._begun = list[list[Begun]]()
        self._turned = list[list[tuple[Poses, PathMove, bool]]]()
        self._exact = True

    @property
    def walls(self) -> Mask:
        """Parts at rest that moves have hit so far, shape (parts,)."""
        return self._poses.walls

    @property
    def exact(self) -> bool:
        """Whether all moves that matter were tried so far."""
        return self._exact and self._poses.exact

    def ways(self, number: int, departure: Departure) -> Iterator[ExitPath]:
        """Yield ways on which the parts are out after a number of moves, that is reached, and one more."""
        self._begun, self._turned = [], []
        # Straight ways out first: they take the least time, and turns serve to open them.
        for node in self._front:
            check_interruption(large=True)
            self._begun.append(list(self._poses.begun(node.at, node.move)))
            for begun in self._begun[-1]:
                out = self._poses.out(node.at, begun)
                if out is not None:
                    yield node.way(out)
        for node in self._front:
            check_interruption(large=True)
            turned = list(self._poses.turned(node.at, node.move)) if node.touches else []
            self._turned.append([(at, move, True) for at, move, _ in turned])
            for _, move, out in turned:
                if out:
                    yield node.way(move)

    def reaches(self, number: int, departure: Departure) -> bool:
        """Return whether some number of moves, one more than those of the last ways, leads to other poses."""
        if number:
            reached: list[_Node] = []
            for node, beginnings, following in zip(self._front, self._begun, self._turned, strict=True):
                check_interruption(large=True)
                for begun in beginnings:
                    following.extend(self._poses.ends(node.at, begun))
                for at, move, touches in following:
                    key = self._poses.key(at)
                    if key not in self._seen and departure.allows(node.way(move), out=False):
                        self._seen.add(key)
                        reached.append(_Node(at, move, node, touches))
            self._front = reached
        if self._tried + len(self._front) > _POSES:
            self._front, self._exact = self._front[: _POSES - self._tried], False
        self._tried += len(self._front)
        return bool(self._front)
