"""Program of each process of `test_processes.py`: some updates and short trainings, whose weights go to files."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import torch
from safetensors.torch import save_file

from falsework import load_structure, make_task
from falsework.learn import (
    PPO,
    REINFORCEMENT,
    Curriculum,
    Environment,
    ImitationPhase,
    LearnerContext,
    PolicySettings,
    PpoPhase,
    TrainSettings,
    make_policy,
)
from falsework.learn.algorithms.start_states import StartBatch
from falsework.learn.training import train as module
from falsework.learn.training.trainer import Trainer
from falsework.search import BeamSearch, BeamSettings
from falsework.utils.distributed import ProcessGroup, init_distributed

PHASES = {
    "default": (ImitationPhase(until=0.5, batch=16), PpoPhase(rollouts=512, batch=64, epochs=1)),
    "reinforcement": (replace(REINFORCEMENT, rollouts=16, batch=16),),
}


def main() -> None:
    """Learn with the processes of the environment: some updates, then a training in each way that is named."""
    torch.set_num_threads(1)
    folder = Path(sys.argv[1])
    kept: dict[str, Trainer] = {}

    class Kept(Trainer):
        """Shows the trainer of each process to this script."""

        def __init__(self, *arguments: Any, **named: Any) -> None:
            super().__init__(*arguments, **named)
            kept["trainer"] = self

    setattr(module, "Trainer", Kept)  # noqa: B010
    with init_distributed("cpu") as (shards, device):
        update(folder, shards, device)
        for method in sys.argv[2:]:
            run(method, folder / method, kept)
    threads = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
    assert not [name for name in threads if "gloo" in name], "the group has outlived its block"


def update(folder: Path, shards: ProcessGroup, device: torch.device) -> None:
    """Some updates of one policy."""
    assembly = load_structure("arch:blocks=5")
    environment = Environment(assembly, 2, device=device)
    search = BeamSearch(make_task(assembly), environment.oracle, BeamSettings(width=4))
    search.run()
    states = torch.from_numpy(search.states())
    policy = make_policy(assembly, PolicySettings(kind="mlp", layers=1, channels=16), device, 0)
    curriculum = Curriculum(states, environment.rules, shards=shards)
    settings = replace(REINFORCEMENT, batch=64, epochs=2)
    ppo = PPO(LearnerContext(environment, policy, curriculum, settings, shards=shards))
    generator = environment.generator(9 + shards.rank)
    numbers = [ppo.update(curriculum.sample(12 + 20 * shards.rank, generator)) for _ in range(3)]
    # One process has nothing to learn; it must not keep the others waiting.
    there = environment.rules.goals(environment.rules.complete(4))
    rows = torch.arange(4)
    numbers.append(ppo.update(StartBatch(there if shards.rank else environment.rules.complete(4), rows=rows)))
    report = {f"report.{name}": torch.tensor([one[name] for one in numbers]) for name in numbers[-1]}
    tensors = {**ppo.state_dict(), **report}
    save_file({name: one.clone().contiguous() for name, one in tensors.items()}, folder / str(shards.rank))


def run(method: str, folder: Path, kept: dict[str, Trainer]) -> None:
    """One training."""
    settings = TrainSettings(
        phases=PHASES[method],
        steps=20,
        block=10,
        data="width64",
        evaluations=8,
        evaluation_states=32,
        policy=PolicySettings("resmlp", channels=16, layers=1),
    )
    folder.mkdir(exist_ok=True)
    result = module.train(load_structure("arch:blocks=13"), settings, folder=folder / "run", device="cpu", logs=())
    rank = ProcessGroup.from_torch().rank
    weights = {name: tensor.clone() for name, tensor in kept["trainer"].policy.state_dict().items()}
    weights["solved"] = kept["trainer"].solved.states.clone()
    save_file(weights, folder / f"{rank}.safetensors")
    own = kept["trainer"].environment.counters.steps
    (folder / f"{rank}.json").write_text(json.dumps({"own_steps": own, **result.to_dict()}))


if __name__ == "__main__":
    main()
