"""Several processes that learn together hold the same weights and the same curriculum, whatever each of them played."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")
safetensors = pytest.importorskip("safetensors.torch", reason="safetensors is not installed")

from falsework import load_structure  # noqa: E402
from falsework.learn import load_run  # noqa: E402
from falsework.learn.data.dataset import load_dataset  # noqa: E402
from falsework.learn.data.symmetry import symmetries  # noqa: E402
from falsework.learn.data.symmetry_augmentation import symmetric_images  # noqa: E402

PARALLEL = ("default", "reinforcement")


@pytest.fixture(scope="module")
def learned(tmp_path_factory: pytest.TempPathFactory, run_processes: Callable[..., None]) -> Path:
    """Folder of what two processes learned."""
    folder = tmp_path_factory.mktemp("learned")
    run_processes(Path(__file__).with_name("distributed_learning.py"), 2, folder, *PARALLEL)
    return folder


@pytest.mark.slow
def test_two_processes_agree_after_every_update(learned: Path) -> None:
    one, two = (safetensors.load_file(learned / str(rank)) for rank in range(2))
    assert set(one) == set(two)
    for name, tensor in one.items():
        assert tensor.isfinite().all()
        assert torch.equal(tensor, two[name]), f"{name} differs"
    assert int(one["updates"]) == 4


@pytest.mark.slow
@pytest.mark.parametrize("method", PARALLEL)
def test_two_processes_are_one_training(learned: Path, method: str) -> None:
    """The same weights and known states in both, to the last bit; steps of the environment add up."""
    folder = learned / method
    one, two = (safetensors.load_file(folder / f"{rank}.safetensors") for rank in range(2))
    assert all(torch.equal(tensor, two[name]) for name, tensor in one.items())
    numbers = [json.loads((folder / f"{rank}.json").read_text()) for rank in range(2)]
    assert numbers[0]["environment"]["steps"] == sum(each["own_steps"] for each in numbers)
    assert numbers[0]["test"] == numbers[1]["test"]
    assert numbers[0]["processes"] == 2
    assert load_run(folder / "run").metadata["results"]["processes"] == 2
    arch = load_structure("arch:blocks=13")
    data = load_dataset(folder / "run" / "data.npz", arch)
    held_out = {
        state.tobytes() for state in symmetric_images(np.concatenate([data.test, data.validation]), symmetries(arch))
    }
    states = [state for state in data.train if state.tobytes() not in held_out]
    found = len(one["solved"]) > len(states)
    assert found == (method == "default")  # rollouts of either process found more, which the paper's way ignores
