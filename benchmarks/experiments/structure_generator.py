"""Generated structures of many families and sizes: what a policy for all structures is trained and tested on.

A number stands for one structure with its task, always the same: family, parameters, robots and criterion are drawn
from it.
"""

from __future__ import annotations

import sys
import warnings
from collections.abc import Callable, Iterator
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))

from experiments import families
from shells import FAMILIES as SHELLS

from falsework import Assembly, StabilityOracle, StabilitySettings, load_structure
from falsework.assembly import ContactWarning, complete_state
from falsework.errors import InputError
from falsework.geometry import TriangleMesh
from falsework.stability.verdict import Criterion

Draw = np.random.Generator
_LEAST, _MOST = 3, 150
"""Parts that are not boundary."""
_ROBOTS = (0.15, 0.45, 0.2, 0.2)
"""Frequencies of structures built by one, two, three and four robots."""
_FRICTION = (0.4, 0.9)


def _size(draw: Draw, least: int, most: int) -> int:
    """Draw a number, small ones as often as large ones by their logarithm."""
    return round(float(np.exp(draw.uniform(np.log(least), np.log(most)))))


def _arch(draw: Draw) -> str:
    return f"arch:blocks={_size(draw, 3, 40)},thickness={draw.uniform(0.12, 0.45):.3f}"


def _catenary(draw: Draw) -> str:
    rise, thickness = draw.uniform(0.5, 1.8), draw.uniform(0.05, 0.2)
    return f"catenary:blocks={_size(draw, 3, 40)},rise={rise:.3f},thickness={thickness:.3f}"


def _wall(draw: Draw) -> str:
    length, height = draw.uniform(0.15, 0.35), draw.uniform(0.05, 0.15)
    return f"wall:bricks={_size(draw, 2, 13)},courses={_size(draw, 2, 12)},length={length:.3f},height={height:.3f}"


def _dome(draw: Draw) -> str:
    rings, blocks = _size(draw, 1, 9), _size(draw, 4, 18)
    return f"dome:rings={rings},blocks={blocks},thickness={draw.uniform(0.08, 0.3):.3f},stagger={draw.integers(0, 2)}"


def _vault(draw: Draw) -> str:
    rise, thickness = draw.uniform(0.8, 1.4), draw.uniform(0.1, 0.2)
    return f"vault:parts={_size(draw, 30, 150)},rise={rise:.2f},thickness={thickness:.3f}"


def _stack(draw: Draw) -> str:
    overhang, height = draw.uniform(0.3, 0.98), draw.uniform(0.08, 0.2)
    return f"stack:blocks={_size(draw, 3, 20)},overhang={overhang:.3f},height={height:.3f}"


def _corbel(draw: Draw) -> str:
    return f"corbel:courses={_size(draw, 2, 20)},span={draw.uniform(0.6, 1.2):.3f}"


def _bottle(draw: Draw) -> str:
    width, height = draw.integers(5, 11), draw.integers(8, 21)
    return f"bottle:pieces={_size(draw, 6, 40)},width={width},height={height},seed={draw.integers(1, 10**6)}"


def _polycube(draw: Draw) -> str:
    return f"polycube:pieces={_size(draw, 5, 40)},size={draw.integers(3, 7)},seed={draw.integers(1, 10**6)}"


def _house(draw: Draw) -> str:
    return f"house:storeys={draw.integers(1, 8)},height={draw.uniform(0.2, 0.35):.3f},pitch={draw.uniform(10, 25):.2f}"


def _built_in(recipe: Callable[[Draw], str], draw: Draw) -> Assembly:
    return load_structure(recipe(draw))


