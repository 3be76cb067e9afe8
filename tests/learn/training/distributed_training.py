"""What each process of `test_train.py` runs: a short training, whose weights and numbers go to a file."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

from safetensors.torch import save_file

from falsework.assembly import load_structure
from falsework.learn.config.imitation import ImitationPhase
from falsework.learn.config.policy import PolicySettings
from falsework.learn.config.ppo import PAPER, PpoPhase
from falsework.learn.config.train import TrainSettings
from falsework.learn.training import train as module
from falsework.learn.training.trainer import Trainer
from falsework.utils.distributed import ProcessGroup, init_distributed

PHASES = {
    "default": (ImitationPhase(until=0.5, batch=16), PpoPhase(rollouts=16, batch=16)),
    "paper": (replace(PAPER, rollouts=16, batch=16),),
}


def main() -> None:
    """Train in each way that is named, with the processes of the environment."""
    kept: dict[str, Trainer] = {}

    class Kept(Trainer):
        """Shows the trainer of each process to this script."""

        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            kept["trainer"] = self

    setattr(module, "Trainer", Kept)  # noqa: B010
    with init_distributed("cpu"):
        for method in sys.argv[2:]:
            run(method, Path(sys.argv[1]) / method, kept)
    threads = [path.read_text().strip() for path in Path("/proc/self/task").glob("*/comm")]
    assert not [name for name in threads if "gloo" in name], "the group has outlived its block"


def run(method: str, folder: Path, kept: dict[str, Trainer]) -> None:
    """One training."""
    settings = TrainSettings(
        phases=PHASES[method],
        steps=20,
        block=10,
        data="width64",
        evaluate_every=1,
        evaluation_states=32,
        policy=PolicySettings("resmlp", channels=16, layers=1),
    )
    folder.mkdir(exist_ok=True)
    result = module.train(load_structure("arch:blocks=13"), settings, folder=folder / "run", device="cpu", logs=())
    rank = ProcessGroup.of_group().rank
    weights = {name: tensor.clone() for name, tensor in kept["trainer"]._policy.state_dict().items()}
    weights["solved"] = kept["trainer"]._solved.states.clone()
    save_file(weights, folder / f"{rank}.safetensors")
    own = kept["trainer"]._environment.counters.steps
    (folder / f"{rank}.json").write_text(json.dumps({"own_steps": own, **result.to_dict()}))


if __name__ == "__main__":
    main()
