"""What each process of `test_train.py` runs: a short training, whose weights and numbers go to a file."""

from __future__ import annotations

import json
import sys
from pathlib import Path
from typing import Any

from falsework.assembly import load_structure
from falsework.learn.policy_settings import PolicySettings
from falsework.learn.settings import ImitationSettings, ImproveRounds, TrainSettings
from falsework.learn.train import train
from falsework.learn.trainer import Trainer
from falsework.search.shards import Shards, joined


def main() -> None:
    """Train with the processes that the environment names."""
    from safetensors.torch import save_file

    from falsework.learn import train as module

    settings = TrainSettings(
        method=sys.argv[2],  # pyright: ignore[reportArgumentType]
        steps=20,
        block=10,
        widths=(8,),
        evaluate_every=1,
        policy=PolicySettings("residual", channels=16, layers=1),
        imitation=ImitationSettings(batch=16),
        improve=ImproveRounds(first=0.0, every=1, starts=10),
    )
    kept: dict[str, Trainer] = {}

    class Kept(Trainer):
        """Shows the trainer of each process to this script."""

        def __init__(self, *arguments: Any) -> None:
            super().__init__(*arguments)
            kept["trainer"] = self

    setattr(module, "Trainer", Kept)  # noqa: B010
    folder = Path(sys.argv[1])
    with joined("cpu"):
        result = train(load_structure("arch:blocks=7"), settings, folder=folder / "run", device="cpu", logs=())
        rank = Shards.of_group().rank
        weights = {name: tensor.clone() for name, tensor in kept["trainer"]._policy.state_dict().items()}
        weights["solved"] = kept["trainer"]._solved.states.clone()
        save_file(weights, folder / f"{rank}.safetensors")
        own = kept["trainer"]._environment.counters.steps
        (folder / f"{rank}.json").write_text(json.dumps({"own_steps": own, **result.as_json()}))


if __name__ == "__main__":
    main()
