"""The portable code of the kernels serves every batch of states and every structure, without numba."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilitySettings, load_structure
from falsework.assembly import complete_state
from falsework.assembly.library.blocks import box, gather
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.problem import build_problem


def judge_all(assembly: Assembly, states: NDArray[np.uint8]) -> None:
    """Call every kernel on a batch."""
    settings = StabilitySettings()
    problem = build_problem(assembly, cone=settings.friction_cone, gravity=settings.gravity)
    for solver in (ContactSolver(assembly, problem, settings), CpuSolver(problem, settings)):
        solver.check(states)
        solver.check(states, parents=states)
    Replayer(assembly).replay(states)


@pytest.mark.usefixtures("without_numba")
@pytest.mark.parametrize("case", ["read-only states", "every second state", "a structure without contacts"])
def test_no_kernel_needs_numba(case: str) -> None:
    arch = load_structure("arch:blocks=5")
    states = np.stack([complete_state(arch.boundary)] * 4)
    if case == "read-only states":
        states.setflags(write=False)
    elif case == "every second state":
        states = np.asfortranarray(states)[::2]
    else:
        solids = gather([box("a", (0, 0, 0), (1, 1, 1), fixed=True), box("b", (5, 5, 0), (6, 6, 1), fixed=True)])
        arch = Assembly.from_meshes(solids.meshes, boundary=solids.boundary, name="apart")
        states = np.stack([complete_state(arch.boundary)] * 2)
    judge_all(arch, states)
