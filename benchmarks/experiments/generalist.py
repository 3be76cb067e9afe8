"""One policy for many structures: trained on generated ones, tested on others that it has never seen.

Networks of kind `parts` and `graph` know parts by their geometry alone, so the same weights serve any structure.
Training draws a few structures of a family a step, each turned about the vertical by one of a few angles, and raises
the probability of actions that keep them solvable. What it learns is a beginning for any structure: see `fine_tune`.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from typing import Any

import numpy as np
import torch
from experiments.structure_generator import KINDS, TrainingInstance, members, rotated_copies
from experiments.transfer import Budget, Harness
from torch import Tensor

from falsework.assembly.model import Assembly
from falsework.errors import InputError
from falsework.learn.algorithms.imitation import imitation_loss
from falsework.learn.config.policy import PolicySettings
from falsework.learn.networks.autocast import Network
from falsework.learn.networks.factory import make_policy, share, transfer
from falsework.learn.networks.policy import Policy
from falsework.learn.training.evaluate import greedy_success, sample

EVALUATED = 128
"""States of each structure that a policy is tried from, at most."""


@dataclass(frozen=True)
class GeneralistSettings:
    """What a policy for many structures is trained on, and for how long."""

    policy: PolicySettings = field(default_factory=lambda: PolicySettings("transformer"))
    """A network whose weights fit any structure."""
    kinds: tuple[str, ...] = tuple(KINDS)
    """Recipes of structures, of `structure_generator.KINDS`."""
    structures: int = 64
    """Structures to train on."""
    unseen: int = 24
    """Other structures to test on."""
    turns: int = 3
    """Copies of each structure, turned by random angles."""
    robots: int = 2
    """Parts that may be held at once."""
    width: int = 64
    """Of the searches that make the states."""
    seconds: float = 300.0
    """Time of training, searches left out."""
    steps: int = 0
    """Steps of the optimizer in place of a time; 0: go by `seconds`."""
    batch: int = 0
    """States a step, over all of its structures; 0: 2,048 on a GPU, 128 on a processor."""
    mix: int = 4
    """Structures a step."""
    learning_rate: float = 1e-3
    """Largest step of AdamW."""
    seed: int = 0
    """Of structures, weights and batches."""

    def __post_init__(self) -> None:
        for name in ("structures", "turns", "mix", "width"):
            if getattr(self, name) < 1:
                raise InputError(f"{name} is {getattr(self, name)}; give at least 1")
        if not self.policy.transfers:
            raise InputError(f"a policy of kind {self.policy.kind} fits one structure only; choose transformer or gat")


@dataclass(frozen=True, eq=False)
class Generalist:
    """A trained policy for many structures."""

    settings: GeneralistSettings
    weights: dict[str, Tensor]
    """`state_dict`, for `transfer`."""
    rows: list[dict[str, Any]]
    """Greedy success by structure: `structure`, `parts`, `seen`, `states`, `success`; then the means, `structure` being
    `all seen` and `all unseen`."""
    steps: int

    def success(self, *, seen: bool) -> float:
        """Mean greedy success over the structures that were trained on, or over the others."""
        return next(row["success"] for row in self.rows if row["structure"] == f"all {'seen' if seen else 'unseen'}")


def train_generalist(
    settings: GeneralistSettings = GeneralistSettings(),
    device: torch.device | str = "cpu",
    *,
    report: Callable[[str], None] | None = None,
) -> Generalist:
    """Train on a family of structures, and test on it and on structures that are not in it.

    Args:
        settings: what to train on, and for how long.
        device: where.
        report: called with progress messages.

    Raises:
        InputError: settings that nothing can be trained with.
    """
    where = torch.device(device)
    options = {"kinds": settings.kinds, "robots": settings.robots, "width": settings.width, "device": where}
    family = members(settings.structures, seed=settings.seed, report=report, **options)
    known = frozenset(member.name for member in family)
    others = members(settings.unseen, seed=settings.seed + 10_007, avoid=known, **options)
    trained, steps = _train(settings, family, where, report)
    rows = [_evaluate(trained, member, seen=True) for member in family[: max(settings.unseen, 1)]]
    rows += [_evaluate(trained, member, seen=False) for member in others]
    for seen in (True, False):
        shares = [row["success"] for row in rows if row["seen"] == seen]
        mean = round(float(np.mean(shares)), 4) if shares else None
        rows.append({"structure": f"all {'seen' if seen else 'unseen'}", "seen": seen, "success": mean})
    weights = {name: tensor.cpu() for name, tensor in trained.state_dict().items()}
    return Generalist(settings, weights, rows, steps)


def fine_tune(
    trained: Generalist, assembly: Assembly, *, budget: Budget, device: torch.device | str = "cpu"
) -> Iterator[dict[str, Any]]:
    """Fine-tune on one structure, beside a policy that begins anew and has the same time.

    Args:
        trained: the policy to begin with.
        assembly: the structure.
        budget: longest training; a quarter of it is reported too.
        device: where.

    Yields:
        Rows with `structure`, `tuned` (seconds or steps), `from` (`generalist` or `nothing`), and greedy `success` on
        the training and test states of the paper's protocol.
    """
    settings = trained.settings
    bench = Harness(assembly, settings.robots, device)
    began = {
        "generalist": transfer(trained.weights, settings.policy, assembly, bench.device),
        "nothing": make_policy(assembly, settings.policy, bench.device, settings.seed),
    }
    for share_given in (0.0, 0.25, 1.0):
        given = budget.part(share_given)
        for name, policy in began.items():
            tuned = bench.imitate(policy, given, seed=settings.seed)[0] if share_given else policy
            row = {"structure": assembly.name, "tuned": given.length if share_given else 0, "from": name}
            yield {**row, "success": bench.success(tuned)}


def _train(
    settings: GeneralistSettings,
    family: list[TrainingInstance],
    device: torch.device,
    report: Callable[[str], None] | None,
) -> tuple[Policy, int]:
    gpu = device.type == "cuda"
    batch = (settings.batch or (2048 if gpu else 128)) // settings.mix
    draw = np.random.default_rng(settings.seed)
    generator = torch.Generator(device).manual_seed(settings.seed)
    first = make_policy(family[0].assembly, settings.policy, device, settings.seed)
    copies = [[share(first, one) for one in rotated_copies(member.assembly, settings.turns, draw)] for member in family]
    networks = [[Network(policy, "bfloat16" if gpu else "float32") for policy in turns] for turns in copies]
    weights = list(first.parameters())
    matrices = [weight for weight in weights if weight.dim() > 1]
    rest = [weight for weight in weights if weight.dim() <= 1]
    groups = [{"params": matrices, "weight_decay": 0.01}, {"params": rest, "weight_decay": 0.0}]
    optimizer: Any = torch.optim.AdamW(groups, lr=settings.learning_rate, betas=(0.9, 0.98))
    average = [weight.detach().clone() for weight in weights]
    begin, told, steps, done = time.perf_counter(), time.perf_counter(), 0, 0.0
    while done < 1.0:
        rate = settings.learning_rate * min((steps + 1) / 100, 1.0) * min(1.0, 0.01 + 2.0 * (1.0 - done))
        for group in optimizer.param_groups:
            group["lr"] = rate
        optimizer.zero_grad(set_to_none=True)
        losses = []
        for chosen in draw.integers(len(family), size=settings.mix).tolist():
            member, network = family[chosen], networks[chosen][int(draw.integers(settings.turns))]
            rows = torch.randint(len(member.solved), (batch,), generator=generator, device=device)
            states = member.solved.states[rows]
            mask = member.environment.rules.moves(states)
            logits, value = network(states)
            valid = member.solved.valid_actions(states, mask)
            loss = (imitation_loss(logits, mask, valid) + 0.1 * (value - 1.0).square().mean()) / settings.mix
            loss.backward()
            losses.append(loss.detach())
        torch.nn.utils.clip_grad_norm_(weights, 1.0)
        optimizer.step()
        steps += 1
        with torch.no_grad():
            for mean, weight in zip(average, weights, strict=True):
                mean.lerp_(weight, 1.0 - min(0.998, (1 + steps) / (10 + steps)))
        now = time.perf_counter()
        done = steps / settings.steps if settings.steps else (now - begin) / settings.seconds
        if report is not None and now - told > 10.0:
            told = now
            report(f"step {steps}, {100 * done:.0f} %, loss {float(torch.stack(losses).sum()):.3f}")
    with torch.no_grad():
        for mean, weight in zip(average, weights, strict=True):
            weight.copy_(mean)
    return first.eval(), steps


@torch.no_grad()
def _evaluate(policy: Policy, member: TrainingInstance, *, seen: bool) -> dict[str, Any]:
    moved = transfer(policy.state_dict(), policy.settings, member.assembly, member.environment.device)
    states = sample(member.solved.states.cpu().numpy(), EVALUATED)
    success, _ = greedy_success(member.environment, moved, torch.from_numpy(states).to(member.environment.device))
    name = {"structure": member.name, "parts": member.assembly.part_count, "seen": seen}
    return {**name, "states": success.states, "success": round(success.share, 4)}
