"""Fixtures of the tests of policies and training."""

from __future__ import annotations

from collections.abc import Callable

import pytest
import torch

from falsework import Assembly, Direction, StabilityOracle, StateGraph, load_structure
from falsework.learn.data.dataset import training_task
from falsework.search import BeamSearch, BeamSettings


@pytest.fixture(scope="session", autouse=True)
def one_thread() -> None:
    """Networks this small are slower on two threads, and far slower where other work keeps one of them waiting."""
    torch.set_num_threads(1)


@pytest.fixture(scope="session")
def bottle() -> Assembly:
    """A structure with few parts and many ways."""
    return load_structure("bottle")


@pytest.fixture(scope="session")
def searched_graph() -> Callable[..., StateGraph]:
    """Makes the graph of all states of a narrow search."""

    def search(assembly: Assembly, width: int, direction: Direction = Direction.DISASSEMBLY) -> StateGraph:
        task = training_task(assembly)
        beam = BeamSearch(task, StabilityOracle(assembly), BeamSettings(width=width, direction=direction))
        beam.run()
        return StateGraph.from_states(task, beam.states())

    return search


@pytest.fixture(scope="session")
def bottle_graph(bottle: Assembly, searched_graph: Callable[..., StateGraph]) -> StateGraph:
    """States of a narrow search that takes the bottle apart."""
    return searched_graph(bottle, 12)
