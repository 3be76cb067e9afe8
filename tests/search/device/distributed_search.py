"""Program of each process of `test_distributed.py`: some searches, whose levels go to a file."""

from __future__ import annotations

import sys
from typing import Any

import numpy as np

from falsework import Direction, Task
from falsework.search import BeamSettings
from falsework.search.device.beam import device_beam
from falsework.search.device.oracle import TensorOracle
from falsework.utils.distributed import ProcessGroup, init_distributed

PARTS = 18

SEARCHES = (
    BeamSettings(width=16, direction=Direction.ASSEMBLY, seed=3),
    BeamSettings(width=7, direction=Direction.DISASSEMBLY, seed=4),
    # A pool this small makes the clusters of a sample only.
    BeamSettings(width=12, direction=Direction.DISASSEMBLY, pool=PARTS * 50),
    BeamSettings(width=5, diversity="none"),
)


class NeighboursStand(TensorOracle):
    """An installed part stands on either of the two before it, or on the ground beside it."""

    def __call__(self, states: Any, parents: Any) -> Any:
        present = states > 0
        support = present.roll(1, 1) | present.roll(2, 1)
        support[:, 1::5] = True
        return ((states != 1) | support).all(dim=1).to(states.dtype).char() * 2 - 1


def search_all(device: str, shards: ProcessGroup) -> dict[str, Any]:
    """Every search, as arrays to compare."""
    task = Task.from_rules(np.arange(PARTS) == 0, 3)
    arrays: dict[str, Any] = {}
    for index, settings in enumerate(SEARCHES):
        search = device_beam(task, NeighboursStand(), settings, device, shards)
        result = search.run()
        arrays[f"states {index}"] = search.states()
        arrays[f"parent {index}"] = np.concatenate([level.parent for level in search.levels])
        arrays[f"counters {index}"] = np.array(list(vars(result.counters).values()))
        arrays[f"route {index}"] = result.routes[0].states if result.found else np.empty(0)
    return arrays


def main() -> None:
    """Search with the processes that the environment names."""
    with init_distributed("cpu") as (shards, device):
        arrays = search_all(str(device), shards)
        np.savez(f"{sys.argv[1]}/{shards.rank}-of-{shards.size}.npz", **arrays)


if __name__ == "__main__":
    main()