_BUILT_IN = (_arch, _catenary, _wall, _dome, _vault, _stack, _corbel, _bottle, _polycube, _house)
FAMILIES: dict[str, Callable[[Draw], Assembly]] = {
    **{recipe.__name__[1:]: partial(_built_in, recipe) for recipe in _BUILT_IN},
    **{family.__name__: family for family in (families.opening, families.chimney, families.voronoi, families.pile)},
    **{name: SHELLS[name] for name in ("barrel", "arcade", "groin")},
    **{family.__name__: family for family in (families.frame, families.sail)},
    **{family.__name__: family for family in (families.tower, families.cells, families.flat)},
}
"""By name; what is drawn depends on the place in this list, so new ones come last."""
UNSEEN = ("groin",)
"""Families that no training sees."""
HELD_OUT = ("tower", "cells", "flat")
"""Families to choose by how a policy is trained: no training sees them, and they are no test."""
TRAINED = tuple(name for name in FAMILIES if name not in (*UNSEEN, *HELD_OUT))
"""Families to train on."""


@dataclass(frozen=True, eq=False)
class GeneratedTask:
    """One structure, and how it is to be built."""

    name: str
    """Family and number, such as `arch-17`."""
    family: str
    assembly: Assembly
    robots: int
    criterion: Criterion


def generated(number: int, choice: tuple[str, ...] = TRAINED) -> GeneratedTask:
    """Return the structure of a number.

    Args:
        number: zero or more.
        choice: families, which take turns.

    Raises:
        InputError: an unknown family, or a hundred draws none of which stands.
    """
    for family in choice:
        if family not in FAMILIES:
            raise InputError(f"no family of structures is called {family!r}; there are {', '.join(FAMILIES)}")
    family = choice[number % len(choice)]
    draw = np.random.default_rng([number, tuple(FAMILIES).index(family)])
    robots = 1 + int(draw.choice(len(_ROBOTS), p=_ROBOTS))
    criterion: Criterion = "equilibrium" if draw.integers(2) else "contact"
    for _ in range(100):
        with warnings.catch_warnings():
            warnings.simplefilter("ignore", ContactWarning)
            try:
                assembly = FAMILIES[family](draw).at_friction(float(draw.uniform(*_FRICTION)))
            except InputError:
                continue
        if _LEAST <= int((~assembly.boundary).sum()) <= _MOST and stands(assembly, criterion):
            return GeneratedTask(f"{family}-{number}", family, assembly, robots, criterion)
    raise InputError(f"no draw of {family}-{number} stands and has {_LEAST} to {_MOST} parts")


def named(name: str) -> GeneratedTask:
    """Return the structure of a name such as `arch-17`."""
    family, _, number = name.rpartition("-")
    return generated(int(number), (family,))


def stands(assembly: Assembly, criterion: Criterion) -> bool:
    """Return whether the complete structure is proven stable."""
    oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion))
    return bool(oracle.verdicts(complete_state(assembly.boundary)).stable[0])


def turned(assembly: Assembly, angle: float) -> Assembly:
    """The same structure turned about the vertical by an angle in radians: nothing that matters changes.

    Raises:
        InputError: rounding made the turned parts touch differently.
    """
    c, s = np.cos(angle), np.sin(angle)
    turn = np.array([[c, -s, 0.0], [s, c, 0.0], [0.0, 0.0, 1.0]])
    meshes = [TriangleMesh.from_arrays(mesh.name, mesh.vertices @ turn.T, mesh.faces) for mesh in assembly.meshes]
    return Assembly.from_meshes(
        meshes,
        boundary=assembly.boundary,
        density=assembly.density,
        friction=assembly.friction,
        name=assembly.name,
        contact_settings=assembly.contact_settings,
    )


def rotated_copies(assembly: Assembly, count: int, draw: np.random.Generator) -> Iterator[Assembly]:
    """The structure as it is, and turned about the vertical by random angles, to learn that directions mean nothing.

    Args:
        assembly: the structure.
        count: how many, the one as it is included.
        draw: source of angles.
    """
    yield assembly
    for _ in range(count - 1):
        try:
            yield turned(assembly, float(draw.uniform(0, 2 * np.pi)))
        except InputError:
            yield assembly
