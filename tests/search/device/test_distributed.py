"""Several processes find what one finds, to the last bit."""

from __future__ import annotations

import runpy
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[gpu]'")

from falsework.utils.distributed import ProcessGroup, init_distributed  # noqa: E402

SCRIPT = Path(__file__).with_name("distributed_search.py")


def test_two_processes_find_the_same_levels_as_one(tmp_path: Path, run_processes: Callable[..., None]) -> None:
    run_processes(SCRIPT, 2, tmp_path)
    alone = runpy.run_path(str(SCRIPT))["search_all"]("cpu", ProcessGroup())
    shares = [np.load(tmp_path / f"{rank}-of-2.npz") for rank in range(2)]
    assert sum(len(alone[name]) > 0 for name in alone if name.startswith("route")) >= 3
    for name, expected in alone.items():
        for share in shares:
            assert np.array_equal(share[name], expected), f"{name} differs"


@pytest.mark.skipif(not torch.cuda.is_available(), reason="this machine has no GPU")
def test_a_gpu_finds_the_same_levels_as_the_processor() -> None:
    search_all = runpy.run_path(str(SCRIPT))["search_all"]
    alone, on_device = search_all("cpu", ProcessGroup()), search_all("cuda", ProcessGroup())
    for name, expected in alone.items():
        assert np.array_equal(on_device[name], expected), f"{name} differs"


def test_without_torchrun_there_is_one_process(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delenv("RANK", raising=False)
    with init_distributed("cpu") as (shards, device):
        assert shards == ProcessGroup()
        assert shards.is_main_process
        assert device.type == "cpu"
