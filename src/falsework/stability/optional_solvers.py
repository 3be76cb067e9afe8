"""Solvers that need optional packages or devices, where the settings ask for them."""

from __future__ import annotations

from typing import TYPE_CHECKING

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.stability.gpu.solver import GpuSolver
from falsework.stability.problem import Problem
from falsework.stability.settings import StabilitySettings

if TYPE_CHECKING:
    from falsework.stability.reference.gurobi import GurobiSolver


def gurobi_solver(assembly: Assembly, settings: StabilitySettings, problem: Problem) -> GurobiSolver | None:
    """Return the Gurobi solver if the settings ask for it."""
    if settings.solver != "gurobi":
        return None
    from falsework.stability.reference.gurobi import GurobiSolver

    return GurobiSolver(assembly, settings, problem)


def gpu_solver(assembly: Assembly, settings: StabilitySettings, problem: Problem) -> GpuSolver | None:
    """Return the GPU solver if the settings ask for it; with `auto`, only where there is a GPU."""
    if settings.solver not in ("auto", "gpu"):
        return None
    try:
        return GpuSolver(assembly, problem, settings)
    except InputError:  # no torch, no bindings or no device
        if settings.solver == "gpu":
            raise
        return None
