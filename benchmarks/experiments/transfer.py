"""Experiments between networks and between structures: same budget, and what a policy knows of others (paper, 7.2)."""

from __future__ import annotations

import time
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from experiments.structure_generator import rotated_copies

from falsework import Assembly
from falsework.learn import Environment, ImitationPhase, Policy, PolicySettings, make_policy, transfer
from falsework.learn.algorithms.imitation import Imitation
from falsework.learn.data.dataset import Dataset, DataSettings, build_dataset, training_task
from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.data.symmetry import symmetries
from falsework.learn.data.symmetry_augmentation import symmetric_images
from falsework.learn.networks.factory import describe, share
from falsework.learn.training.evaluate import greedy_success, sample

EVALUATED = 1024
"""States of a set that a policy is tried from, at most; always the same ones."""


@dataclass(frozen=True)
class Budget:
    """How long a policy is trained: for a time, or for a number of steps, which depends on no machine."""

    seconds: float = 60.0
    steps: int = 0
    """Steps of the optimizer in place of the time; 0: go by `seconds`."""

    def share(self, steps: int, seconds: float) -> float:
        """How much of it is spent."""
        return steps / self.steps if self.steps else seconds / max(self.seconds, 1e-9)

    def part(self, share: float) -> Budget:
        """A smaller one."""
        return Budget(self.seconds * share, max(int(self.steps * share), 1) if self.steps else 0)

    @property
    def length(self) -> float | int:
        """The number of seconds or of steps."""
        return self.steps or self.seconds


class Harness:
    """All that is needed to train and test policies of one structure by imitation."""

    def __init__(
        self,
        assembly: Assembly,
        robots: int = 2,
        device: torch.device | str = "cpu",
        data: DataSettings | None = None,
        dataset: Dataset | None = None,
    ) -> None:
        """Search for the states to learn from and to test on.

        Args:
            assembly: the structure.
            robots: parts that may be held at once.
            device: where everything is.
            data: which searches; those of the paper by default.
            dataset: their result, if they have been run already.
        """
        self.assembly = assembly
        self.device = torch.device(device)
        self.environment = Environment(assembly, robots, device=self.device)
        if dataset is None:
            task = training_task(assembly, robots)
            dataset = build_dataset(assembly, task, data or DataSettings(), device=str(self.device))
        self.dataset = dataset
        self.rules = self.environment.rules
        self.solved = SolvableStates(self.rules)
        held_out = np.concatenate([dataset.test, dataset.validation])
        self.solved.hold_out(torch.from_numpy(symmetric_images(held_out, symmetries(assembly))))
        for states in (dataset.train, dataset.more):
            self.solved.add(torch.from_numpy(states))

    def imitate(
        self, policy: Policy, budget: Budget, *, batch: int = 0, seed: int = 0, turns: int = 1
    ) -> tuple[Policy, int]:
        """Train a policy on the known states.

        Args:
            policy: what to begin with; not changed.
            budget: how long.
            batch: states a step; 0: 1,024 on a GPU, 128 on a processor.
            seed: of the batches, and of the angles.
            turns: copies of the structure to train on, all but the first turned about the vertical; more than one are
                for networks that know parts by their geometry alone.

        Returns:
            The policy with averaged weights, and the number of steps.
        """
        gpu = self.device.type == "cuda"
        batch = batch or (1024 if gpu else 128)
        settings = ImitationPhase(batch=batch).resolved(self.device.type)
        student = make_policy(self.assembly, policy.settings, self.device)
        student.load_state_dict(policy.state_dict())
        begin = time.perf_counter()
        copies = list(rotated_copies(self.assembly, turns, np.random.default_rng(seed)))[1:]
        work = Imitation(
            student,
            self.solved,
            settings,
            seed=seed,
            precision="bfloat16" if gpu else "float32",
            copies=[share(student, copy) for copy in copies],
        )
        done = 0.0
        while done < 1.0:
            # A block lasts a hundredth of the whole, so that the learning rate falls evenly and ends where it should.
            now = time.perf_counter() - begin
            pace = work.steps / max(now, 1e-9) * budget.seconds
            block = max(1, min(int((budget.steps or pace) / 100), 200))
            work.block(block, (done, min(done + 0.01, 1.0)))
            if gpu:
                torch.cuda.synchronize(self.device)
            done = budget.share(work.steps, time.perf_counter() - begin)
        return work.export_policy(student), work.steps

    def success(self, policy: Policy) -> dict[str, float]:
        """Share of the training and of the test states from which greedy rollouts succeed."""
        shares = {}
        for name, states in (("train", self.dataset.train), ("test", self.dataset.test)):
            chosen = torch.from_numpy(sample(states, EVALUATED)).to(self.device)
            shares[name] = round(greedy_success(self.environment, policy, chosen)[0].share, 4)
        return shares


