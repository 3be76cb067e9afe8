"""Several processes that learn together hold the same weights and the same curriculum, whatever each of them played."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from safetensors.torch import load_file  # noqa: E402

SCRIPT = Path(__file__).with_name("distributed_ppo.py")


@pytest.mark.slow
def test_two_processes_agree_after_every_update(tmp_path: Path, run_processes: Callable[..., None]) -> None:
    run_processes(SCRIPT, 2, tmp_path)
    one, two = (load_file(tmp_path / str(rank)) for rank in range(2))
    assert set(one) == set(two)
    for name, tensor in one.items():
        assert tensor.isfinite().all()
        assert torch.equal(tensor, two[name]), f"{name} differs"
    assert int(one["updates"]) == 4
