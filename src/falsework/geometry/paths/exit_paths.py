"""Clearance of parts that leave in several moves, where they have no straight way out."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from falsework.errors import InputError
from falsework.geometry.clearance.moves import MOST_MOVES, ExitPath, after
from falsework.geometry.clearance.protocol import Clearance, Mask, States
from falsework.geometry.clearance.relative_motions import can_begin_to_move
from falsework.geometry.contact.interfaces import Contacts
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.paths.departure import Parts
from falsework.geometry.paths.motions import PartMotions
from falsework.geometry.paths.path_search import PathSearch
from falsework.geometry.paths.waiting import HELD, PosedStability, hands_free, has_hands, loose_parts, stages
from falsework.utils.bits import Words, pack

_WAITING = 8
"""Parts that may wait half way out while one leaves, at most."""


class StandsOracle(Protocol):
    """Stability oracle, as searches have it."""

    def verdicts(self, states: States) -> Any:
        """Return verdicts on states, shape (batch, parts), whose `stable` and `unstable` have the shape (batch,)."""
        ...


class ExitPaths(Clearance):
    """Ways out of parts, alone or together, in up to some number of moves; each is searched for once, and kept.

    A part that has a straight way out takes that (`ClearanceTable`). Otherwise it may leave in several moves, and other
    parts that robots hold in the same state may move aside meanwhile, and back when it is out. Robots carry parts all
    along: on its way a part touches others, but nothing bears on it. So the state must stand without all parts of the
    way, too.

    Where parts may wait, those that block a part, and what blocks these, may also be carried aside by a robot that
    holds nothing else and stand there meanwhile, and so may the part. What has to stand then says `stages`.

    Ways are kept with what blocks them, and searches without a result with parts that suffice for that: past these and
    more there is no way either.
    """

    def __init__(
        self,
        meshes: Sequence[TriangleMesh],
        contacts: Contacts,
        straight: Clearance,
        motions: PartMotions,
        fixed: Mask,
        moves: int,
        turns: bool,
        waiting: PosedStability | None = None,
    ) -> None:
        """Take a structure.

        Args:
            meshes: closed meshes that face outwards.
            straight: clearance of parts that leave in straight lines.
            motions: swept tests of the parts.
            fixed: parts that never move, shape (parts,).
            moves: moves of a way out at most.
            turns: whether parts that leave may also turn, and screw.
            waiting: judges states in which parts wait half way out; without it none do.

        Raises:
            InputError: no number of moves from 1 to 100.
        """
        if not (isinstance(moves, int | np.integer) and 1 <= moves <= MOST_MOVES):
            raise InputError(f"{moves} is not a number of moves of a way out; give 1 (one move) to {MOST_MOVES}")
        self._meshes, self._contacts, self._straight, self._motions = meshes, contacts, straight, motions
        self._fixed, self.moves, self.turns, self._posed = fixed, int(moves), turns, waiting
        self.waiting = waiting is not None
        self._oracle: StandsOracle | None = None
        self._robots = 1
        self._ways: dict[tuple[Parts, bool], list[_KeptWay]] = {}
        self._closed: dict[tuple[Parts, bool], list[_Closed]] = {}
        self._waited: dict[tuple[int, bytes], ExitPath | None] = {}
        self._stands: dict[bytes, bool] = {}
        self._undecided = 0
        self._cut = [0]

    def __reduce__(self) -> tuple[Any, ...]:
        """Pickle what it is made of; what was found is found again."""
        given = self._meshes, self._contacts, self._straight, self._motions, self._fixed, self.moves, self.turns
        return ExitPaths, (*given, self._posed), {"_oracle": self._oracle, "_robots": self._robots}

    def judged_by(self, oracle: StandsOracle, robots: int) -> ExitPaths:
        """Return the same ways out, where parts may move aside only if an oracle says that the rest stands.

        Args:
            oracle: says which states stand; without one all do.
            robots: parts that they hold or carry at a time.
        """
        if self._oracle is oracle and self._robots == robots:
            return self
        return self._with(_oracle=oracle, _robots=robots, _waited={}, _stands={})

    def prepare(self) -> None:
        """See `Clearance.prepare`."""
        self._straight.prepare()

    def within(self, poses: float) -> ExitPaths:
        """Return the same ways out, each searched for among so many poses; those that this leaves open `were_cut`."""
        return self._with(most=poses, _cut=[0], _closed={}, _waited={})

    @property
    def were_cut(self) -> bool:
        """Whether more poses might have led to ways that were not found."""
        return self._cut[0] > 0

    def _with(self, **changes: Any) -> ExitPaths:
        """Return the same ways out with other attributes; what was found is shared."""
        new = ExitPaths.__new__(ExitPaths)
        new.__dict__.update(self.__dict__, **changes)
        return new

    def can_leave(self, states: States, wanted: Mask | None = None) -> Mask:
        """Return whether each part has a way out past the parts that are present; as `ClearanceTable.can_leave`."""
        found = self._straight.can_leave(states)
        for row, part in np.argwhere(~found & ~self._fixed & (True if wanted is None else wanted)).tolist():
            found[row, part] = self._way(states[row], (part,)) is not None
        return found

    def exit_path(self, state: States, leaving: Parts) -> ExitPath | None:
        """See `Clearance.exit_path`."""
        state = np.asarray(state)
        if len(leaving) == 1 and self._straight.can_leave(state[None])[0, leaving[0]]:
            return ()
        return None if self._fixed[list(leaving)].any() else self._way(state, leaving)

    def caveat(self, parts: Mask) -> str:
        """Explain why some of the parts, shape (parts,), may have ways that were not found; empty if none can."""
        unsure = {key[0] for key, known in self._closed.items() if not all(closed.exact for closed in known)}
        unsure = {leaving for leaving in unsure if parts[list(leaving)].all()}
        if self._undecided:
            return (
                f"of {self._undecided} states in which parts would move aside it is not proven that they fall; a way "
                "may be free"
            )
        if self.waiting and (~self._fixed).sum() > 1:
            return (
                f"parts were tried half way out where they block another, up to {_WAITING} at a time and "
                f"{self.moves} moves; others may help"
            )
        if not unsure:
            return ""
        kinds = ("straight moves", "straight moves and turns")[self.turns]
        first = " with ".join(self._meshes[part].name for part in min(unsure))
        return (
            f"for {len(unsure)} parts or sets, {first} the first, ways out of up to {self.moves} "
            f"{kinds} were sought along the faces and edges of parts, and none was found; others may be free"
        )

    def _way(self, state: States, leaving: Parts) -> ExitPath | None:
        """Return a way on which nothing waits, else one on which others or the part do, if they may; else None."""
        found = self._search(state, leaving)
        if found is not None or self._posed is None or len(leaving) > 1:
            return found
        (part,) = leaving
        state = state.copy()
        state[part] = HELD
        if (part, state.tobytes()) not in self._waited:
            self._waited[part, state.tobytes()] = self._search_waiting(state, part, self._posed)
        return self._waited[part, state.tobytes()]

    def _search_waiting(self, state: States, part: int, posed: PosedStability) -> ExitPath | None:
        """Search for a way on which parts that no robot holds wait aside.

        These are parts that block others of the way, beginning with the part that leaves.
        """
        spare = hands_free(state, (part,), self._robots, posed.immovable)
        if spare < 0:
            return None
        held = (state == HELD) & ~self._fixed
        able = (state > 0) & ~self._fixed & ~held

        def stands(way: ExitPath, out: bool) -> bool:
            if self._oracle is None or not loose_parts(way, state, (part,)):
                return True
            return all(posed.stands(self._oracle, *stage) for stage in stages(way, state, (part,), spare, out=out))

        aside = self._contacts.touched(part, len(state)) & able
        while True:
            movable = held | aside
            movable[part] = False
            search = PathSearch(
                self._motions,
                (part,),
                (state > 0) & ~held & ~aside,
                tuple(np.flatnonzero(movable).tolist()),
                carried=lambda parts: has_hands(parts, state, (part,), spare),
                stands=stands,
                most=self.most,
            )
            found = search.run(self.moves, turns=self.turns)
            self._cut[0] += found.cut
            if found.way is not None:
                loose = bool(loose_parts(found.way, state, (part,)))
                return found.way if loose or self._rest_stands(state, found.way) else None
            more = np.flatnonzero(found.walls & able & ~aside)[: _WAITING - int(aside.sum())]
            if not len(more):
                return None
            aside[more] = True

    def _search(self, state: States, leaving: Parts) -> ExitPath | None:
        present, held = state > 0, (state == HELD) & ~self._fixed
        joined = len(leaving) > 1 and not held[list(leaving)].all()  # one robot carries them
        present[list(leaving)] = held[list(leaving)] = False
        words, hands = (pack(mask[None])[0] for mask in (present, held))
        for kept in self._ways.get((leaving, joined), ()):
            free = not (kept.blockers & words).any() and not (kept.aside & ~hands).any()
            if free and self._rest_stands(state, kept.way):
                return kept.way
        closed = self._closed.setdefault((leaving, joined), [])
        if any(not (known.walls & ~words).any() and not (hands & ~known.aside).any() for known in closed):
            return None
        if not self._begins_to_move(state, leaving, held):
            touching = pack((present & self._contacts.touched(leaving, len(state)))[None])[0]
            closed.append(_Closed(touching, hands & touching, True))
            return None
        search = PathSearch(
            self._motions,
            leaving,
            present & ~held,
            tuple(np.flatnonzero(held).tolist()),
            carried=(lambda some: set(leaving) <= set(some) or set(leaving).isdisjoint(some)) if joined else None,
            most=self.most,
        )
        found = search.run(self.moves)
        self._cut[0] += found.cut
        if found.way is None and self.turns and len(leaving) == 1:
            straight, found = found, search.run(self.moves, turns=True)
            found.walls[straight.walls] = True
        if found.way is None:
            closed.append(_Closed(pack((found.walls | held)[None])[0], hands, found.exact))
            return None
        moved = np.zeros(len(state), dtype=bool)
        moved[[other for move in found.way for other in move.parts]] = True
        moved[list(leaving)] = False
        blockers = pack(self._blockers(found.way, leaving, moved)[None])[0]
        self._ways.setdefault((leaving, joined), []).append(_KeptWay(found.way, blockers, pack(moved[None])[0]))
        return found.way if self._rest_stands(state, found.way) else None

    def _begins_to_move(self, state: States, leaving: Parts, held: Mask) -> bool:
        """Return whether parts can begin to move at all, alone or where others that are held move with them."""
        if held.any():
            return True
        there = state > 0
        there[list(leaving)] = True
        return can_begin_to_move(self._contacts, leaving, there)

    def _rest_stands(self, state: States, way: ExitPath) -> bool:
        """Return whether a state stands without the parts of a way, where others than the one that leaves move."""
        moved = sorted({part for move in way for part in move.parts})
        if self._oracle is None or moved == sorted(way[-1].parts):
            return True
        rest = state.copy()
        rest[moved] = 0
        if rest.tobytes() not in self._stands:
            verdicts = self._oracle.verdicts(rest[None])
            self._stands[rest.tobytes()] = bool(verdicts.stable[0])
            self._undecided += int((~verdicts.stable & ~verdicts.unstable).sum())
        return self._stands[rest.tobytes()]

    def _blockers(self, way: ExitPath, leaving: Parts, aside: Mask) -> Mask:
        """Return the parts at rest that would block a way, shape (parts,)."""
        found, others = np.zeros(len(self._meshes), dtype=bool), ~aside
        others[list(leaving)] = False
        for number, move in enumerate(way):
            found |= self._motions.blockers(move, others, after(way[:number]))
        return found


@dataclass(frozen=True, eq=False)
class _KeptWay:
    """ExitPath that was found."""

    way: ExitPath
    blockers: Words
    """Parts at rest that block it, shape (words,)."""
    aside: Words
    """Parts that move aside, shape (words,)."""


@dataclass(frozen=True, eq=False)
class _Closed:
    """Search without a result."""

    walls: Words
    """Parts that suffice for that, shape (words,)."""
    aside: Words
    """Parts among them that could move aside, shape (words,)."""
    exact: bool
    """Whether no way exists, however many straight moves it has."""
