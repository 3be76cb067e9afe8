"""Families of generated structures, with states to learn from: what a policy for many structures is trained on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass

import numpy as np
import torch

from falsework.assembly import load_structure
from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.geometry.mesh.mesh import TriangleMesh
from falsework.learn.data.dataset import search_states, task_for
from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.search.device.oracle import HostOracle
from falsework.stability.oracle import Stability
from falsework.utils.tensors import choose_device

Draw = np.random.Generator


def _arch(draw: Draw) -> str:
    return f"arch:blocks={draw.integers(3, 13)},thickness={draw.uniform(0.15, 0.45):.3f}"


def _catenary(draw: Draw) -> str:
    return f"catenary:blocks={draw.integers(3, 13)},rise={draw.uniform(0.5, 1.8):.3f}"


def _wall(draw: Draw) -> str:
    length, height = draw.uniform(0.15, 0.35), draw.uniform(0.05, 0.15)
    return f"wall:bricks={draw.integers(2, 5)},courses={draw.integers(2, 6)},length={length:.3f},height={height:.3f}"


def _dome(draw: Draw) -> str:
    rings, blocks = draw.integers(1, 4), draw.integers(4, 8)
    return f"dome:rings={rings},blocks={blocks},thickness={draw.uniform(0.1, 0.3):.3f},stagger={draw.integers(0, 2)}"


def _stack(draw: Draw) -> str:
    overhang, height = draw.uniform(0.3, 0.98), draw.uniform(0.08, 0.2)
    return f"stack:blocks={draw.integers(3, 11)},overhang={overhang:.3f},height={height:.3f}"


def _corbel(draw: Draw) -> str:
    return f"corbel:courses={draw.integers(2, 8)},span={draw.uniform(0.6, 1.2):.3f}"


def _bottle(draw: Draw) -> str:
    return f"bottle:pieces={draw.integers(6, 16)},seed={draw.integers(1, 10**6)}"


def _polycube(draw: Draw) -> str:
    return f"polycube:pieces={draw.integers(6, 16)},size={draw.integers(3, 5)},seed={draw.integers(1, 10**6)}"


KINDS: dict[str, Callable[[Draw], str]] = {
    "arch": _arch,
    "catenary": _catenary,
    "wall": _wall,
    "dome": _dome,
    "stack": _stack,
    "corbel": _corbel,
    "bottle": _bottle,
    "polycube": _polycube,
}
"""Recipes: each draws the parameters of one built-in structure and returns it as text."""


@dataclass(frozen=True, eq=False)
class TrainingInstance:
    """One structure of a family, with states that are known to be solvable."""

    name: str
    assembly: Assembly
    environment: Environment
    solved: SolvableStates


def specifications(kinds: tuple[str, ...], seed: int, avoid: frozenset[str] = frozenset()) -> Iterator[str]:
    """Structures as text, for ever, the kinds in turn, none twice and none of `avoid`.

    Raises:
        InputError: a kind that is not in `KINDS`.
    """
    for kind in kinds:
        if kind not in KINDS:
            raise InputError(f"no family of structures is called {kind!r}; there are {', '.join(KINDS)}")
    draw = np.random.default_rng(seed)
    seen = set(avoid)
    while True:
        for kind in kinds:
            name = KINDS[kind](draw)
            if name not in seen:
                seen.add(name)
                yield name


def members(
    count: int,
    *,
    kinds: tuple[str, ...] = tuple(KINDS),
    seed: int = 0,
    avoid: frozenset[str] = frozenset(),
    robots: int = 2,
    width: int = 64,
    device: torch.device | str = "cpu",
    report: Callable[[str], None] | None = None,
) -> list[TrainingInstance]:
    """Make structures, and search them from the empty structure.

    Parameters that make no structure, and structures that these robots cannot build or that the search does not
    finish, are passed over for the next.

    Args:
        count: structures wanted.
        kinds: recipes, of `KINDS`.
        seed: of parameters and searches.
        avoid: structures that must not be among them, such as those of another family.
        robots: parts that may be held at once.
        width: of the searches.
        device: where.
        report: called with progress messages.

    Raises:
        InputError: an unknown kind, or hardly any parameters make a structure that can be built.
    """
    where = choose_device(str(device))
    found: list[TrainingInstance] = []
    for tried, name in enumerate(specifications(kinds, seed, avoid)):
        if len(found) == count:
            break
        if tried > 20 * count + 100:
            raise InputError(f"only {len(found)} of {tried} structures can be built; take other kinds or more robots")
        try:
            assembly = load_structure(name)
        except InputError:
            continue
        oracle = Stability(assembly)
        # On the processor wherever the policy is: these are small, and a GPU would compile its solver for each.
        states, complete = search_states(task_for(assembly, robots), HostOracle(oracle), width, seed + tried)
        if not complete:
            continue
        environment = Environment(assembly, robots, oracle=oracle, device=where)
        solved = SolvableStates(environment.rules, torch.from_numpy(states))
        found.append(TrainingInstance(name, assembly, environment, solved))
        if report is not None:
            report(f"{len(found)} of {count}: {name}, {len(solved)} states")
    return found


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
