"""Policies, rewards, learners and callbacks that users bring to a training run."""

from __future__ import annotations

import importlib
import json
import sys
from collections.abc import Iterator
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")
pytest.importorskip("filelock", reason="filelock is not installed: pip install 'falsework[learn]'")

from torch import Tensor, nn  # noqa: E402

import falsework as fw  # noqa: E402
from falsework import Replanner, make_task  # noqa: E402
from falsework.assembly import complete_state  # noqa: E402
from falsework.cli.main import main  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn import (  # noqa: E402
    ImitationPhase,
    Iteration,
    Learner,
    LearnerContext,
    PolicySettings,
    PpoPhase,
    TrainResult,
    TrainSettings,
    confidences,
    load_run,
    make_policy,
    transfer,
)
from falsework.learn.env.rollout import Move  # noqa: E402
from falsework.learn.training.logger import read_progress  # noqa: E402
from falsework.search import TensorRules  # noqa: E402

ARCH = "arch:blocks=7"
NETS = '''
"""A user's own module."""

import torch
from torch import nn


class Net(nn.Module):
    """Two layers over the states, or over states and targets."""

    def __init__(self, assembly, width=8):
        super().__init__()
        parts = assembly.part_count
        self.body = nn.Linear(3 * parts, width)
        self.norm = nn.BatchNorm1d(width)
        self.actions = nn.Linear(width, 2 * parts)
        self.value = nn.Linear(width, 1)

    def forward(self, states, targets=None):
        x = self.norm(self.body(nn.functional.one_hot(states.long(), 3).flatten(1).float())).relu()
        return self.actions(x), torch.tanh(self.value(x)).squeeze(1)


class GoalNet(Net):
    goal_conditioned = True

    def forward(self, states, targets=None):
        assert targets is not None
        return super().forward((states + targets) % 3)


def half_reward(move):
    return 0.5 * move.step.reward


not_a_class = 3
'''
SETTINGS = TrainSettings(
    phases=(ImitationPhase(steps=10, batch=16), PpoPhase(rollouts=8, batch=16)),
    steps=30,
    block=5,
    widths=(8,),
    evaluations=2,
    patience=0.0,
    evaluation_states=16,
)
COMPLETE = PpoPhase(rollouts=8, batch=16, starts="complete")
"""Every rollout takes actions: none begins at its target."""


@pytest.fixture
def nets(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Any]:
    """A module of a user, where Python finds it."""
    (tmp_path / "users_nets.py").write_text(NETS)
    monkeypatch.syspath_prepend(str(tmp_path))
    monkeypatch.delitem(sys.modules, "users_nets", raising=False)
    yield importlib.import_module("users_nets")
    sys.modules.pop("users_nets", None)


def train(folder: Path | None, settings: TrainSettings = SETTINGS, **options: Any) -> TrainResult:
    return fw.train(ARCH, settings, folder=folder, device="cpu", logs=(), **options)


def same(one: nn.Module, other: nn.Module) -> bool:
    pairs = zip(one.state_dict().values(), other.state_dict().values(), strict=True)
    return all(torch.equal(a, b) for a, b in pairs)


