"""A small arch with a plan, for all tests of what people look at."""

from __future__ import annotations

from functools import cache
from typing import Any

import numpy as np
import pytest

from falsework.assembly import Assembly, load_structure
from falsework.search import Plan, find_plans, task_of
from falsework.viewer.timeline import Timeline


@cache
def planned(spec: str, robots: int = 2) -> tuple[Assembly, Plan]:
    """A built-in structure and a plan to take it apart."""
    assembly = load_structure(spec)
    return assembly, find_plans(assembly, task_of(assembly, robots)).plans[0]


@pytest.fixture(scope="session")
def arch() -> tuple[Assembly, Plan]:
    """An arch of five voussoirs and a plan for disassembly with two robots."""
    return planned("arch:blocks=5")


@pytest.fixture
def timeline(arch: tuple[Assembly, Plan]) -> Timeline:
    """The plan of the arch in the order of assembly."""
    assembly, plan = arch
    return Timeline.of(plan.reverse(), assembly)


@pytest.fixture(scope="session")
def policy(arch: tuple[Assembly, Plan]) -> Any:
    """An untrained policy for the arch, the same every time."""
    pytest.importorskip("torch", reason="policies need torch; pip install 'falsework[learn]'")
    from falsework.learn.config.policy import PolicySettings
    from falsework.learn.networks.factory import make_policy

    return make_policy(arch[0], PolicySettings(), "cpu", seed=0)


def down(assembly: Assembly, part: int) -> tuple[np.ndarray, np.ndarray]:
    """A ray from above through the middle of a part."""
    return assembly.mass.center[part] + [0.0, 0.0, 10.0], np.array([0.0, 0.0, -1.0])
