"""Reinforcement of one policy for all structures: one process learns from the rollouts of many.

Imitation of labelled states ends where their labels end: most valid actions are not known to be. Rollouts are judged by
what they reach. Processes roll out without a pause, hence with weights that are seconds old, which the clipped loss
allows for; each step of the optimizer is over pieces of the rollouts on several structures.
"""

from __future__ import annotations

import time
from collections import defaultdict
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from experiments.actors import COLUMNS, MASTERED, Actors, Experience, Load
from experiments.general_training import GeneralTraining
from experiments.labelled_states import LabelledStructure
from experiments.structure_batches import BatchSettings, StructureBatches
from numpy.typing import NDArray

from falsework.learn.algorithms.ppo_loss import ppo_loss
from falsework.learn.algorithms.rollout_storage import Transitions

_FINAL = 0.05
"""Learning rate and weight of the entropy at the end, as a share of the first ones."""
_SEND_EVERY = 1.0
"""Seconds between two times that the processes get new weights."""
_WAIT = 0.02
"""Seconds of waiting for rollouts where there is nothing to learn from."""
_KEPT = 8
"""Pieces of each size that wait to be learned from, in batches; what comes beyond them replaces others."""
_UNKNOWN = 0.5
"""Success of a structure on which the policy was not tried yet."""


@dataclass(frozen=True)
class GeneralPpoSettings(BatchSettings):
    """Settings of the reinforcement of a policy for all structures."""

    rollouts: int = 64
    """Rollouts of a collection, which one process makes on one structure with the same weights."""
    passes: int = 2
    """Steps that a transition takes part in, at most."""
    learning_rate: float = 5e-4
    """First learning rate, which falls linearly."""
    average: float = 0.998
    """Decay of the moving average of the weights."""
    entropy: float = 0.01
    """First weight of the entropy of the policy, which falls like the learning rate."""

    def __post_init__(self) -> None:
        self.check("rollouts", "passes")


@dataclass(eq=False)
class _Piece:
    """Transitions on one structure, as many as all pieces of its size have."""

    row: int
    """Of the structure, among those of its size."""
    columns: dict[str, NDArray[Any]]
    passes: int
    """Steps that it will take part in."""


