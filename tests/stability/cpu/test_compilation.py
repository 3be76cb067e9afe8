"""One compilation of the kernels serves every batch of states and every structure."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework.assembly import Assembly, load_structure
from falsework.assembly.library.blocks import box, gather
from falsework.assembly.state import complete_state
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.replay_kernel import replay_range
from falsework.stability.contact.solver import ContactSolver, _judge_range
from falsework.stability.cpu.kernel import solve_range
from falsework.stability.cpu.neighbourhood import solve_range_near
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.problem import build_problem
from falsework.stability.settings import StabilitySettings

KERNELS = (_judge_range, solve_range, solve_range_near, replay_range)


def judge_all(assembly: Assembly, states: NDArray[np.uint8]) -> None:
    """Call every kernel on a batch."""
    settings = StabilitySettings()
    problem = build_problem(assembly, cone=settings.friction_cone, gravity=settings.gravity)
    for solver in (ContactSolver(assembly, problem, settings), CpuSolver(problem, settings)):
        solver.check(states)
        solver.check(states, parents=states)
    Replayer(assembly).replay(states)


@pytest.fixture(scope="module")
def arch() -> Assembly:
    """An arch, on whose states every kernel has run once."""
    assembly = load_structure("arch:blocks=5")
    judge_all(assembly, np.stack([complete_state(assembly.boundary)] * 2))
    return assembly


@pytest.mark.parametrize("case", ["read-only states", "every second state", "a structure without contacts"])
def test_no_kernel_is_compiled_twice(arch: Assembly, case: str) -> None:
    compiled = [list(kernel.signatures) for kernel in KERNELS]
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
    assert [list(kernel.signatures) for kernel in KERNELS] == compiled
