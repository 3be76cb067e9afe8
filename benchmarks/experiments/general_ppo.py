"""Reinforcement of one policy for all structures, after imitation: rollouts on several structures for each update."""

from __future__ import annotations

import time
from collections.abc import Callable
from contextlib import suppress
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from experiments.general_training import GeneralTraining, policy_loss
from experiments.labelled_states import LabelledStructure
from experiments.structure_batches import StructureBatches

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.learn.algorithms.advantages import normalized
from falsework.learn.algorithms.ppo_loss import ppo_loss
from falsework.learn.algorithms.rollout_storage import Transitions, collect_transitions
from falsework.learn.algorithms.start_states import MixedStarts
from falsework.learn.config.policy import PolicySettings
from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.learn.networks.autocast import Network
from falsework.learn.networks.local_attention import LocalAttention, LocalAttentionPolicy
from falsework.learn.training.evaluate import greedy_success
from falsework.stability.oracle import StabilityOracle
from falsework.stability.settings import StabilitySettings

_GAE_LAMBDA = 0.95
"""Decay of generalised advantages."""
_FINAL_LEARNING_RATE = 0.1
"""Learning rate at the end, as a share of the first."""
_MASTERED = 0.99
"""Share of successful rollouts of a structure from which on nothing is learned from it: advantages are noise there."""
_DRAWS = 10
"""Structures drawn for each place, at most, before it stays empty."""
_VISITS = 6
"""Updates that a structure takes part in before another takes its place."""


