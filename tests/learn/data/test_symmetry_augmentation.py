"""Tasks turned by the symmetries of their structure: tasks as good as those they come from."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import Assembly, StabilityOracle, StateGraph, load_structure  # noqa: E402
from falsework.learn import Environment, PolicySettings, TrainSettings  # noqa: E402
from falsework.learn.data.goal_dataset import GoalDataset, build_goal_dataset  # noqa: E402
from falsework.learn.data.random_walks import RandomWalkGoals  # noqa: E402
from falsework.learn.data.symmetry import symmetries  # noqa: E402
from falsework.learn.data.symmetry_augmentation import SymmetryAugmentation, turned_states  # noqa: E402
from falsework.learn.training.run_context import RunContext  # noqa: E402
from falsework.learn.training.training_data import collect_training_data  # noqa: E402
from falsework.search.device.oracle import HostOracle  # noqa: E402

CPU = torch.device("cpu")


@pytest.fixture(scope="module")
def dome() -> Assembly:
    return load_structure("dome:rings=2,blocks=6,stagger=0")


@pytest.fixture(scope="module")
def graph(dome: Assembly, searched_graph: Callable[..., StateGraph]) -> StateGraph:
    return searched_graph(dome, 6)


def drawn(tasks: Any, count: int, seed: int = 0) -> tuple[Any, Any, Any]:
    return tasks.draw(count, torch.Generator().manual_seed(seed))


def test_images_of_tasks_are_tasks(dome: Assembly, graph: StateGraph) -> None:
    """Legal first actions towards targets that can be reached, through states that stand: most of them new ones."""
    environment = Environment(dome, 2, device="cpu")
    states, targets, valid = drawn(
        SymmetryAugmentation(RandomWalkGoals(graph, device=CPU), symmetries(dome), device=CPU), 300
    )
    assert (valid.sum(dim=1) == 1).all()
    assert (environment.rules.moves(states, targets) | ~valid).all()
    assert environment.rules.contains(states, targets).all()
    after = environment.rules.follow(states, valid.long().argmax(dim=1))
    oracle = StabilityOracle(dome)
    for some in (states, targets, after):
        assert (oracle.verdicts(some.numpy()).verdict == 1).all()
    assert (graph.index.find(states.numpy()) < 0).mean() > 0.5


def test_a_turned_task_is_turned_as_a_whole(dome: Assembly, graph: StateGraph) -> None:
    images = symmetries(dome)
    whole = drawn(SymmetryAugmentation(RandomWalkGoals(graph, device=CPU), images, device=CPU), 50)
    plain = drawn(RandomWalkGoals(graph, device=CPU), 50)
    for row in range(50):
        fits = []
        for image in images:
            both = np.concatenate([image, image + dome.part_count])
            pieces = zip(whole, plain, (image, image, both), strict=True)
            fits.append(all(np.array_equal(one[row].numpy()[index], two[row].numpy()) for one, two, index in pieces))
        assert any(fits)


def test_no_task_begins_or_ends_with_a_forbidden_state(dome: Assembly, graph: StateGraph) -> None:
    """What would be turned into one stays as it was, which the source vouches for."""
    images = symmetries(dome)
    first = graph.states[graph.level == 1]
    held_out = np.unique(np.concatenate([first[:, np.argsort(image)] for image in images[1:]]), axis=0)
    kept = {tuple(state) for state in held_out.tolist()} - {tuple(state) for state in graph.states.tolist()}
    assert kept
    held_out = np.array(sorted(kept), dtype=np.uint8)
    source = RandomWalkGoals(graph, device=CPU)
    free = drawn(SymmetryAugmentation(source, images, device=CPU), 2000)
    careful = drawn(SymmetryAugmentation(source, images, device=CPU, held_out=held_out), 2000)
    met = [{tuple(state) for state in np.concatenate([one, two]).tolist()} for one, two, _ in (free, careful)]
    assert met[0] & kept
    assert not met[1] & kept


def test_same_seed_same_tasks(dome: Assembly, graph: StateGraph) -> None:
    tasks = SymmetryAugmentation(RandomWalkGoals(graph, device=CPU), symmetries(dome), device=CPU)
    assert all(torch.equal(one, two) for one, two in zip(drawn(tasks, 40), drawn(tasks, 40), strict=True))
    assert not torch.equal(drawn(tasks, 40)[0], drawn(tasks, 40, seed=1)[0])


def test_a_run_learns_from_images_and_never_from_test_states(dome: Assembly, monkeypatch: pytest.MonkeyPatch) -> None:
    """Tasks have states that its searches did not see; these, and what is learned from, are never test states."""
    settings = TrainSettings(
        policy=PolicySettings("transformer", goal_conditioned=True),
        widths=(8, 8),
        steps=10,
        random_tries=2,
        evaluation_states=32,
    )
    found: list[GoalDataset] = []

    def keep(*arguments: Any, **options: Any) -> GoalDataset:
        found.append(build_goal_dataset(*arguments, **options))
        return found[-1]

    monkeypatch.setattr("falsework.learn.training.training_data.build_goal_dataset", keep)
    data_of_run = collect_training_data(
        RunContext(dome, settings.resolved(dome.part_count, "cpu"), HostOracle(StabilityOracle(dome)), CPU)
    )
    (data,) = found
    assert isinstance(data_of_run.tasks, SymmetryAugmentation)
    test = {tuple(state) for state in data_of_run.held_out.tolist()}
    states, targets, _ = drawn(data_of_run.tasks, 1000, seed=3)
    for known in (data_of_run.starts, states, targets):
        assert not test & {tuple(state) for state in known.tolist()}
    for turned in (states, targets):
        assert (data.wide.index.find(turned.numpy()) < 0).any()


def test_a_policy_that_numbers_parts_learns_from_images_of_states(dome: Assembly) -> None:
    """They stand, and none of them is an image of a state that is held out."""
    oracle = StabilityOracle(dome)
    chosen: tuple[tuple[Any, Any], ...] = (("transformer", "wide"), ("resmlp", "width64"), ("resmlp", "wide"))
    plain, alone, turned = (
        collect_training_data(
            RunContext(
                dome,
                TrainSettings(policy=PolicySettings(kind), data=data, widths=(6, 6), evaluation_states=8),
                HostOracle(oracle),
                CPU,
            )
        )
        for kind, data in chosen
    )
    count = len(plain.starts)
    images = symmetries(dome)
    assert torch.equal(turned.starts[:count], plain.starts)
    assert len(turned.starts) == len(images) * count
    assert len(alone.starts) < count
    assert oracle.verdicts(turned.starts.numpy()).stable.all()
    held_out = {bytes(row) for row in turned.held_out.numpy()}
    assert not held_out & {bytes(row) for row in turned.starts.numpy()}


def test_no_more_images_than_wanted(dome: Assembly) -> None:
    states = torch.eye(dome.part_count, dtype=torch.uint8)
    images = symmetries(dome)
    some = turned_states(states, images, 3 * len(states) + 1)
    assert len(some) == 3 * len(states)
    assert torch.equal(some[len(states) :].argmax(dim=1), torch.as_tensor(images[1:3].ravel()))
    assert torch.equal(turned_states(states, images, 1), states)