class GeneralPpo:
    """Proximal policy optimisation of the network of a `GeneralTraining`, whose optimizer and average go on."""

    def __init__(
        self,
        training: GeneralTraining,
        structures: Sequence[LabelledStructure],
        settings: GeneralPpoSettings,
        load: Load,
        *,
        processes: int,
        evaluated_on: torch.device | None = None,
        seed: int = 0,
    ) -> None:
        """Start processes that roll out with the weights of the training.

        Args:
            training: whose network is improved.
            structures: to learn on; those where rollouts fail come more often.
            settings: of the updates.
            load: the structure of a name.
            processes: that roll out.
            evaluated_on: where the network of the rollouts is; None for the device of the training.
            seed: of the choice of structures and of pieces, on top of that of the training.
        """
        self.training, self.settings = training, settings
        self._structures = {one.name: one for one in structures if len(one.states)}
        self._success = {n: _UNKNOWN if s.success is None else s.success for n, s in self._structures.items()}
        self._batches = StructureBatches(list(self._structures.values()), training.device)
        self._waiting: list[list[_Piece]] = [[] for _ in range(self._batches.groups)]
        self._rng = np.random.default_rng([training.settings.seed, training.steps, seed])
        self._tried: dict[str, float] = {}
        policy = training.settings.policy.resolved()
        self._sent = time.perf_counter()
        where = evaluated_on or training.device
        self._actors = Actors(
            training.network, policy, processes, settings.rollouts, load, training.folder / "starts", where
        )

    def run(self, seconds: float, progress: tuple[float, float]) -> dict[str, float]:
        """Update for a time, with what the processes send.

        Args:
            seconds: of this call.
            progress: of the reinforcement, before and after.

        Returns:
            Sums over the call: `collections`, their `success` and `moves`; `updates`, their `entropy` and `divergence`.

        Raises:
            TrainingError: a step was not finite.
            RuntimeError: a process that rolls out has failed.
        """
        begun = time.perf_counter()
        counts = defaultdict[str, float](float)
        sums = torch.zeros(5, device=self.training.device)
        while (spent := time.perf_counter() - begun) < seconds:
            self._feed()
            group = self._ripe()
            for one in self._actors.found(0.0 if group is not None else _WAIT):
                self._keep(one, counts)
            if group is not None:
                place = progress[0] + (progress[1] - progress[0]) * spent / seconds
                sums += self._step(group, 1.0 - (1.0 - _FINAL) * place)
                counts["updates"] += 1
        self.training.optimizer.check()
        _, _, counts["entropy"], counts["divergence"], _ = sums.tolist()
        return counts

    def validate(self, structures: Sequence[LabelledStructure], seconds: float) -> list[float]:
        """Return the greedy success of the averaged weights on structures, of those that are done in some time."""
        self._actors.inference.send(self.training.network, self.training.averaged())
        self._tried = {}
        with self._actors.interrupted():
            for one in structures:
                self._actors.visit(one, greedy=True)
            end = time.perf_counter() + seconds
            while len(self._tried) < len(structures) and time.perf_counter() < end:
                for one in self._actors.found(_WAIT):
                    self._keep(one, defaultdict(float))
        return list(self._tried.values())

    def close(self) -> None:
        """End the processes."""
        self._actors.close()

    def _feed(self) -> None:
        """Give the processes weights from time to time, and structures, those where rollouts fail more often."""
        if time.perf_counter() - self._sent > _SEND_EVERY:
            self._actors.inference.send(self.training.network, self.training.network)
            self._sent = time.perf_counter()
        if self._actors.hungry:
            names = list(self._success)
            weight = 1.05 - np.array([self._success[name] for name in names])
            for name in self._rng.choice(names, 4, p=weight / weight.sum()):
                self._actors.visit(self._structures[name])

    def _keep(self, found: Experience, counts: dict[str, float]) -> None:
        """Split what a process sent into pieces, and add it to the counts."""
        if found.moves is None:
            self._tried[found.name] = found.success
            return
        self._success[found.name] = found.success
        moves = len(found.moves["actions"])
        for name, number in (("collections", 1), ("moves", moves), ("success", found.success)):
            counts[name] += number
        if moves == 0 or found.success >= MASTERED:
            return
        group, row = self._batches.place(found.name)
        size = max(1, self.settings.tokens // (self.settings.mix * self._batches.parts(group)))
        columns = _filled(found.moves, self._batches.parts(group))
        order = self._rng.permutation(moves)
        waiting, most = self._waiting[group], _KEPT * self.settings.mix
        for rows in np.resize(order, max(1, moves // size) * size).reshape(-1, size):
            piece = _Piece(row, {name: column[rows] for name, column in columns.items()}, self.settings.passes)
            if len(waiting) < most:
                waiting.append(piece)
            else:
                waiting[int(self._rng.integers(most))] = piece

    def _ripe(self) -> int | None:
        """Return a size that there are enough pieces of, the more likely the more there are."""
        batches = np.array([len(waiting) // self.settings.mix for waiting in self._waiting], dtype=float)
        return int(self._rng.choice(len(batches), p=batches / batches.sum())) if batches.any() else None

    def _step(self, group: int, share: float) -> torch.Tensor:
        """Take one step on pieces of a size, and return the statistics of the loss.

        Args:
            group: the size.
            share: of the first learning rate and weight of the entropy.
        """
        settings, training, waiting = self.settings, self.training, self._waiting[group]
        self._rng.shuffle(waiting)  # type: ignore[arg-type]
        chosen = waiting[: settings.mix]
        for piece in chosen:
            piece.passes -= 1
        waiting[: settings.mix] = [piece for piece in chosen if piece.passes]
        states, actions, before, advantage, returns = (
            torch.from_numpy(np.stack([piece.columns[name] for piece in chosen])).to(training.device)
            for name in COLUMNS
        )
        batch = self._batches.of(group, [piece.row for piece in chosen], states)
        with torch.autocast(training.device.type, torch.bfloat16, enabled=training.device.type == "cuda"):
            logits, value = training.network(batch.graph, batch.numbers)
        mask, none = batch.legal.flatten(0, 1), actions[0, :0]
        rows = (actions.flatten(), mask, before.flatten(), advantage.flatten(), returns.flatten())
        moves = Transitions(states.flatten(0, 1), None, *rows, none, none.bool(), none.float())
        weight = torch.ones(len(moves), device=training.device)
        loss = ppo_loss(
            logits.flatten(0, 1).float(),
            value.flatten().float(),
            moves,
            weight=weight,
            entropy_weight=share * settings.entropy * weight,
        )
        rate = share * settings.learning_rate
        training.optimizer.step(loss.total, learning_rate=rate, average=settings.average)
        return loss.statistics


def _filled(columns: dict[str, NDArray[Any]], parts: int) -> dict[str, NDArray[Any]]:
    """Fill states up to a number of parts, and number the actions accordingly."""
    states, actions = columns["states"], columns["actions"]
    own = states.shape[1]
    filled = np.zeros((len(states), parts), dtype=np.uint8)
    filled[:, :own] = states
    return {**columns, "states": filled, "actions": np.where(actions < own, actions, actions + parts - own)}
