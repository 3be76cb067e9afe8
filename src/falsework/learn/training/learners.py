"""Learners of the phases of a training run, and their state in a checkpoint."""

from __future__ import annotations

import torch

from falsework.errors import InputError
from falsework.learn.algorithms.curriculum import Curriculum
from falsework.learn.algorithms.exploration import Exploration
from falsework.learn.algorithms.extension import Extension
from falsework.learn.algorithms.imitation import Imitation
from falsework.learn.algorithms.learner import Learner
from falsework.learn.algorithms.learner_context import LearnerContext
from falsework.learn.algorithms.ppo import PPO
from falsework.learn.algorithms.start_states import MixedStarts, StartSampler
from falsework.learn.config.imitation import ImitationPhase
from falsework.learn.config.train import Phase
from falsework.learn.data.solvable_states import SolvableStates
from falsework.learn.env.environment import Environment
from falsework.learn.env.rollout import forward_in_pieces
from falsework.learn.networks.autocast import Network
from falsework.learn.networks.policy import Policy
from falsework.learn.training.plugins import Plugins
from falsework.learn.training.run_context import RunContext
from falsework.learn.training.training_data import TrainingData
from falsework.utils.collectives import gather_rows
from falsework.utils.distributed import ProcessGroup
from falsework.utils.tensors import below


def learner_of(
    run: RunContext,
    environment: Environment,
    policy: Policy,
    solved: SolvableStates,
    data: TrainingData,
    phase: Phase,
    *,
    begin: float,
    compiled: bool,
    plugins: Plugins = Plugins(),
) -> Learner:
    """Make the learner of a phase.

    Args:
        environment: rules and verdicts.
        policy: trained in place.
        solved: states known to be solvable.
        phase: its settings.
        begin: progress of the whole training at which the phase begins.
        compiled: compile the network.
        plugins: reward and learner of PPO, where users bring their own.

    Raises:
        InputError: a learner of a user is none.
    """
    settings = run.settings
    if isinstance(phase, ImitationPhase):
        return Imitation(
            policy,
            solved,
            phase,
            tasks=data.tasks,
            seed=settings.seed,
            precision=settings.precision,
            compiled=compiled,
            shards=run.shards,
        )
    rules, starts = environment.rules, data.starts
    if phase.starts == "mixed":
        rollouts = max(phase.rollouts // run.shards.size, 1)
        network = Network(policy, settings.precision)
        sampler: StartSampler = MixedStarts(
            starts,
            solved,
            rollouts,
            tasks=data.tasks,
            value=lambda states, targets: forward_in_pieces(network, states, targets)[1],
            extension=Extension(environment, solved),
        )
    else:
        if phase.starts == "complete":
            starts = rules.complete()
        sampler = Curriculum(
            starts,
            rules,
            solved=solved,
            anywhere=phase.anywhere,
            exploration=Exploration(environment, solved, starts) if phase.explored else None,
            explored=phase.explored,
            shards=run.shards,
        )
    context = LearnerContext(
        environment,
        policy,
        sampler,
        phase,
        solved,
        plugins.reward,
        begin,
        settings.seed,
        settings.precision,
        compiled,
        run.shards,
    )
    learner = (plugins.learner or PPO)(context)
    if not isinstance(learner, Learner):
        raise InputError(f"{settings.learner} gives no falsework.learn.Learner; derive its class from that")
    return learner


def share_solved(solved: SolvableStates, known: int, shards: ProcessGroup) -> None:
    """Exchange the states that each process has found solvable since it had `known` states."""
    if shards.size > 1:
        solved.add(gather_rows(solved.states[known:], shards))
        solved.learn_held_out_hashes(gather_rows(solved.held_out_hashes(), shards))
        solved.sort()


def gather_local(local: dict[str, torch.Tensor], shards: ProcessGroup, device: torch.device) -> dict[str, torch.Tensor]:
    """Gather the local state of all processes, under names with the rank of each."""
    whole: dict[str, torch.Tensor] = {}
    for name in sorted(local):
        rows = local[name].to(device)
        counts = gather_rows(torch.tensor([len(rows)], device=device), shards).tolist()
        pieces = gather_rows(rows, shards).split(counts)
        whole |= {f"process.{rank}.{name}": piece for rank, piece in enumerate(pieces)}
    return whole


def local_of(tensors: dict[str, torch.Tensor], shards: ProcessGroup) -> dict[str, torch.Tensor] | None:
    """Return the state that `gather_local` stored for this process; None if there were more or fewer of them."""
    ranks = {int(name.split(".")[1]) for name in tensors if name.startswith("process.")}
    return below(f"process.{shards.rank}.", tensors) if len(ranks) == shards.size else None
