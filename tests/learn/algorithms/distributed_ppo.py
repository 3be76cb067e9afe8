"""What each process of `test_ppo_processes.py` runs: some updates, whose weights go to a file."""

from __future__ import annotations

import sys
from dataclasses import replace

import torch
from safetensors.torch import save_file

from falsework.assembly import load_structure
from falsework.learn.algorithms.curriculum import Curriculum
from falsework.learn.algorithms.ppo import PPO
from falsework.learn.algorithms.start_states import StartBatch
from falsework.learn.config.policy import PolicySettings
from falsework.learn.config.ppo import PAPER
from falsework.learn.env.environment import Environment
from falsework.learn.networks.factory import make_policy
from falsework.search import BeamSearch, BeamSettings, task_of
from falsework.utils.distributed import init_distributed


def main() -> None:
    """Learn with the processes that the environment names."""
    torch.set_num_threads(1)
    with init_distributed("cpu") as (shards, device):
        assembly = load_structure("arch:blocks=5")
        environment = Environment(assembly, 2, device=device)
        search = BeamSearch(task_of(assembly), environment.oracle, BeamSettings(width=4))
        search.run()
        states = torch.from_numpy(search.states())
        policy = make_policy(assembly, PolicySettings(kind="mlp", layers=1, channels=16), device, 0)
        curriculum = Curriculum(states, environment.rules, shards=shards)
        ppo = PPO(environment, policy, curriculum, replace(PAPER, batch=64, epochs=2), shards=shards)
        generator = environment.generator(9 + shards.rank)
        numbers = [ppo.update(curriculum.sample(12 + 20 * shards.rank, generator)) for _ in range(3)]
        # One process has nothing to learn; it must not keep the others waiting.
        there = environment.rules.goals(environment.rules.complete(4))
        rows = torch.arange(4)
        numbers.append(ppo.update(StartBatch(there if shards.rank else environment.rules.complete(4), rows=rows)))
        report = {f"report.{name}": torch.tensor([one[name] for one in numbers]) for name in numbers[-1]}
        tensors = {**ppo.state_dict(), **report}
        save_file({name: one.clone().contiguous() for name, one in tensors.items()}, f"{sys.argv[1]}/{shards.rank}")


if __name__ == "__main__":
    main()
