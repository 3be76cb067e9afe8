"""Joints: friction, cohesion and tension of contacts, by pair of materials or of parts."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.assembly_model import MOST, MOST_FRICTION, JointEntry
from falsework.assembly.part_numbers import part_id
from falsework.errors import AssemblyError
from falsework.geometry.arrays import read_only
from falsework.geometry.contact.interfaces import Contacts
from falsework.utils.models import plain, read_model

Array = NDArray[np.float64]

Setting = tuple[tuple[float, float], ...]
"""Increasing numbers of steps since both parts were placed, and the increasing shares of strength of the joint then."""

SET = 1_000_000
"""Age in steps of joints that exist before the first state."""
_VALUES = ("friction", "cohesion", "tension")
_UNITS = {"friction": "", "cohesion": " Pa", "tension": " Pa"}


@dataclass(frozen=True, eq=False)
class Joints:
    """Mohr-Coulomb strength of contact points, with a tension cut-off; arrays are read-only.

    A contact point bears a normal force from `-tension` up, and under a normal force `n` a tangential one of at most
    `cohesion + friction n`. Strengths of a contact are shared equally by its points.
    """

    friction: Array
    """Shape (points,); NaN is the friction of the assembly."""
    cohesion: Array
    """N, shape (points,); NaN is friction times tension, the least with which all of the tension acts."""
    tension: Array
    """N, shape (points,)."""
    ductile: NDArray[np.bool_]
    """Whether a point that is pulled apart continues to bear its tension, as studs do, or tears, as mortar does;
    of the criterion `contact`, shape (points,)."""
    setting: tuple[Setting, ...] = ()
    """Growth of cohesion and tension of setting joints with the steps since both parts were placed."""
    sets: NDArray[np.int32] = field(default_factory=lambda: np.zeros(0, np.int32))
    """Index into `setting` of each contact point, -1 for none, shape (points,); empty where nothing sets."""

    def __post_init__(self) -> None:
        read_only(self.friction, self.cohesion, self.tension, self.ductile, self.sets)

    @staticmethod
    def from_arrays(
        contacts: Contacts,
        *,
        friction: ArrayLike = np.nan,
        cohesion: ArrayLike = np.nan,
        tension: ArrayLike = 0.0,
        ductile: ArrayLike = False,
        setting: Sequence[Setting] = (),
        sets: ArrayLike = 0,
    ) -> Joints:
        """Give contacts a strength.

        Args:
            friction: coefficient of friction of every contact, or one a contact; NaN is that of the assembly.
            cohesion: Pa, likewise; NaN is friction times tension.
            tension: Pa, likewise.
            ductile: whether the joint continues to bear its tension when it is pulled apart, likewise.
            setting: growth curves of joints that set; with none, all have their full strength at once.
            sets: which of them is that of every contact, or one a contact; -1 for none.

        Raises:
            AssemblyError: a number that is negative or infinite, strength of a contact without area, or a decreasing
                strength.
        """
        count = len(contacts)
        values = {}
        for name, given in zip(_VALUES, (friction, cohesion, tension), strict=True):
            array = np.array(given, dtype=np.float64)
            if array.shape not in ((), (count,)):
                raise AssemblyError(f"{name} has shape {array.shape}; give one number, or {count}, one a contact")
            values[name] = array = np.array(np.broadcast_to(array, count))
            most = MOST_FRICTION if name == "friction" else MOST
            bad = array[~((array >= 0) & (array <= most)) & ~np.isnan(array)]
            if len(bad) or (name == "tension" and np.isnan(array).any()):
                value = bad[0] if len(bad) else np.nan
                raise AssemblyError(f"{name} of a joint is {value:g}{_UNITS[name]}; give a number from 0 to {most:g}")
        share = np.where(contacts.dimension == 2, contacts.areas, 0.0) / np.diff(contacts.start)
        strong = (np.nan_to_num(values["cohesion"]) > 0) | (values["tension"] > 0)
        bare = np.flatnonzero(strong & (share == 0))
        if len(bare):
            a, b = contacts.parts[bare[0]].tolist()
            raise _without_area(a, b, "them out of the joint")
        owner = contacts.contact_of_point
        ways = tuple(_setting(way) for way in setting)
        return Joints(
            values["friction"][owner],
            (values["cohesion"] * share)[owner],
            (values["tension"] * share)[owner],
            np.broadcast_to(np.array(ductile, bool), count)[owner],
            ways,
            np.broadcast_to(np.array(sets, np.int32), count)[owner] if ways else np.zeros(0, np.int32),
        )

    @staticmethod
    def from_uniform(
        contacts: Contacts, *, cohesion: float | None = None, tension: float | None = None
    ) -> Joints | None:
        """Give all contacts with an area the same strength; None where there is none to give.

        Args:
            cohesion: Pa; None is friction times tension.
            tension: Pa.

        Raises:
            AssemblyError: a number that is negative or infinite.
        """
        if not cohesion and not tension:
            return None
        flat = contacts.dimension == 2
        given = np.nan if cohesion is None else cohesion
        return Joints.from_arrays(
            contacts, cohesion=np.where(flat, given, np.nan), tension=np.where(flat, tension or 0.0, 0.0)
        )

    @staticmethod
    def from_entries(entries: Any, materials: Any, names: Sequence[str], contacts: Contacts) -> Joints | None:
        """Read joints as `assembly.json` gives them; where several apply, the last one counts.

        Args:
            entries: objects with `friction`, `cohesion` (Pa), `tension` (Pa), perhaps `ductile` and `sets`, pairs of
                steps and shares, and either `between`, two materials, or `parts`, two ids or names, or neither, for
                all contacts; or None.
            materials: name of the material of each part, or one for all; or None.
            names: of the parts; a ground added to them is the last and of the material `ground`.

        Returns:
            Joints, or None where there is no entry. Contacts along lines and at points have no area, and so no strength
            between materials.

        Raises:
            AssemblyError: no such material or part, parts that do not touch, or invalid numbers.
        """
        made_of = _materials(materials, names)
        if not entries:
            return None
        values = {name: np.full(len(contacts), np.nan) for name in _VALUES}
        values["tension"][:] = 0.0
        flat = contacts.dimension == 2
        ways: list[Any] = []
        sets, ductile = np.full(len(contacts), -1, np.int32), np.zeros(len(contacts), bool)
        for number, entry in enumerate(read_model(list[JointEntry], plain(entries), "", AssemblyError, "joints")):
            named = {name: getattr(entry, name) for name in _VALUES if getattr(entry, name) is not None}
            if not named:
                raise AssemblyError(f"joints[{number}] has no strength; give friction, cohesion or tension")
            rows = _rows(entry, made_of, names, contacts)
            strong = named.get("cohesion", 0.0) > 0 or named.get("tension", 0.0) > 0
            if strong and rows.any() and not flat[rows].any():
                a, b = (names[part] for part in contacts.parts[np.flatnonzero(rows)[0]].tolist())
                raise _without_area(a, b, "the joint out")
            for name, value in named.items():
                values[name][rows if name == "friction" else rows & flat] = value
            if strong or entry.ductile is not None:
                ductile[rows] = bool(entry.ductile)
            if strong or entry.sets is not None:
                sets[rows] = -1 if entry.sets is None else len(ways)
                ways += [] if entry.sets is None else [entry.sets]
        return Joints.from_arrays(contacts, **values, ductile=ductile, setting=ways, sets=sets)

    @property
    def arrays(self) -> tuple[Array, ...]:
        """All data that a verdict or a replay depends on."""
        ways = [np.array(way).ravel() for way in self.setting]
        kinds = self.ductile.astype(np.float64), *([self.sets.astype(np.float64)] if ways else [])
        return self.friction, self.cohesion, self.tension, *ways, *kinds

    def set_share(self, age: NDArray[np.int32]) -> Array:
        """Return the share of its strength that each contact point has, of the shape of `age`.

        Args:
            age: steps since both parts are in place, shape (..., points).
        """
        share = np.ones(age.shape)
        for number, way in enumerate(self.setting):
            mine = self.sets == number
            share[..., mine] = np.interp(age[..., mine], *np.array(way).T)
        return share

    def scale_friction(self, factor: float) -> Joints:
        """Return the same joints with other coefficients of friction; cohesion that was given is kept."""
        return replace(self, friction=factor * self.friction)

    def fully_set(self) -> Joints:
        """Return the same joints, fully set from the start."""
        return Joints(self.friction, self.cohesion, self.tension, self.ductile)

    def with_more_parts(self, before: Contacts, after: Contacts, parts: int) -> Joints:
        """Return the joints of contacts found anew with more parts, which have none.

        Args:
            before: contacts of these joints.
            after: contacts with more parts.
            parts: number of parts before.

        Raises:
            AssemblyError: contacts between the existing parts have changed.
        """
        kept = np.asarray((after.parts[after.contact_of_point] < parts).all(axis=1))
        if not np.array_equal(after.points[kept], before.points):
            raise AssemblyError("the contacts of the parts change with the ground, so joints have no place; fix parts")

        def padded(array: NDArray[Any], rest: float) -> NDArray[Any]:
            more = np.full(len(kept) if len(array) else 0, rest, array.dtype)
            if len(array):
                more[kept] = array
            return more

        return Joints(
            padded(self.friction, np.nan),
            padded(self.cohesion, np.nan),
            padded(self.tension, 0.0),
            padded(self.ductile, False),
            self.setting,
            padded(self.sets, -1),
        )

    def recomputed(self, before: Contacts, after: Contacts) -> Joints:
        """Return joints of the same strength per area for contacts of the same parts in other places.

        A contact takes the strength of the largest one between its parts. Parts that did not touch are not joined.

        Args:
            before: contacts of these joints.
            after: contacts found anew.
        """
        share = before.areas / np.diff(before.start)
        strongest = {tuple(before.parts[row].tolist()): row for row in np.argsort(before.areas, kind="stable")}
        source = np.array([strongest.get(tuple(pair), -1) for pair in after.parts.tolist()], dtype=np.intp)
        joined = source >= 0
        flat = joined & (after.dimension == 2) & (share[source] > 0)
        first, area = before.start[:-1][source], np.where(flat, share[source], 1.0)
        return Joints.from_arrays(
            after,
            friction=np.where(joined, self.friction[first], np.nan),
            cohesion=np.where(flat, self.cohesion[first] / area, np.nan),
            tension=np.where(flat, self.tension[first] / area, 0.0),
            ductile=joined & self.ductile[first],
            setting=self.setting,
            sets=np.where(flat, self.sets[first], -1) if self.setting else 0,
        )

    def of_points(self, kept: NDArray[np.bool_]) -> Joints:
        """Return the joints of some contact points, shape (points,)."""
        sets = self.sets[kept] if len(self.sets) else self.sets
        return Joints(
            self.friction[kept], self.cohesion[kept], self.tension[kept], self.ductile[kept], self.setting, sets
        )


def _without_area(a: object, b: object, what: str) -> AssemblyError:
    return AssemblyError(
        f"parts {a} and {b} touch along a line or at a point, which has no area for cohesion or tension; leave {what}, "
        "or join them at points (fasteners)"
    )


def _materials(given: Any, names: Sequence[str]) -> list[str]:
    """Return the material of each part; a part beyond those given is the ground."""
    if given is None:
        return [""] * len(names)
    if isinstance(given, str):
        return [given] * len(names)
    made_of = list(given) if isinstance(given, list) else []
    made_of += ["ground"] * (len(names) - 1 == len(made_of) and names[-1].startswith("ground"))
    if len(made_of) != len(names) or not all(isinstance(item, str) for item in made_of):
        raise AssemblyError(f"materials must be one name, or {len(names)} names, one a part")
    return made_of


def _rows(entry: JointEntry, made_of: Sequence[str], names: Sequence[str], contacts: Contacts) -> NDArray[np.bool_]:
    """Return the contacts that an entry applies to, shape (contacts,)."""
    if entry.between is not None and entry.parts is not None:
        raise AssemblyError(f"joint between {' and '.join(entry.between)} has parts too; give one of them")
    if entry.between is not None:
        pair = entry.between
        known = sorted(set(made_of) - {""})
        for name in pair:
            if name not in known:
                raise AssemblyError(
                    f"no part is of material {name!r}; materials of the parts are {', '.join(known) or 'not given'}"
                )
        kind = np.array([sorted((str(made_of[a]), str(made_of[b]))) for a, b in contacts.parts.tolist()]).reshape(-1, 2)
        return (kind == sorted(pair)).all(axis=1)
    if entry.parts is None:
        return np.ones(len(contacts), dtype=bool)
    a, b = sorted(part_id(item, names, "a joint is of part") for item in entry.parts)
    rows = (contacts.parts == (a, b)).all(axis=1)
    if not rows.any():
        raise AssemblyError(f"parts {names[a]} and {names[b]} do not meet, so no joint is between them")
    return rows


def _setting(given: Any) -> Setting:
    """Return a checked growth curve of a setting joint."""
    try:
        way = np.array(given, dtype=np.float64)
    except (TypeError, ValueError):
        way = np.zeros(0)
    good = way.ndim == 2 and way.shape[-1] == 2 and len(way) > 0 and np.isfinite(way).all()
    if not good or (way < 0).any() or (way[:, 1] > 1).any() or (np.diff(way, axis=0) < 0).any() or way[-1, 1] != 1:
        raise AssemblyError(
            f"a joint sets by {given!r}; give pairs of steps and shares that rise to 1, such as [[0, 0], [5, 1]]"
        )
    return tuple(zip(way[:, 0].tolist(), way[:, 1].tolist(), strict=True))