def test_a_run_holds_a_policy_of_the_user(nets: Any, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Found again by its import path, with its options; evaluation and replanning take it like any other."""
    result = train(tmp_path / "run", policy=partial(nets.Net, width=12))
    assert not result.notes
    assert type(result.policy) is nets.Net
    run = load_run(tmp_path / "run")
    assert (run.settings.policy.kind, run.settings.policy.options) == ("users_nets:Net", {"width": 12})
    assert same(run.policy, result.policy)
    assert run.policy.state_dict()["norm.num_batches_tracked"] > 0  # what is no weight is kept too
    assert Replanner(run.assembly, run.policy).replan(np.array([1, 1, 1, 1, 1, 1, 1, 2, 2])).value is not None
    assert main(["evaluate", str(tmp_path / "run"), "--states", "10"]) == 0
    assert "of 10 states succeed" in capsys.readouterr().out


def test_a_module_is_trained_from_its_weights(nets: Any, tmp_path: Path) -> None:
    """And stays as it was; a run that its class alone cannot give back says so, and takes the class or a module."""
    arch = fw.load_structure(ARCH)
    module = nets.Net(arch, width=5)
    before = {name: tensor.clone() for name, tensor in module.state_dict().items()}
    result = train(tmp_path / "run", replace(SETTINGS, steps=10), policy=module)
    assert all(torch.equal(tensor, before[name]) for name, tensor in module.state_dict().items())
    (note,) = result.notes
    assert "users_nets:Net called with the assembly alone has other weights" in note
    with pytest.raises(InputError, match="holds the weights of another network"):
        load_run(tmp_path / "run")
    for policy in (nets.Net(arch, width=5), module):
        assert same(load_run(tmp_path / "run", policy=policy).policy, result.policy)
    assert same(fw.load_policy(tmp_path / "run", policy=module), result.policy)


def test_goals_are_shown_to_a_policy_that_asks_for_them(nets: Any, tmp_path: Path) -> None:
    settings = replace(SETTINGS, steps=4, random_tries=2)
    result = fw.train("arch:blocks=13", settings, folder=tmp_path / "run", device="cpu", logs=(), policy=nets.GoalNet)
    assert load_run(tmp_path / "run").settings.policy.goal_conditioned
    assert result.steps == 4


def test_a_run_of_a_class_that_is_gone_says_so(nets: Any, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    train(tmp_path / "run", replace(SETTINGS, steps=10), policy=nets.Net)
    kind = nets.Net
    monkeypatch.setattr(sys, "path", [place for place in sys.path if place != str(tmp_path)])
    del sys.modules["users_nets"]
    with pytest.raises(InputError, match=r"cannot import the policy users_nets:Net \(No module named 'users_nets'\)"):
        load_run(tmp_path / "run")
    assert isinstance(load_run(tmp_path / "run", policy=kind).policy, kind)


def test_a_local_class_is_handed_over(nets: Any, tmp_path: Path) -> None:
    class Local(nets.Net):  # type: ignore[misc, name-defined]
        pass

    (note,) = train(tmp_path / "run", replace(SETTINGS, steps=10), policy=Local).notes
    assert "it was defined inside a function" in note
    assert isinstance(load_run(tmp_path / "run", policy=Local).policy, Local)


def test_resuming_takes_policy_and_reward_again(nets: Any, tmp_path: Path) -> None:
    """The weights are those of an uninterrupted run."""
    options = {"policy": nets.Net, "reward": nets.half_reward}
    whole = train(tmp_path / "whole", **options)
    train(tmp_path / "run", **options, callbacks=[lambda now: now.step >= 15])
    resumed = train(tmp_path / "run", resume=True)
    assert resumed.steps == whole.steps
    assert same(resumed.policy, whole.policy)


def test_the_reward_decides_what_is_learned() -> None:
    """With a reward for holding one part first, the policy holds that part, which the usual reward does not prefer."""
    arch, wanted = fw.load_structure(ARCH), 5
    complete = torch.from_numpy(complete_state(arch.boundary))

    def reward(move: Move) -> Tensor:
        return ((move.actions == wanted) & (move.states == complete).all(dim=1)).float()

    phase = replace(COMPLETE, rollouts=64, batch=64, imitation=0.0, learning_rate=1e-2, average=0.0, entropy_floor=0.0)
    result = train(None, replace(SETTINGS, phases=(phase,), steps=120), reward=reward)
    mask = TensorRules(make_task(arch, robots=2)).moves(complete[None])
    assert mask[0].sum() > 4
    assert confidences(result.policy, complete[None], mask)[0, wanted] > 0.9


def test_returns_are_logged(nets: Any, tmp_path: Path) -> None:
    train(tmp_path / "run", replace(SETTINGS, phases=(COMPLETE,)), reward=nets.half_reward)
    lines = [line for line in read_progress(tmp_path / "run") if "train/rollout_return" in line]
    assert lines
    for line in lines:  # every rollout ends with plus or minus a half
        assert line["train/rollout_return"] == pytest.approx(line["train/rollout_success"] - 0.5, abs=1e-6)


class Reinforce(Learner):
    """REINFORCE without a baseline, as the documentation has it."""

    def __init__(self, given: LearnerContext) -> None:
        generator = given.environment.generator(given.seed)
        super().__init__(given.policy, generator, given.seed, given.shards, learning_rate=1e-2)
        self.given = given

    def block(self, steps: int, progress: tuple[float, float]) -> dict[str, float]:
        from falsework.learn import collect_transitions, masked_log_probabilities

        numbers: dict[str, float] = {}
        for _ in range(steps):
            batch = self.given.starts.sample(16, self.generator)
            played = collect_transitions(
                self.given.environment,
                self.policy,
                batch.states,
                batch.targets,
                self.generator,
                discount=1.0,
                gae_lambda=1.0,
                reward=self.given.reward,
            )
            logits, _ = self.policy(played.states, played.targets)
            taken = masked_log_probabilities(logits, played.mask).gather(1, played.actions[:, None])[:, 0]
            loss = -(taken * played.returns).mean()
            self.optimizer.step(loss, learning_rate=1e-2, average=0.0)
            numbers = {"loss": float(loss.detach()), "rollout_success": float(played.success.float().mean())}
            self.listener(numbers)
        return numbers


def test_a_learner_of_the_user_takes_the_place_of_ppo(tmp_path: Path) -> None:
    """After imitation, and through checkpoints."""
    phases: list[int] = []
    train(tmp_path / "run", learner=Reinforce, callbacks=[lambda now: phases.append(now.phase)])
    assert phases == [0, 0, *[1] * 20]
    assert load_run(tmp_path / "run").settings.learner.endswith(":Reinforce")
    lines = [line for line in read_progress(tmp_path / "run") if "train/rollout_success" in line]
    assert lines
    assert all("train/kl" not in line for line in lines)


def test_callbacks_see_each_iteration_and_end_the_training(tmp_path: Path) -> None:
    seen: list[Iteration] = []

    def watch(now: Iteration) -> bool:
        seen.append(now)
        return now.step >= 20

    settings = replace(SETTINGS, evaluations=4)
    result = fw.train("arch:blocks=13", settings, folder=tmp_path / "run", device="cpu", logs=(), callbacks=[watch])
    assert result.steps == 20
    assert not result.interrupted
    assert [one.step for one in seen] == sorted(one.step for one in seen)
    assert {"loss", "solved"} < set(seen[0].numbers)
    assert all(isinstance(one.policy, nn.Module) for one in seen)
    assert seen[0].best.states == 0 < seen[-1].best.states
    assert load_run(tmp_path / "run").metadata["results"]["steps"] == 20
    again = fw.train("arch:blocks=13", folder=tmp_path / "run", device="cpu", logs=(), resume=True)
    assert again.steps == 30


def test_an_error_of_a_callback_is_not_hidden() -> None:
    def fail(now: Iteration) -> None:
        raise KeyError("mine")

    with pytest.raises(KeyError, match="mine"):
        train(None, callbacks=[fail])


def test_the_command_line_takes_import_paths(nets: Any, tmp_path: Path) -> None:
    words = ["train", ARCH, "--out", str(tmp_path / "run"), "--steps", "3", "--device", "cpu"]
    assert main([*words, "--policy", "users_nets:Net", "--reward", "users_nets:half_reward"]) == 0
    content = json.loads((tmp_path / "run" / "run.json").read_text())["settings"]
    assert (content["policy"]["kind"], content["reward"]) == ("users_nets:Net", "users_nets:half_reward")


def test_custom_weights_move_to_other_structures_where_they_fit(nets: Any) -> None:
    arch, wider = fw.load_structure(ARCH), fw.load_structure("arch:blocks=9")
    settings = PolicySettings("users_nets:Net")
    policy = make_policy(arch, settings)
    assert same(transfer(policy.state_dict(), settings, arch), policy)
    with pytest.raises(InputError, match="weights do not fit"):
        transfer(policy.state_dict(), settings, wider)


class Broken(nn.Module):
    """A policy that returns what it is told to."""

    def __init__(self, logits: Any, value: Any = None, *, trainable: bool = True) -> None:
        super().__init__()
        self.answer = (logits, torch.zeros(2) if value is None else value)
        self.weight = nn.Parameter(torch.zeros(1), requires_grad=trainable)

    def forward(self, states: Tensor, targets: Tensor | None = None) -> Any:
        return self.answer if isinstance(self.answer[0], Tensor) else self.answer[0]


GOOD = torch.zeros(2, 18)
UNKNOWN: dict[str, Any] = {"breadth": 3}
BREADTH: Any = partial(Broken, **UNKNOWN)


@pytest.mark.parametrize(
    ("policy", "words"),
    [
        (Broken(torch.zeros(2, 9)), r"Broken returned logits of shape \(2, 9\) for two states; expected \(2, 18\)"),
        (Broken(GOOD, torch.zeros(2, 1)), r"returned values of shape \(2, 1\) for two states; expected \(2,\)"),
        (Broken(GOOD, torch.full((2,), 3.0)), "returned a value of size 3; keep values in"),
        (Broken(GOOD * torch.nan), "returned logits that are no finite floating-point numbers"),
        (Broken(GOOD.long()), "returned logits that are no finite floating-point numbers"),
        (Broken("logits"), "returned str; return logits and values, two tensors"),
        (Broken(GOOD, trainable=False), "has no weights to train"),
        (lambda states: states, "a policy is a torch.nn.Module, a class of such or a partial of one"),
        (partial(Broken, GOOD), "options of a policy have names"),
        (partial(Broken, logits=GOOD), "options of a policy are JSON values by name"),
        (BREADTH, r"cannot be made from an assembly and the options \{'breadth': 3\} \("),
    ],
)
def test_policies_that_break_the_protocol_are_refused_at_once(policy: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        train(None, policy=policy)


def wrong_shape(move: Move) -> Tensor:
    return move.step.reward[:, None]


@pytest.mark.parametrize(
    ("reward", "words"),
    [
        (wrong_shape, r"the reward gives \(8, 1\) for 8 actions; return a number for each"),
        (lambda move: 0.0, "the reward gives float for 8 actions"),
        (lambda move: move.step.reward * torch.nan, "the reward gives numbers that are not finite"),
        (lambda move: 1.0 + move.step.reward, r"add up to \d.* in size; scale the reward"),
        (3, "the reward is 3, which cannot be called"),
    ],
)
def test_rewards_that_break_the_protocol_are_refused(reward: Any, words: str) -> None:
    settings = replace(SETTINGS, phases=(COMPLETE,))
    with pytest.raises(InputError, match=words):
        train(None, settings, reward=reward)


@pytest.mark.parametrize(
    ("options", "words"),
    [
        ({"learner": lambda given: None}, "gives no falsework.learn.Learner; derive its class from that"),
        ({"learner": 3}, "the learner is 3, which cannot be called"),
        ({"settings": {"policy": PolicySettings("users_nets:not_a_class")}}, "is no class of torch.nn.Module"),
        ({"settings": {"policy": PolicySettings("users_nets:Absent")}}, "cannot import the policy users_nets:Absent"),
        ({"settings": {"reward": "users_nets:absent"}}, "cannot import the reward users_nets:absent"),
        ({"settings": {"learner": "absent_module:Learner"}}, "cannot import the learner absent_module:Learner"),
    ],
)
def test_what_cannot_be_used_is_refused(nets: Any, options: dict[str, Any], words: str) -> None:
    settings = replace(SETTINGS, phases=SETTINGS.phases[1:], **options.pop("settings", {}))
    with pytest.raises(InputError, match=words):
        train(None, settings, **options)


@pytest.mark.parametrize(
    ("make", "words"),
    [
        (lambda: PolicySettings("rnn"), "unknown policy kind 'rnn'; choose resmlp.* or the import path of your own"),
        (lambda: PolicySettings("users_nets:Net", layers=2), "sizes of users_nets:Net are its own"),
        (lambda: PolicySettings("mlp", options={"width": 3}), "options of a policy are JSON values by name"),
        (lambda: TrainSettings(reward="mine"), "the reward is 'mine'; give an import path"),
        (lambda: TrainSettings(phases=(ImitationPhase(),), reward="a:b"), "a reward belongs to PPO"),
        (lambda: load_run("absent", policy=Broken(GOOD)), "there is no folder absent"),
    ],
)
def test_settings_that_make_no_sense_are_refused(make: Any, words: str) -> None:
    with pytest.raises(InputError, match=words):
        make()


def test_a_policy_of_this_package_is_not_replaced(tmp_path: Path) -> None:
    train(tmp_path / "run", replace(SETTINGS, steps=3, policy=PolicySettings("mlp", channels=8)))
    with pytest.raises(InputError, match="is a mlp of falsework; leave the policy out"):
        load_run(tmp_path / "run", policy=Broken(GOOD))