def compare_networks(
    assembly: Assembly,
    settings: Sequence[PolicySettings],
    *,
    budget: Budget,
    robots: int = 2,
    device: torch.device | str = "cpu",
    batch: int = 0,
    seed: int = 0,
) -> Iterator[dict[str, Any]]:
    """Imitate the same data with several networks for the same time each (paper, Table 5).

    Args:
        assembly: the structure.
        settings: networks.
        budget: of training, each.
        robots: parts that may be held at once.
        device: where.
        batch: states a step; 0 for the default of the device.
        seed: of weights and batches.

    Yields:
        For each network `kind`, `parameters`, `seconds`, `steps`, and greedy success on `train` and `test` states.
    """
    bench = Harness(assembly, robots, device)
    for one in settings:
        policy = make_policy(assembly, one, bench.device, seed)
        begin = time.perf_counter()
        trained, steps = bench.imitate(policy, budget, batch=batch, seed=seed)
        about = describe(trained, one)
        yield {
            "kind": one.kind,
            "parameters": about["parameters"],
            "seconds": round(time.perf_counter() - begin, 1),
            "steps": steps,
            "states": {"train": len(bench.dataset.train), "test": len(bench.dataset.test)},
            "success": bench.success(trained),
        }


def transfer_experiment(
    source: Assembly,
    others: Sequence[Assembly],
    settings: PolicySettings,
    *,
    budget: Budget,
    robots: int = 2,
    device: torch.device | str = "cpu",
    batch: int = 0,
    seed: int = 0,
    data: DataSettings | None = None,
    turns: int = 8,
) -> Iterator[dict[str, Any]]:
    """Train on one structure, test on others as it is, then fine-tune there, beside a policy that begins anew.

    Args:
        source: structure to train on.
        others: structures to test on.
        settings: a network whose weights fit any structure.
        budget: of training on the source; a fifth of it for fine-tuning, and for beginning anew.
        robots: parts that may be held at once.
        device: where.
        batch: states a step; 0 for the default of the device.
        seed: of weights and batches.
        data: searches that make the data; those of the paper by default.
        turns: copies of the source, all but one turned about the vertical, so that no direction is memorised.

    Yields:
        Rows with `trained_on`, `tested_on`, `fine_tuned` (seconds or steps), `from` (`weights` or `nothing`),
        greedy `success`.

    Raises:
        InputError: a network that knows parts by their number.
    """
    home = Harness(source, robots, device, data)
    policy = make_policy(source, settings, home.device, seed)
    transfer(policy.state_dict(), settings, source)  # refuses before the time is spent
    trained, _ = home.imitate(policy, budget, batch=batch, seed=seed, turns=turns)
    yield _row(source, source, 0, "weights", home.success(trained))
    for other in others:
        away = Harness(other, robots, device, data)
        moved = transfer(trained.state_dict(), settings, other, away.device)
        yield _row(source, other, 0, "weights", away.success(moved))
        yield _row(source, other, 0, "nothing", away.success(make_policy(other, settings, away.device, seed)))
        for beginning, name in ((moved, "weights"), (make_policy(other, settings, away.device, seed), "nothing")):
            tuned, _ = away.imitate(beginning, budget.part(0.2), batch=batch, seed=seed)
            yield _row(source, other, budget.part(0.2).length, name, away.success(tuned))


def _row(source: Assembly, other: Assembly, tuned: float, beginning: str, success: dict[str, float]) -> dict[str, Any]:
    about = {"trained_on": source.name, "tested_on": other.name, "fine_tuned": tuned, "from": beginning}
    return {**about, "success": success}