@dataclass(frozen=True)
class GeneralPpoSettings:
    """Settings of the reinforcement of a policy for all structures."""

    together: int = 4
    """Structures of an update."""
    kept: int = 6
    """Structures that take turns, each with its verdicts in memory."""
    rollouts: int = 512
    """Rollouts of each structure of an update."""
    tokens: int = 24576
    """Parts of all transitions of a step, of each structure."""
    steps: int = 16
    """Steps of the optimizer for an update, at most; what they do not use is dropped."""
    learning_rate: float = 2e-4
    """First learning rate, which falls linearly."""
    average: float = 0.99
    """Decay of the moving average of the weights."""
    entropy: float = 0.003
    """Weight of the entropy of the policy."""
    imitation: float = 0.1
    """Weight of imitating labelled states of all structures, which keeps what is known of those not taking part."""

    def __post_init__(self) -> None:
        for name in ("together", "kept", "rollouts", "tokens", "steps"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; give at least 1")
        if self.together > self.kept:
            raise InputError(f"{self.together} structures of an update are more than the {self.kept} kept; keep more")


class Playground:
    """Environment of one structure, and the shared network as a policy for it."""

    def __init__(
        self, assembly: Assembly, labelled: LabelledStructure, network: LocalAttention, rollouts: int, device: Any
    ) -> None:
        """Begin with the labelled states, which are solvable."""
        equilibrium = labelled.criterion == "equilibrium"
        oracle = StabilityOracle(assembly, StabilitySettings(criterion=labelled.criterion))
        self.environment = Environment(assembly, labelled.robots, oracle=oracle, device=device)
        self.environment.exact = False
        policy = LocalAttentionPolicy(assembly, PolicySettings("local")).to(device)
        policy.of_task(labelled.robots, equilibrium=equilibrium)
        policy.network = network
        self.network = Network(policy, "bfloat16" if self.environment.device.type == "cuda" else "float32")
        self.states = torch.from_numpy(labelled.states).to(device)
        self.solved = SolvableStates(self.environment.rules, self.states)
        self.starts = MixedStarts(self.states, self.solved, rollouts)
        self.visits = 0
        self.success = 0.0
        """Share of successful rollouts at the last update."""

    def collect(self, rollouts: int, generator: torch.Generator) -> Transitions:
        """Sample rollouts, and learn which states are solvable and which are hard."""
        batch = self.starts.sample(rollouts, generator)
        found = collect_transitions(
            self.environment, self.network, batch.states, None, generator, discount=1.0, gae_lambda=_GAE_LAMBDA
        )
        self.solved.add(found.states[found.success[found.rollout]])
        self.starts.record(batch, found, torch.zeros(len(batch.states)), generator)
        self.visits += 1
        self.success = float(found.success.float().mean())
        return found

    def greedy(self, most: int) -> float:
        """Return the greedy success from some of the labelled states."""
        self.environment.exact = True
        some = self.states[:: max(len(self.states) // most, 1)]
        share = greedy_success(self.environment, self.network, some)[0].share
        self.environment.exact = False
        return share


class GeneralPpo:
    """Proximal policy optimisation of the network of a `GeneralTraining`, of which it continues optimizer and average.

    Imitation of labelled states ends where their labels end: most valid actions are not known to be. Rollouts are
    judged by what they reach. Each step of the optimizer adds up the losses of several structures, and of labelled
    states of all.
    """

    def __init__(
        self,
        training: GeneralTraining,
        settings: GeneralPpoSettings,
        draw: Callable[[], tuple[Assembly, LabelledStructure]],
        seed: int = 0,
    ) -> None:
        """Begin with the weights of the training.

        Args:
            training: whose network is improved, and whose folder keeps it.
            settings: of the updates.
            draw: returns a structure and its labelled states, another one each time; called when one is needed.
            seed: of rollouts, on top of that of the training.
        """
        self.training, self.settings, self._draw = training, settings, draw
        self._active: list[Playground] = []
        self._rng = np.random.default_rng([training.settings.seed, training.steps, seed])
        self._generator = torch.Generator(training.device).manual_seed(
            (training.settings.seed + 31 * seed) * 7919 + training.steps
        )

    def run(self, batches: StructureBatches, seconds: float, progress: tuple[float, float]) -> dict[str, float]:
        """Update for a time.

        Args:
            batches: labelled states to imitate.
            seconds: of this call.
            progress: of the reinforcement, before and after.

        Returns:
            Means over the call: `rollout_success`, `entropy`, `kl`, `transitions`, and the number of `updates`.

        Raises:
            TrainingError: a step was not finite.
        """
        begun, rows = time.perf_counter(), []
        while (spent := time.perf_counter() - begun) < seconds:
            place = progress[0] + (progress[1] - progress[0]) * spent / seconds
            rows.append(self.update(batches, place))
        self.training.optimizer.check()
        return {**{name: float(np.mean([row[name] for row in rows])) for name in rows[0]}, "updates": float(len(rows))}

    def update(self, batches: StructureBatches, progress: float = 0.0) -> dict[str, float]:
        """Collect rollouts of several structures, and take some steps; returns means as `run`."""
        settings, training = self.settings, self.training
        self._active = [one for one in self._active if one.visits < _VISITS and one.success < _MASTERED]
        for _ in range(_DRAWS * settings.kept):
            if len(self._active) == settings.kept:
                break
            with suppress(InputError):  # a structure that the solver on this device does not take
                self._active.append(Playground(*self._draw(), training.network, settings.rollouts, training.device))
        if len(self._active) < settings.together:
            raise InputError("hardly any structure can be judged on this device; reinforce the policy on another one")
        chosen = self._rng.choice(len(self._active), settings.together, replace=False)
        mine = [self._active[int(row)] for row in chosen]
        training.network.eval()
        found = [one.collect(settings.rollouts, self._generator) for one in mine]
        rows = [row for row, one in enumerate(mine) if one.success < _MASTERED and len(found[row])]
        learning = [mine[row] for row in rows]
        pieces = [self._pieces(found[row], mine[row].environment.part_count) for row in rows]
        count = min(max((len(one) for one in pieces), default=0), settings.steps)
        sums = torch.zeros(5, device=training.device)
        rate = settings.learning_rate * (1.0 - (1.0 - _FINAL_LEARNING_RATE) * progress)
        for step in range(count):
            total = torch.zeros((), device=training.device)
            for one, many in zip(learning, pieces, strict=True):
                piece = many[step % len(many)]
                logits, value = one.network(piece.states)
                weight = torch.ones(len(piece), device=training.device)
                loss = ppo_loss(logits, value, piece, weight=weight, entropy_weight=settings.entropy * weight)
                total = total + loss.total / len(learning)
                sums += loss.statistics / (len(learning) * count)
            labelled = batches.draw(settings.tokens, training.settings.mix, self._rng, self._generator)
            with torch.autocast(training.device.type, torch.bfloat16, enabled=training.device.type == "cuda"):
                logits, _ = training.network(labelled.graph, labelled.numbers)
            total = total + settings.imitation * policy_loss(logits.float(), labelled)
            training.optimizer.step(total, learning_rate=rate, average=settings.average)
        _, _, entropy, kl, _ = sums.tolist()
        success = float(np.mean([one.success for one in mine]))
        moves = float(sum(len(one) for one in found))
        return {"rollout_success": success, "entropy": entropy, "kl": kl, "transitions": moves}

    def _pieces(self, found: Transitions, parts: int) -> list[Transitions]:
        """Split transitions at random, with advantages of the deviation of this structure."""
        whole = found.take(torch.randperm(len(found), generator=self._generator, device=self.training.device))
        advantage = normalized(whole.advantage)
        size = max(1, self.settings.tokens // parts)
        rows = torch.arange(len(whole), device=self.training.device).split(size)
        columns = Transitions(**{**vars(whole), "advantage": advantage})
        return [columns.take(row) for row in rows]
