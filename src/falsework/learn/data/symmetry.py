"""Symmetries of a structure about the vertical, as permutations of its parts.

Gravity points down, so a state and its images under these symmetries have the same verdict and corresponding actions. A
dome of twelve equal sectors has twenty-four symmetries.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from falsework.assembly.model import Assembly

_NEAR = 0.05
"""Largest distance between a centre of mass and its image, in units of a typical part."""
_ALIKE = 0.1
"""Relative difference of masses, and difference of contacts in units of a typical contact area."""


def symmetries(assembly: Assembly) -> NDArray[np.intp]:
    """Return the permutations of the parts by rotations about a vertical axis and reflections in vertical planes.

    Centres of mass, masses and every contact's area times normal have to agree with those of the images. Parts that
    are boundary may stay where they are: the ground is no smaller for being turned. With joints there are none.

    Returns:
        A row for each symmetry, of shape (symmetries, parts). Part `i` goes to where part `row[i]` is; the first row is
        the identity.
    """
    parts, fixed = assembly.part_count, assembly.boundary
    identity = np.arange(parts)
    movable = np.flatnonzero(~fixed)
    if len(movable) < 2 or assembly.joints is not None:  # images of joints are not compared
        return identity[None]
    mass, centre = assembly.mass.mass, assembly.mass.center
    bounds = np.array([mesh.bounds for mesh in assembly.meshes])[movable]
    size = float(np.median(np.linalg.norm(bounds[:, 1] - bounds[:, 0], axis=1)))
    axis = np.average(centre[movable, :2], axis=0, weights=mass[movable])
    place = centre - [*axis, 0.0]
    push = assembly.contacts.pushes(parts)
    # Line and point contacts have hardly any area, and yet a part may rest on them: they are compared separately.
    narrow = assembly.contacts.narrow_pushes(parts)
    found = {tuple(identity): identity}
    for turn in rigid_motions(place[movable], mass[movable], size):
        image = _image(place, place @ turn.T, mass, fixed, size)
        if image is None:
            continue
        if same_contacts(push, turn, image) and same_contacts(narrow, turn, image):
            found.setdefault(tuple(image), image)
    return np.array(list(found.values()), dtype=np.intp)


def rigid_motions(place: NDArray[np.float64], mass: NDArray[np.float64], size: float) -> list[NDArray[np.float64]]:
    """Return candidates for symmetries: rotations and reflections that map one part to a similar one."""
    radius = np.linalg.norm(place[:, :2], axis=1)
    alike = (
        (np.abs(radius[:, None] - radius) < _NEAR * size)
        & (np.abs(place[:, None, 2] - place[:, 2]) < _NEAR * size)
        & (np.abs(mass[:, None] - mass) <= _ALIKE * mass)
    )
    off = np.flatnonzero(radius > _NEAR * size)
    if len(off) == 0:
        return []
    # The part with the fewest like it has the fewest places to go to; of those, one whose direction is sharp.
    chosen = off[np.lexsort((-radius[off], alike[off].sum(axis=1)))[0]]
    angle = np.arctan2(place[:, 1], place[:, 0])
    motions = []
    for other in np.flatnonzero(alike[chosen]):
        for mirrored in (1.0, -1.0):
            around = angle[other] - mirrored * angle[chosen]
            cos, sin = np.cos(around), np.sin(around)
            motions.append(np.array([[cos, -mirrored * sin, 0.0], [sin, mirrored * cos, 0.0], [0.0, 0.0, 1.0]]))
    return motions


def _image(
    place: NDArray[np.float64],
    moved: NDArray[np.float64],
    mass: NDArray[np.float64],
    fixed: NDArray[np.bool_],
    size: float,
) -> NDArray[np.intp] | None:
    """Return the part onto which each part is mapped; None if the mapping is not one-to-one on like parts."""
    image = np.arange(len(place))
    for group in (np.flatnonzero(~fixed), np.flatnonzero(fixed)):
        if len(group) == 0:
            continue
        from scipy.spatial import KDTree

        distance, nearest = KDTree(place[group]).query(moved[group])
        there = np.asarray(distance) <= _NEAR * size
        image[group] = np.where(there | ~fixed[group], group[nearest], group)
        if not (there | fixed[group]).all():
            return None
    if len(np.unique(image)) < len(image) or (np.abs(mass[image] - mass) > _ALIKE * mass)[~fixed].any():
        return None
    return image


def same_contacts(push: NDArray[np.float64], turn: NDArray[np.float64], image: NDArray[np.intp]) -> bool:
    """Return whether a motion takes each contact to one of the same area and normal between the images of its parts."""
    areas = np.linalg.norm(push, axis=2)
    if not areas.any():
        return True
    difference = np.linalg.norm(push[np.ix_(image, image)] - push @ turn.T, axis=2)
    return bool(difference.max() <= _ALIKE * areas[areas > 0].mean())
