"""Candidate exit directions of a part: those suggested by its contacts, then a covering of the sphere."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from falsework.geometry.contact.interfaces import Contacts

Array = NDArray[np.float64]

_SAME = np.cos(np.radians(0.02))
"""Directions nearer to each other than this are one."""
_NORMALS = 128
"""Normals that are combined two by two; a part that touches in more directions than that is held all round."""


def sphere_directions(count: int) -> Array:
    """Return the first `count` of an endless even sequence of unit vectors, shape (count, 3); always the same.

    Height and longitude follow the two-dimensional sequence of multiples of the inverse powers of the
    plastic number, which leaves no large gaps at any length.
    """
    plastic = 1.32471795724474602596
    index = np.arange(1, count + 1)
    height = 1.0 - 2.0 * np.mod(0.5 + index / plastic, 1.0)
    turn = 2.0 * np.pi * np.mod(0.5 + index / plastic**2, 1.0)
    across = np.sqrt(1.0 - height**2)
    return np.stack([across * np.cos(turn), across * np.sin(turn), height], axis=1)


def exit_directions(contacts: Contacts, part: int | Sequence[int], count: int) -> Array:
    """Return directions to try for one part, or for several that move together, most promising first.

    Unit vectors, shape (count, 3).

    First the normals of its contacts, away from the neighbour, and their mean; then the lines along which it can
    slide on two contacts at once, both ways, those first that push into the fewest neighbours: they are the
    edges of the cone of moves that the neighbours leave open, whatever neighbours are present, and that
    cone may be as thin as a line, such as the axis of a peg. The rest is spread over the sphere.
    """
    ours = np.isin(contacts.parts, part)
    outwards = ours[:, 0] != ours[:, 1]  # contacts between parts that move together say nothing
    away = np.concatenate([-contacts.normals[ours[:, 0] & outwards], contacts.normals[ours[:, 1] & outwards]])
    special = _distinct(away)
    if len(special) > 1:
        chosen = special[:_NORMALS]
        edges = np.cross(chosen[:, None], chosen[None])[np.triu_indices(len(chosen), 1)]
        length = np.linalg.norm(edges, axis=1)
        edges = edges[length > 1e-3] / length[length > 1e-3, None]
        edges = np.concatenate([edges, -edges])
        into = (edges @ special.T < -1e-6).sum(axis=1)
        edges = edges[np.argsort(into, kind="stable")][:2000]
        mean = special.sum(axis=0)
        if np.linalg.norm(mean) > 1e-3:
            special = np.concatenate([special, [mean / np.linalg.norm(mean)]])
        special = _distinct(np.concatenate([special, edges]))
    # At least half of the directions are spread evenly, however many contacts there are.
    special = special[: max(1, count // 2)][:count]
    return np.concatenate([special, sphere_directions(count - len(special))])


def _distinct(directions: Array) -> Array:
    """Return each direction once, at its first place."""
    if not len(directions):
        return directions
    same = directions @ directions.T > _SAME
    return directions[np.argmax(same, axis=1) == np.arange(len(directions))]
