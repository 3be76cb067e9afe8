"""Exploration of solvable states: what it finds is solvable, new, and farther from the data than blind moves lead."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import Direction, StabilityOracle, StabilitySettings, load_structure, make_task  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn import Curriculum, Environment, PpoPhase  # noqa: E402
from falsework.learn.algorithms.exploration import Exploration  # noqa: E402
from falsework.learn.data.solvable_states import SolvableStates  # noqa: E402
from falsework.search import BeamSearch, BeamSettings  # noqa: E402
from falsework.stability.settings import EQUILIBRIUM  # noqa: E402


def found(name: str, settings: StabilitySettings = StabilitySettings(), width: int = 4) -> tuple[Environment, Any]:
    """Return an environment, and the states of a narrow search from the empty structure."""
    assembly = load_structure(name)
    oracle = StabilityOracle(assembly, settings)
    search = BeamSearch(make_task(assembly), oracle, BeamSettings(width, Direction.ASSEMBLY))
    search.run()
    return Environment(assembly, 2, oracle=oracle, device="cpu"), torch.from_numpy(search.states())


@pytest.fixture
def generator() -> Any:
    return torch.Generator().manual_seed(0)


def stored(solved: SolvableStates, states: Any) -> Any:
    """Return which states are in a set."""
    known = {bytes(row) for row in solved.states.numpy()}
    return torch.tensor([bytes(row) in known for row in np.asarray(states)])


@pytest.mark.parametrize("settings", [StabilitySettings(), EQUILIBRIUM])
def test_explored_states_are_stable_and_lead_to_the_end(settings, generator) -> None:
    """From each of them a stable action leads to another one, or to a state of the data."""
    environment, states = found("arch:blocks=7", settings)
    solved = SolvableStates(environment.rules, states)
    exploration = Exploration(environment, solved, states)
    exploration.draw(64, int(environment.rules.steps_left(states).max()), generator)
    explored = exploration.tensors()["explored"]
    assert len(explored) > 30
    assert environment.stable(explored).all()
    assert not stored(SolvableStates(environment.rules, states), explored).any()
    assert len(torch.unique(explored, dim=0)) == len(explored)
    archive = SolvableStates(environment.rules, torch.cat([states, explored]))
    mask = environment.rules.moves(explored)
    assert archive.valid_actions(explored, mask).any(dim=1).all()
    assert stored(solved, explored).all()


def test_drawn_states_are_within_the_horizon_and_evenly_far_from_the_end(generator) -> None:
    environment, states = found("arch:blocks=9", EQUILIBRIUM)
    exploration = Exploration(environment, SolvableStates(environment.rules, states), states)
    left = environment.rules.steps_left(exploration.draw(4000, 6, generator))
    assert left.max() == 6
    counts = torch.bincount(left).double()
    assert (counts - counts.mean()).abs().max() < 6 * counts.mean().sqrt()
    assert len(exploration.draw(8, -1, generator)) == 0


def test_states_far_from_the_data_are_left_first(generator) -> None:
    """Beside moves that begin anywhere, as many moves lead farther."""
    environment, states = found("dome:rings=3,blocks=8", EQUILIBRIUM, 16)
    horizon = int(environment.rules.steps_left(states).max())
    means = []
    for compared in (16, 1):
        exploration = Exploration(environment, SolvableStates(environment.rules, states), states, compared)
        for _ in range(4):
            exploration.draw(32, horizon, generator.manual_seed(0))
        means.append(exploration.mean_distance)
    assert means[0] > 1.5 * means[1]


def test_held_out_states_are_reported_and_never_left(generator) -> None:
    environment, states = found("arch:blocks=7", EQUILIBRIUM)
    first = Exploration(environment, SolvableStates(environment.rules, states), states)
    first.draw(64, 20, generator)
    held_out = first.tensors()["explored"][::2]
    solved = SolvableStates(environment.rules)
    solved.hold_out(held_out)
    solved.add(states)
    environment.record = solved.record_visits
    exploration = Exploration(environment, solved, states)
    exploration.draw(64, 20, generator)
    environment.record = None
    assert len(exploration) > len(states)
    assert not solved.is_held_out(exploration.tensors()["explored"]).any()
    assert solved.visited > 0


def test_an_archive_goes_on_where_it_was_saved(generator) -> None:
    environment, states = found("arch:blocks=7", EQUILIBRIUM)
    saved = Exploration(environment, SolvableStates(environment.rules, states), states)
    saved.draw(32, 20, generator)
    solved = SolvableStates(environment.rules, torch.cat([states, saved.tensors()["explored"]]))
    resumed = Exploration(environment, solved, states)
    resumed.load(saved.tensors())
    assert resumed.mean_distance == saved.mean_distance
    one, other = (each.draw(32, 20, generator.manual_seed(3)) for each in (saved, resumed))
    assert torch.equal(one, other)


def test_a_share_of_the_starts_is_explored(generator) -> None:
    environment, states = found("arch:blocks=7", EQUILIBRIUM)
    solved = SolvableStates(environment.rules, states)
    exploration = Exploration(environment, solved, states)
    starts = Curriculum(states, environment.rules, solved=solved, anywhere=0.25, exploration=exploration, explored=0.25)
    assert starts.report()["explored"] == len(states)
    batch: Any = starts.sample(40, generator)
    assert len(batch.rows) == 20
    assert len(batch.states) == len(batch.entropy) == len(batch.weight) == 40
    assert starts.report()["explored"] > len(states)
    assert "explored" in starts.local_state_dict()
    with pytest.raises(InputError, match=r"explored are 0\.6 and 0\.6 of the rollouts; give shares"):
        PpoPhase(anywhere=0.6, explored=0.6)
