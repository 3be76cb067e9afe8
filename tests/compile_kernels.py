"""Compilation of the kernels that the tests run, in two parallel processes; numba caches beside the sources."""

from __future__ import annotations

from concurrent.futures import ProcessPoolExecutor
from multiprocessing import get_context

import numpy as np

from falsework import Assembly, StabilitySettings, load_structure
from falsework.assembly import States, complete_state
from falsework.stability.problem import Problem, build_problem


def _arch() -> tuple[Assembly, States, Problem]:
    assembly = load_structure("arch:blocks=5")
    return assembly, np.stack([complete_state(assembly.boundary)] * 2), build_problem(assembly)


def _portable() -> None:
    from falsework.stability.contact.replay import Replayer
    from falsework.stability.contact.solver import ContactSolver

    assembly, states, problem = _arch()
    ContactSolver(assembly, problem, StabilitySettings()).check(states, parents=states)
    Replayer(assembly).replay(states)


def _motion() -> None:
    from falsework.robots.cells.warm_up import compile_kernels

    compile_kernels()


def _judge() -> None:
    from falsework.stability.judges.discrete_elements import BuildJudge

    assembly, states, _ = _arch()
    BuildJudge(assembly).judge(states[:1], [()])


def _picture() -> None:
    from falsework.viewer import Camera
    from falsework.viewer.pictures.render import ColoredSolid, render

    assembly, _, _ = _arch()
    colours = ((1.0, 0.0, 0.0), 1.0), ((0.0, 1.0, 0.0), 0.5)
    solids = [
        ColoredSolid(mesh.vertices, mesh.faces, *colour) for mesh, colour in zip(assembly.meshes, colours, strict=False)
    ]
    render(solids, Camera(width=64, height=48), np.array([[-2.0, -2.0, -2.0], [2.0, 2.0, 2.0]]))


def _clearance() -> None:
    from falsework.geometry.clearance.table import StraightWays

    assembly, states, _ = _arch()
    StraightWays(assembly.meshes, assembly.contacts, tolerance=1e-4).table.can_leave(states)


if __name__ == "__main__":
    with ProcessPoolExecutor(2, mp_context=get_context("spawn")) as pool:
        for done in [*map(pool.submit, (_motion, _judge, _portable, _picture, _clearance))]:
            done.result()
