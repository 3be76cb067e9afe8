"""The Gymnasium face plays the same game as the environment on tensors, and passes Gymnasium's own check."""

from __future__ import annotations

import copy
import pickle
import subprocess
import sys
import warnings
from collections.abc import Callable

import numpy as np
import pytest

gymnasium = pytest.importorskip("gymnasium", reason="gymnasium is not installed: pip install 'falsework[learn]'")

from gymnasium.utils.env_checker import check_env  # noqa: E402

from falsework import (  # noqa: E402
    Assembly,
    StabilityOracle,
    StabilitySettings,
    StateGraph,
    Task,
    find_plans,
    load_structure,
    make_task,
)
from falsework.errors import InputError, StateError  # noqa: E402
from falsework.learn import DisassemblyEnv  # noqa: E402
from falsework.learn.env.gymnasium_env import ID  # noqa: E402
from falsework.search import BeamSearch, BeamSettings  # noqa: E402


@pytest.fixture(scope="module")
def arch() -> Assembly:
    return load_structure("arch:blocks=5")


@pytest.fixture(scope="module")
def graph(arch: Assembly) -> StateGraph:
    search = BeamSearch(make_task(arch), StabilityOracle(arch), BeamSettings(width=8))
    search.run()
    return StateGraph.from_states(make_task(arch), search.states())


@pytest.mark.parametrize(
    "options", [{}, {"starts": "graph"}, {"target": "half"}, {"removable_only_if_clear": True, "robots": 1}]
)
def test_it_passes_the_check_of_gymnasium(arch: Assembly, graph: StateGraph, options: dict) -> None:
    options = dict(options)
    if "starts" in options:
        options["starts"] = graph
    if "target" in options:
        options["target"] = np.where(arch.boundary, 2, np.arange(7) % 2)
    environment = gymnasium.make(ID, structure=arch, **options)
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        check_env(environment.unwrapped)
    environment.close()


def test_it_is_made_by_name_without_an_import() -> None:
    environment = gymnasium.make(f"falsework.learn.env.gymnasium_env:{ID}", structure="arch:blocks=3", robots=2)
    observation, info = environment.reset(seed=0)
    assert observation.tolist() == [1, 1, 1, 2, 2]
    assert info["action_mask"].tolist() == [1, 1, 1, 0, 0, 0, 0, 0, 0, 0]


def test_a_plan_is_a_success(arch: Assembly) -> None:
    plan = find_plans(arch, make_task(arch)).plans[0].route
    environment = DisassemblyEnv(arch)
    environment.reset(seed=0)
    rewards = []
    for step, action in enumerate(plan.actions):
        assert environment.action_masks()[action]
        observation, reward, over, truncated, info = environment.step(action)
        assert observation.tolist() == plan.states[step + 1].tolist()
        assert info["action_mask"].tolist() == environment.action_masks().tolist()
        assert not truncated
        assert over == (step == len(plan.actions) - 1)
        rewards.append(reward)
    assert rewards == [0.0] * (len(rewards) - 1) + [1.0]
    assert info["success"]


def test_it_agrees_with_the_environment_on_tensors(graph: StateGraph, arch: Assembly) -> None:
    torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")
    from falsework.learn import Environment

    oracle = StabilityOracle(arch)
    tensors = Environment(arch, 2, oracle=oracle, device="cpu")
    face = DisassemblyEnv(arch, starts=graph, oracle=oracle)
    rng = np.random.default_rng(0)
    endings = set()
    for episode in range(60):
        observation, info = face.reset(seed=episode)
        over, reward = False, 0.0
        while not over:
            state = torch.tensor(observation.astype(np.uint8))[None]
            assert tensors.rules.moves(state)[0].int().tolist() == info["action_mask"].tolist()
            action = rng.choice(np.flatnonzero(info["action_mask"]))
            step = tensors.step(state, torch.tensor([action]))
            observation, reward, over, _, info = face.step(action)
            assert step.states[0].tolist() == observation.tolist()
            assert (step.reward.item(), step.done.item()) == (reward, over)
            assert (step.success.item(), step.unstable.item()) == (info["success"], info["unstable"])
        endings.add(reward)
    assert endings == {-1.0, 1.0}


def test_its_criterion_is_that_of_the_graph() -> None:
    """Under contact a hold may bring a neighbour to slide, and ends the episode; under equilibrium it never does."""
    bottle = load_structure("bottle")
    before = np.array([1, 0, 1, 0, 0, 2, 1, 1, 0, 1, 2, 2], dtype=np.uint8)
    contact = StabilityOracle(bottle)
    taken = next(
        part for part in (5, 10) if contact.verdicts(np.where(np.arange(12) == part, 1, before)[None]).stable[0]
    )
    before[taken] = 1
    for criterion in ("contact", "equilibrium"):
        beam = BeamSearch(
            make_task(bottle), StabilityOracle(bottle, StabilitySettings(criterion=criterion)), BeamSettings(4)
        )
        beam.run()
        face = DisassemblyEnv(bottle, starts=StateGraph.from_states(beam.task, beam.states()))
        face.reset(options={"start": before})
        _, reward, over, _, info = face.step(taken)
        assert info["unstable"] == over == (criterion == "contact")
        assert reward == (-1.0 if criterion == "contact" else 0.0)


def test_starts_are_drawn_from_the_graph_by_the_seed(arch: Assembly, graph: StateGraph) -> None:
    environment = DisassemblyEnv(arch, starts=graph)
    first = [environment.reset(seed=seed)[0].tobytes() for seed in range(60)]
    assert first == [environment.reset(seed=seed)[0].tobytes() for seed in range(60)]
    assert len(set(first)) > 20
    assert graph.task.target.astype(np.int64).tobytes() not in first
    start = graph.states[5]
    assert environment.reset(options={"start": start})[0].tolist() == start.tolist()


