"""The ways to train a policy, each as something that learns in blocks and can be saved between two of them."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path
from typing import Any, Protocol

import torch

from falsework.learn.algorithms.curriculum import Curriculum
from falsework.learn.algorithms.imitation import Imitation, Network
from falsework.learn.algorithms.ppo import PPO
from falsework.learn.config.ppo import PpoSettings
from falsework.learn.config.train import TrainSettings
from falsework.learn.data.random_walks import TaskSource
from falsework.learn.data.recording_environment import WatchedEnvironment
from falsework.learn.data.solvable_states import SolvedStates
from falsework.learn.networks.policy import Policy
from falsework.utils.collectives import gather_rows, summed
from falsework.utils.distributed import Shards


class Learner(Protocol):
    """Makes a policy better, a block at a time."""

    exhausted: bool
    """Nothing is left to learn."""

    def block(self, steps: int, progress: tuple[float, float]) -> dict[str, float]:
        """Take some steps of the optimizer; progress of the whole run before and after. Returns numbers to log."""
        ...

    def best(self, policy: Policy) -> Policy:
        """Write the weights to be evaluated into another policy of the same kind, and return it."""
        ...

    def adopt(self, policy: Policy) -> None:
        """Begin with the weights of another policy of the same kind, such as what imitation arrived at."""
        ...

    def tensors(self) -> dict[str, torch.Tensor]:
        """All that there is to save and is the same in all processes."""
        ...

    def own_tensors(self) -> dict[str, torch.Tensor]:
        """All that there is to save and belongs to this process."""
        ...

    def load(self, tensors: dict[str, torch.Tensor], own: dict[str, torch.Tensor] | None) -> None:
        """Go back to what was saved; `own` is None if the number of processes has changed."""
        ...


class SearchLearner:
    """Imitation of states known to be solvable and, if asked for, rounds in which rollouts find more of them."""

    def __init__(
        self,
        environment: WatchedEnvironment,
        policy: Policy,
        solved: SolvedStates,
        settings: TrainSettings,
        *,
        rounds: bool,
        compiled: bool = False,
        shards: Shards = Shards(),
        tasks: TaskSource | None = None,
        folder: Path | None = None,
    ) -> None:
        """Begin.

        Args:
            environment: rules and verdicts.
            policy: what is trained, in place.
            solved: what is known; grows with the rounds.
            settings: filled in.
            rounds: let the policy play and search where it fails.
            compiled: compile the network.
            shards: processes.
            tasks: draws states with targets, in place of `solved`.
            folder: for the batch of a loss that is not finite.
        """
        self.exhausted = False
        self._environment, self._solved, self._settings = environment, solved, settings
        self._rounds, self._shards, self._tasks = rounds, shards, tasks
        environment.remember = rounds
        self._imitation = Imitation(
            policy,
            environment.rules,
            settings.imitation,
            seed=settings.seed,
            precision=settings.precision,
            compiled=compiled,
            shards=shards,
            folder=folder,
        )
        self._network = Network(policy, settings.precision)
        self._generator = environment.generator(settings.seed * 1009 + 500 + shards.rank)
        self._blocks = 0
        self._perfect = 0
        self._numbers: dict[str, float] = {}

    def block(self, steps: int, progress: tuple[float, float]) -> dict[str, float]:
        """As `Learner`."""
        rounds = self._settings.improve
        if self._rounds and rounds.first <= progress[0] < rounds.last and self._blocks % rounds.every == 0:
            self._numbers = self._round()
        self._blocks += 1
        self._imitation.run(
            self._solved,
            steps,
            progress,
            mistakes=self._environment.mistakes,
            outcomes=self._environment.outcomes,
            tasks=self._tasks,
        )
        return {**self._imitation.report(), "solved": float(len(self._solved)), **self._numbers}

    def best(self, policy: Policy) -> Policy:
        """As `Learner`."""
        return self._imitation.averaged(policy)

    def adopt(self, policy: Policy) -> None:
        """As `Learner`."""
        self._imitation.adopt(policy)

    def tensors(self) -> dict[str, torch.Tensor]:
        """As `Learner`."""
        counts = torch.tensor([self._blocks, self._perfect, int(self.exhausted)])
        saved = {f"imitation.{name}": tensor for name, tensor in self._imitation.tensors().items()}
        return {**saved, "counts": counts}

    def own_tensors(self) -> dict[str, torch.Tensor]:
        """As `Learner`."""
        saved = {"batches": self._imitation.generator_state(), "rollouts": self._generator.get_state()}
        for name, memory in (("mistakes", self._environment.mistakes), ("outcomes", self._environment.outcomes)):
            saved |= {f"{name}.{column}": tensor for column, tensor in memory.tensors().items()}
        return saved

    def load(self, tensors: dict[str, torch.Tensor], own: dict[str, torch.Tensor] | None) -> None:
        """As `Learner`."""
        self._blocks, self._perfect, exhausted = tensors["counts"].tolist()
        self.exhausted = bool(exhausted)
        prefix = "imitation."
        self._imitation.load(names(tensors, prefix))
        if own is None:  # other processes than before: they draw other numbers, and have made no mistakes yet
            seed = (self._settings.seed * 1009 + self._shards.rank) * 100_003 + self._imitation.steps
            self._imitation.reseed(seed)
            self._generator.manual_seed(seed + 1)
            return
        self._imitation.set_generator_state(own["batches"])
        self._generator.set_state(own["rollouts"].cpu())
        for name, memory in (("mistakes", self._environment.mistakes), ("outcomes", self._environment.outcomes)):
            memory.load(names(own, name + "."))

    def _round(self) -> dict[str, float]:
        """Play from states that are known to be solvable, search where that fails, and learn what was found."""
        from falsework.learn.algorithms.expert_iteration import improve

        settings, solved, device = self._settings, self._solved, self._environment.device
        count = max(settings.improve.starts // self._shards.size, 1)
        rows = torch.randint(len(solved), (count,), generator=self._generator, device=device)
        known = len(solved)
        found = improve(self._environment, self._network, solved, solved.states[rows], generator=self._generator)
        tried, succeeded = summed([float(count), float(found.succeeded)], self._shards, device)
        self._perfect = self._perfect + 1 if tried == succeeded else 0
        self.exhausted = 0 < settings.patience <= self._perfect
        return {"round_success": succeeded / tried, "round_new": float(len(solved) - known)}


class PpoLearner:
    """Reinforcement learning, with start states drawn by a curriculum or always the complete structure."""

    def __init__(
        self,
        environment: WatchedEnvironment,
        policy: Policy,
        starts: torch.Tensor,
        settings: TrainSettings,
        *,
        targets: torch.Tensor | None = None,
        shards: Shards = Shards(),
        folder: Path | None = None,
    ) -> None:
        """Begin with the weights that the policy has.

        Args:
            environment: rules and verdicts.
            policy: what is trained, in place.
            starts: states known to be solvable, shape (count, parts).
            settings: filled in.
            targets: of each start, shape (count, parts), or None.
            shards: processes.
            folder: for the batch of a loss that is not finite.
        """
        self.exhausted = False
        self._policy, self._settings, self._shards = policy, settings, shards
        self._rollouts = max(settings.ppo.rollouts // shards.size, 1)
        options, seed = settings.ppo.settings, settings.seed * 1009 + shards.rank
        network = Network(policy, settings.precision)
        self._ppo = PPO(network, environment, options, environment.generator(seed + 300), shards=shards, folder=folder)
        drawing = environment.generator(seed + 400)
        self._curriculum = Curriculum(
            starts, environment.rules, options.curriculum, drawing, targets=targets, shards=shards
        )

    def block(self, steps: int, progress: tuple[float, float]) -> dict[str, float]:
        """As `Learner`: updates until about so many steps of the optimizer are taken."""
        taken, numbers = 0, {}
        options = self._settings.ppo.settings
        while taken < steps:
            numbers = self._ppo.learn(self._curriculum, self._rollouts)
            taken += options.epochs * math.ceil(max(numbers["steps"], 1.0) / options.batch)
        return {"updates": float(self._ppo.updates), **numbers}

    def best(self, policy: Policy) -> Policy:
        """As `Learner`."""
        policy.load_state_dict(self._policy.state_dict())
        return policy.eval()

    def adopt(self, policy: Policy) -> None:
        """As `Learner`."""
        self._policy.load_state_dict(policy.state_dict())

    def tensors(self) -> dict[str, torch.Tensor]:
        """As `Learner`."""
        saved = {f"ppo.{name}": tensor for name, tensor in self._ppo.tensors().items()}
        return saved | {f"curriculum.{name}": tensor for name, tensor in self._curriculum.tensors().items()}

    def own_tensors(self) -> dict[str, torch.Tensor]:
        """As `Learner`."""
        saved = {f"ppo.{name}": tensor for name, tensor in self._ppo.own_tensors().items()}
        return saved | {f"curriculum.{name}": tensor for name, tensor in self._curriculum.own_tensors().items()}

    def load(self, tensors: dict[str, torch.Tensor], own: dict[str, torch.Tensor] | None) -> None:
        """As `Learner`."""
        for prefix, what in (("ppo.", self._ppo), ("curriculum.", self._curriculum)):
            what.load(names(tensors, prefix), None if own is None else names(own, prefix))


def without_curriculum(settings: PpoSettings) -> PpoSettings:
    """The same reinforcement learning, with all start states alike and no more exploration where it fails."""
    plain = replace(settings.curriculum, growing=False, rank_power=0.0, entropy_rise=0.0)
    return replace(settings, curriculum=plain)


def share_solved(solved: SolvedStates, known: int, shards: Shards) -> None:
    """Tell all processes what each has found solvable since it knew `known` states."""
    if shards.size > 1:
        solved.add(gather_rows(solved.states[known:], shards))
        solved.learn_test_words(gather_rows(solved.test_words(), shards))
        solved.sort()


def merged(own: dict[str, torch.Tensor], shards: Shards, device: torch.device) -> dict[str, torch.Tensor]:
    """What belongs to single processes, from all of them, with names that say whose it is."""
    if shards.size == 1:
        return {f"process.0.{name}": tensor for name, tensor in own.items()}
    whole: dict[str, torch.Tensor] = {}
    for name in sorted(own):
        rows = own[name].to(device)
        counts = gather_rows(torch.tensor([len(rows)], device=device), shards).tolist()
        pieces = gather_rows(rows, shards).split(counts)
        whole |= {f"process.{rank}.{name}": piece for rank, piece in enumerate(pieces)}
    return whole


def own_of(tensors: dict[str, torch.Tensor], shards: Shards) -> dict[str, torch.Tensor] | None:
    """What `merged` kept for this process; None if there were more or fewer of them."""
    ranks = {int(name.split(".")[1]) for name in tensors if name.startswith("process.")}
    if len(ranks) != shards.size:
        return None
    prefix = f"process.{shards.rank}."
    return {name[len(prefix) :]: tensor for name, tensor in tensors.items() if name.startswith(prefix)}


def names(values: dict[str, Any], prefix: str) -> dict[str, Any]:
    """The values under names that begin with a prefix, with the prefix taken off."""
    return {name[len(prefix) :]: value for name, value in values.items() if name.startswith(prefix)}
