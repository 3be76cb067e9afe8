"""Toy bricks that hold each other by studs: an assembly of bricks on a grid, and readers of BrickGPT text and LDraw.

Studs are those of StableLego (Liu et al., IEEE Robotics and Automation Letters 9, 2024; arXiv 2402.10711). A stud
meets the cavity above it at four points, where the upper brick is one stud wide, or at three. Each point bears a
tension of 0.98 N, also while it slides off. Sideways a stud is held by the walls of the cavity, which bear more than
any load here.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from falsework.assembly.draft import Block, Draft
from falsework.assembly.joints import Joints
from falsework.assembly.model import Assembly
from falsework.errors import AssemblyError, InputError
from falsework.geometry.contact.interfaces import Contacts
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.geometry.mesh.surface import warn_of
from falsework.utils.files.formats import Reader
from falsework.utils.files.input_file import read_text
from falsework.utils.quantity import listed

Array = NDArray[np.float64]

STUD_TENSION = 0.98
"""Tension in N that each contact point of a stud bears: 100 g at 9.8 m/s2 (StableLego's configuration)."""
STUD_FRICTION = 10.0
"""Tangential over normal force beyond the tension that a point bears, in place of the walls of the cavity: a stud that
is not about to separate bears many weights sideways."""
UNIT = 0.4e-3
"""Metres of an LDraw unit (LDU): a stud is 20 of them wide and a brick 24 high (LDraw file format, revision 1.0.2)."""
PITCH, HEIGHT, PLATE = 20, 24, 8
"""Of a stud, a brick and a plate, LDU."""
_PLAY = 0.1e-3
"""Distance of the side of a brick from its place on the grid, m."""
_BASE = 3.2e-3
"""Thickness of the baseplate, m."""
_MASSES = {
    (1, 1): 0.43, (1, 2): 0.81, (1, 4): 1.57, (1, 6): 2.28, (1, 8): 3.03, (2, 2): 1.15, (2, 4): 2.16, (2, 6): 3.23,
}  # fmt: skip
"""Grams by studs (StableLego's library of bricks)."""
_OTHER_MASS = (0.06, 0.375, 0.265)
"""Grams of other bricks: in all, a stud in bricks one stud wide, and a stud in wider ones; within 3 % of the above."""
_ABS = 1.05e-3
"""Density of the plastic, g/mm3."""
_WALL, _TUBE, _POST = 1.5, 15.2, 8.0
"""Thickness of the sides of a brick, mm, and sections of the tubes between its studs, and of the posts where it is one
stud wide, mm2: what a plate has less of than a brick, since both have the same top."""
_AROUND = {
    3: np.array([[0.125, -0.125], [-0.25, 0.0], [0.125, 0.125]]),
    4: np.array([[0.25, 0.0], [0.0, 0.25], [-0.25, 0.0], [0.0, -0.25]]),
}
"""Contact points of a stud about its axis, in studs (StableLego)."""
_BRICKS = {
    "3005": (1, 1), "3004": (2, 1), "3622": (3, 1), "3010": (4, 1), "3009": (6, 1), "3008": (8, 1),
    "6111": (10, 1), "6112": (12, 1), "2465": (16, 1),
    "3003": (2, 2), "3002": (3, 2), "3001": (4, 2), "2456": (6, 2), "3007": (8, 2), "3006": (10, 2),
    "2356": (6, 4), "4202": (12, 4), "4201": (8, 8),
}  # fmt: skip
"""Studs along x and z of LDraw parts one brick high."""
_PLATES = {
    "3024": (1, 1), "3023": (2, 1), "3623": (3, 1), "3710": (4, 1), "3666": (6, 1), "3460": (8, 1), "4477": (10, 1),
    "60479": (12, 1), "3022": (2, 2), "3021": (3, 2), "3020": (4, 2), "3795": (6, 2), "3034": (8, 2), "3832": (10, 2),
    "2445": (12, 2), "4282": (16, 2), "11212": (3, 3), "3031": (4, 4), "3032": (6, 4), "3035": (8, 4), "3030": (10, 4),
    "3029": (12, 4), "3958": (6, 6), "3036": (8, 6), "3033": (10, 6), "3028": (12, 6), "3027": (16, 6), "3026": (24, 6),
    "41539": (8, 8), "92438": (16, 8), "91405": (16, 16),
}  # fmt: skip
"""The same of parts one plate high."""
_PARTS = {part: (studs, HEIGHT) for part, studs in _BRICKS.items()} | {
    part: (studs, PLATE) for part, studs in _PLATES.items()
}
_STIFF = 100.0
"""Area that a stud stands for, in squares of its width. Sticks of bricks deflect by more than the thousandth of their
length that counts as falling, and are stable nevertheless; the scale of the stiffness changes displacements but no
force."""
_MOST_BRICKS, _MOST_STUDS, _DEEPEST = 4000, 200_000, 32
"""Bounds of a file: pairs of bricks are compared, studs are contact points, and short models may nest to any number."""
_NUMBER = r"\s*(\d{1,5})\s*"
_LINE = re.compile(rf"{_NUMBER}x{_NUMBER}\({_NUMBER},{_NUMBER},{_NUMBER}\)\s*", re.ASCII)
_BEGINNING = re.compile(r"\s*\d+\s*x\s*\d+\s*\(")
"""Of the first line of a text of bricks, whatever is wrong with the rest."""
_FACES = np.array(
    [(0, 2, 3), (0, 3, 1), (4, 5, 7), (4, 7, 6), (0, 1, 5), (0, 5, 4),
     (2, 6, 7), (2, 7, 3), (0, 4, 6), (0, 6, 2), (1, 3, 7), (1, 7, 5)]
)  # fmt: skip


@dataclass(frozen=True)
class Brick:
    """A brick or plate on the grid."""

    low: tuple[int, int, int]
    """Lowest corner in LDU, z up."""
    studs: tuple[int, int]
    """Along x and y."""
    height: int = HEIGHT
    """In LDU: `HEIGHT`, or `PLATE`."""

    @property
    def mass(self) -> float:
        """Mass in kg."""
        narrow, wide = sorted(self.studs)
        base, one, more = _OTHER_MASS
        grams = _MASSES.get((narrow, wide), base + narrow * wide * (one if narrow == 1 else more))
        stud = 1e3 * UNIT * PITCH
        length, width = (stud * count - 2e3 * _PLAY for count in (wide, narrow))
        sides = 2.0 * _WALL * (length + width - 2.0 * _WALL)
        inside = _POST * (wide - 1) if narrow == 1 else _TUBE * (wide - 1) * (narrow - 1)
        return 1e-3 * (grams - _ABS * 1e3 * UNIT * (HEIGHT - self.height) * (sides + inside))


def assemble_bricks(
    bricks: Sequence[Brick],
    *,
    name: str = "bricks",
    density: ArrayLike | None = None,
    boundary: ArrayLike | None = None,
    tension: float = STUD_TENSION,
) -> Assembly:
    """Make an assembly of bricks, joined by their studs.

    Bricks that have nothing below stand on the studs of a baseplate, the last part, if they are in the lowest layer.
    Sides of bricks do not touch: there is play between them.

    Args:
        bricks: in any order.
        name: how plans and messages call the structure.
        density: kg/m3 of the boxes around the bricks, one number or one a brick; by default from their masses.
        boundary: fixed bricks, by number or name; without them, the baseplate.
        tension: that each contact point of a stud bears, N.

    Raises:
        AssemblyError: bricks that overlap, studs that do not meet, or a brick that is joined to no other.
    """
    if not bricks:
        raise AssemblyError("an assembly needs at least one brick")
    if not (np.isfinite(tension) and tension >= 0):
        raise AssemblyError(f"the tension of a stud is {tension:g} N; give a number from 0 up")
    low = np.array([brick.low for brick in bricks])
    high = low + np.array([(PITCH * brick.studs[0], PITCH * brick.studs[1], brick.height) for brick in bricks])
    meshes = [_box(str(number), UNIT * a, UNIT * b) for number, (a, b) in enumerate(zip(low, high, strict=True))]
    plate = boundary is None
    masses = np.array([brick.mass for brick in bricks])
    volumes = np.array([mesh.volume for mesh in meshes])
    densities = np.broadcast_to(masses / volumes if density is None else np.asarray(density, float), len(bricks))
    if plate:
        ground = low[:, 2].min()
        margin = [PITCH, PITCH, 0]
        below, top = low.min(axis=0) - margin, high.max(axis=0) + margin
        corner = UNIT * np.array([below[0], below[1], ground]) - [0.0, 0.0, _BASE]
        meshes.append(_box("baseplate", corner, UNIT * np.array([top[0], top[1], ground])))
        boundary = [len(bricks)]
        densities = np.append(densities, 1000.0)
    contacts = _contacts(bricks, low, high, plate)
    assembly = Assembly.from_meshes(
        meshes, boundary=boundary, density=densities, friction=STUD_FRICTION, name=name, contacts=contacts
    )
    point = np.diff(contacts.start) * tension / contacts.areas
    return assembly.replace(joints=Joints.from_arrays(contacts, tension=point, ductile=True))


def _box(name: str, low: Array, high: Array) -> TriangleMesh:
    corners = np.array([[x, y, z] for z in (0, 1) for y in (0, 1) for x in (0, 1)])
    inner = np.array([_PLAY, _PLAY, 0.0])
    return TriangleMesh.from_arrays(name, low + inner + corners * (high - low - 2 * inner), _FACES)


def _contacts(bricks: Sequence[Brick], low: NDArray, high: NDArray, plate: bool) -> Contacts:
    """Return one contact of each pair of bricks of which one lies on the other, with the points of their studs."""
    common = np.minimum(high[:, None, :2], high[None, :, :2]) - np.maximum(low[:, None, :2], low[None, :, :2])
    meet = (common > 0).all(axis=2)
    deep = np.minimum(high[:, None, 2], high[None, :, 2]) - np.maximum(low[:, None, 2], low[None, :, 2])
    through = np.argwhere(np.triu(meet & (deep > 0), 1))
    if len(through):
        raise AssemblyError("bricks {} and {} overlap; move one of them".format(*through[0].tolist()))
    parts, frames, points, start, areas = [], [], [], [0], []
    pairs = [(below, above) for below, above in np.argwhere(meet & (high[:, None, 2] == low[None, :, 2])).tolist()]
    if plate:
        pairs += [(len(bricks), above) for above in np.flatnonzero(low[:, 2] == low[:, 2].min()).tolist()]
    for below, above in sorted(pairs, key=sorted):
        first, last = low[above], high[above]
        if below < len(bricks):
            if ((low[below, :2] - first[:2]) % PITCH).any():
                raise AssemblyError(
                    f"brick {above} lies on brick {below}, but their studs do not meet; move one by whole studs"
                )
            first, last = np.maximum(first, low[below]), np.minimum(last, high[below])
        x, y = (np.arange(a, b, PITCH) + PITCH / 2 for a, b in zip(first[:2], last[:2], strict=True))
        axes = np.array(np.meshgrid(x, y, indexing="ij")).reshape(2, -1).T
        around = _AROUND[4 if min(bricks[above].studs) == 1 else 3]
        plane = (axes[:, None] + PITCH * around).reshape(-1, 2)
        up = 1.0 if below < above else -1.0
        parts.append(sorted((below, above)))
        frames.append([[0.0, 0.0, up], [1.0, 0.0, 0.0], [0.0, up, 0.0]])
        points.append(UNIT * np.column_stack([plane, np.full(len(plane), low[above, 2])]))
        start.append(start[-1] + len(plane))
        areas.append(_STIFF * (PITCH * UNIT) ** 2 * len(axes))
    return Contacts(
        np.array(parts, np.int32).reshape(-1, 2),
        np.array(frames).reshape(-1, 3, 3),
        np.concatenate([np.zeros((0, 3)), *points]),
        np.array(start, np.int32),
        np.array(areas),
    )


def _is_bricks(path: Path) -> bool:
    """Return whether a file holds bricks: an LDraw model, or text as BrickGPT writes it."""
    if path.suffix.lower() != ".txt":
        return True
    lines = (line for line in _text(path).splitlines() if line.strip())
    return _BEGINNING.match(next(lines, "")) is not None


def load_bricks(path: Path | str, **options: Any) -> Assembly:
    """Read an assembly of bricks.

    Text has a brick a line, such as `2x4 (3,0,1)`: studs along x and y, and the place of its lowest corner in studs and
    layers (BrickGPT, StableText2Brick). An LDraw model (`.ldr`, `.mpd`) may have upright bricks and plates, and models
    within the file.

    Args:
        options: density and boundary, as for `assemble_bricks`; boundary also by name.
    """
    path = Path(path)
    given = {key: value for key, value in options.items() if value is not None and value is not False}
    for key in given:
        if key not in ("density", "boundary"):
            raise InputError(f"{path} has bricks, which have their own {key}; leave it out")
    assembly = assemble_bricks(_read(path), name=path.stem, **given)
    if "boundary" not in given:
        warn_of(path, "no brick is fixed; a baseplate under the lowest layer was added as the last part")
    return assembly


def read_bricks(path: Path | str, *, unit: str | None = None) -> Draft:
    """Read bricks and their baseplate as parts of their own, without the studs."""
    if unit is not None:
        raise InputError(f"{path} has bricks, which have their own unit; leave it out")
    assembly = assemble_bricks(_read(Path(path)))
    parts = zip(assembly.meshes, assembly.boundary.tolist(), strict=True)
    return Draft.from_blocks(
        Path(path), 1.0, [Block(mesh.name, mesh.vertices, mesh.faces.tolist(), fixed) for mesh, fixed in parts]
    )


def _read(path: Path) -> list[Brick]:
    bricks, studs = [], 0
    for brick in _read_text(path) if path.suffix.lower() == ".txt" else _read_ldraw(path):
        bricks.append(brick)
        studs += brick.studs[0] * brick.studs[1]
        if len(bricks) > _MOST_BRICKS or studs > _MOST_STUDS:
            raise InputError(f"{path} has more than {_MOST_BRICKS} bricks or {_MOST_STUDS} studs; write fewer")
    return bricks


def _text(path: Path) -> str:
    try:
        return read_text(path, errors="replace")
    except OSError as error:
        raise InputError(f"cannot read {path}: {error.strerror or error}") from error


def _read_text(path: Path) -> Iterator[Brick]:
    for number, line in enumerate(_text(path).splitlines(), 1):
        if not line.strip():
            continue
        found = _LINE.fullmatch(line)
        along, across, x, y, z = (int(value) for value in found.groups()) if found else (0,) * 5
        if along == 0 or across == 0:
            raise InputError(
                f"{path}, line {number}: {line.strip()[:40]!r} is not a brick such as 2x4 (3,0,1), "
                "in whole numbers from 0 up"
            )
        yield Brick((PITCH * x, PITCH * y, HEIGHT * z), (along, across))


def _read_ldraw(path: Path) -> Iterator[Brick]:
    models: dict[str, list[tuple[int, list[str]]]] = {}
    name: str | None = ""
    drawn = hidden = 0
    for number, line in enumerate(_text(path).splitlines(), 1):
        words = line.split()
        meta = [word.upper() for word in words[:3]] if words[:1] == ["0"] else []
        if meta[:2] == ["0", "FILE"]:
            name = " ".join(words[2:]).lower()
            if name in models:
                raise InputError(f"{path}, line {number}: there are two models {name}; give each a name of its own")
        elif meta[:2] == ["0", "NOFILE"]:
            name = None
        elif meta[:2] == ["0", "BUFEXCHG"]:
            raise InputError(f"{path}, line {number}: bricks come and go (BUFEXCHG); export the model as it is built")
        elif meta == ["0", "MLCAD", "HIDE"] or meta[:2] == ["0", "GHOST"]:
            hidden += 1
        elif words[:1] == ["1"] and name is not None:
            models.setdefault(name, []).append((number, words))
        elif words and words[0] != "0":
            drawn += 1
    if not models:
        raise InputError(f"{path} has no parts; export the model as LDraw again")
    main = "" if "" in models else next(iter(models))
    used: set[str] = set()
    yield from _bricks_of(path, models, main, np.eye(4), (), used)
    if drawn:
        warn_of(path, f"lines and faces that are drawn beside bricks were left out: {drawn}")
    if hidden:
        warn_of(path, f"hidden bricks were left out: {hidden}")
    if lost := [model for model in models if model not in (used | {main})]:
        warn_of(path, f"models that the first one does not contain were left out: {listed(lost)}")


def _bricks_of(
    path: Path,
    models: Mapping[str, list[tuple[int, list[str]]]],
    name: str,
    place: Array,
    within: tuple[str, ...],
    used: set[str],
) -> Iterator[Brick]:
    """Yield the bricks of a model at a place, which is a matrix in LDU and the axes of LDraw; note models in it."""
    for number, words in models[name]:
        try:
            x, y, z, *turn = (float(word) for word in words[2:14])
            own = np.array([[*turn[0:3], x], [*turn[3:6], y], [*turn[6:9], z], [0.0, 0.0, 0.0, 1.0]])
        except ValueError:
            own = np.full((4, 4), np.nan)
        if not np.isfinite(own).all():
            raise InputError(f"{path}, line {number}: no place and turn of a part; export the model again")
        part, here = " ".join(words[14:]).lower(), place @ own
        if part in models:
            if len(within) == _DEEPEST:
                raise InputError(f"{path}, line {number}: models are nested deeper than {_DEEPEST}; write them flat")
            if part in within:
                raise InputError(f"{path}, line {number}: model {part} contains itself; mend the file")
            used.add(part)
            yield from _bricks_of(path, models, part, here, (*within, part), used)
            continue
        known = _PARTS.get(part.removesuffix(".dat"))
        if known is None:
            names = ", ".join(_PARTS)
            raise InputError(f"{path}, line {number}: part {part or '(none)'} is not a known brick: {names}")
        studs, height = known
        # LDraw's y points down; a brick hangs from the middle of its top.
        half = np.abs(here[:3, :3] @ [PITCH / 2 * studs[0], 0.0, PITCH / 2 * studs[1]])
        upright = np.allclose(here[:3, 1], [0.0, 1.0, 0.0], atol=1e-4)
        upright &= np.allclose(here[:3, :3].T @ here[:3, :3], np.eye(3), atol=1e-3)
        low = np.array([here[0, 3] - half[0], here[2, 3] - half[2], -here[1, 3] - height])
        size = 2 * half[[0, 2]] / PITCH
        if not upright or np.abs(size - size.round()).max() > 1e-3 or np.abs(low - low.round()).max() > 1e-2:
            raise InputError(
                f"{path}, line {number}: brick {part} is not upright along the axes, or scaled; turn or move it"
            )
        whole = low.round().astype(int).tolist()
        yield Brick((whole[0], whole[1], whole[2]), (int(size[0].round()), int(size[1].round())), height)


READER = Reader((".ldr", ".mpd", ".txt"), load_bricks, read_bricks, _is_bricks)