def test_a_target_is_shown_and_reached(arch: Assembly) -> None:
    target = np.array([1, 1, 2, 1, 1, 2, 2])
    environment = DisassemblyEnv(arch, target=target)
    observation, info = environment.reset()
    assert observation.tolist() == [1, 1, 1, 1, 1, 2, 2, *target]
    assert np.flatnonzero(info["action_mask"]).tolist() == [2]
    _, reward, over, _, info = environment.step(np.int64(2))
    assert (reward, over, info["success"]) == (1.0, True, True)


def test_illegal_actions_end_the_episode_or_raise(arch: Assembly) -> None:
    environment = DisassemblyEnv(arch, render_mode="ansi")
    environment.reset()
    assert environment.render() == "ooooo##"
    _, reward, over, _, info = environment.step(12)
    assert (reward, over, info["illegal"], info["unstable"]) == (-1.0, True, True, False)
    assert environment.render() == "ooooo## illegal action 12"
    environment.reset()
    environment.step(2)
    assert environment.render() == "oo#oo## hold voussoir-2"
    strict = DisassemblyEnv(arch, illegal="error")
    strict.reset()
    with pytest.raises(StateError, match="action 7 is not legal here; choose one that action_masks"):
        strict.step(7)


def test_bad_input_is_one_clear_line(arch: Assembly) -> None:
    empty = Task.from_rules(arch.boundary, 2).target
    with pytest.raises(InputError, match="illegal is 'ignore'; choose 'end' or 'error'"):
        DisassemblyEnv(arch, illegal="ignore")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="render mode 'human' is not supported"):
        DisassemblyEnv(arch, render_mode="human")
    with pytest.raises(InputError, match="no folder, file or built-in structure 'tower'"):
        DisassemblyEnv("tower")
    with pytest.raises(StateError, match="start state 0 has no legal action"):
        DisassemblyEnv(arch, starts=empty)
    with pytest.raises(StateError, match="there is no start state"):
        DisassemblyEnv(arch, starts=np.empty((0, 7)))
    with pytest.raises(StateError, match="no rule leads from start state 0 to the target"):
        DisassemblyEnv(arch, target=[1, 1, 1, 1, 1, 2, 2], starts=[0, 1, 1, 1, 1, 2, 2])
    with pytest.raises(StateError, match="a state of 3 values does not fit"):
        DisassemblyEnv(arch).reset(options={"start": [1, 1, 1]})


def test_without_gymnasium_the_extra_is_named() -> None:
    program = "import sys; sys.modules['gymnasium'] = None; import falsework.learn.env.gymnasium_env"
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert "DependencyError: the Gymnasium environment needs gymnasium; pip install" in done.stderr


@pytest.mark.parametrize(
    "twin_of", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"]
)
@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_a_copy_goes_its_own_way(
    arch: Assembly, criterion: str, twin_of: Callable, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Tree searches copy environments, and vector environments send them to processes; threads cannot be copied."""
    monkeypatch.setattr("falsework.stability.cpu.solver.core_count", lambda: 2)
    oracle = StabilityOracle(arch, StabilitySettings(criterion=criterion))  # type: ignore[arg-type]
    env = DisassemblyEnv(arch, robots=2, oracle=oracle)
    _, info = env.reset(seed=0)
    env.step(int(np.flatnonzero(info["action_mask"])[0]))
    twin = twin_of(env)
    start = np.flatnonzero(env.action_masks())
    for action in start[:2].tolist():
        assert np.array_equal(env.action_masks(), twin.action_masks())
        ours, theirs = env.step(action), twin.step(action)
        assert np.array_equal(ours[0], theirs[0])
        assert ours[1:4] == theirs[1:4]
        if ours[2]:
            break
    before = env.action_masks().copy()
    twin.reset(seed=0)
    assert np.array_equal(env.action_masks(), before)
    assert not np.array_equal(twin.action_masks(), before)


def test_pictures_show_what_changes(arch: Assembly) -> None:
    """Of one size, as recorders of videos want them."""
    pytest.importorskip("PIL", reason="Pillow is not installed: pip install 'falsework[picture]'")
    environment = DisassemblyEnv(arch, render_mode="rgb_array")
    _, info = environment.reset(seed=0)

    def render() -> np.ndarray:
        picture = environment.render()
        assert isinstance(picture, np.ndarray)
        return picture

    first = render()
    assert (first.dtype, first.ndim, first.shape[2]) == (np.uint8, 3, 3)
    assert np.array_equal(first, render())
    unstable = False
    while not unstable:
        before = render()
        legal = np.flatnonzero(info["action_mask"])
        *_, done, _, info = environment.step(legal[-1])
        after = render()
        assert after.shape == first.shape
        assert not np.array_equal(before, after)
        unstable = info["unstable"]
        assert unstable or not done
    assert environment.fell
    environment.reset(seed=0)
    assert np.array_equal(first, render())


def test_frames_are_collected_for_videos(arch: Assembly) -> None:
    pytest.importorskip("PIL", reason="Pillow is not installed: pip install 'falsework[picture]'")
    environment = gymnasium.make(ID, structure=arch, render_mode="rgb_array")
    recorded = gymnasium.wrappers.RenderCollection(environment)
    _, info = recorded.reset(seed=0)
    recorded.step(info["action_mask"].argmax())
    frames = recorded.render()
    assert len(frames) == 2
    assert frames[0].shape == frames[1].shape
