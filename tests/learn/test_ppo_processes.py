"""Several processes that learn together hold the same weights and the same curriculum, whatever each of them played."""

from __future__ import annotations

import os
import socket
import subprocess
import sys
from pathlib import Path

import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")
if not (torch.distributed.is_available() and torch.distributed.is_gloo_available()):
    pytest.skip("this torch has no gloo", allow_module_level=True)

from safetensors.torch import load_file  # noqa: E402

SCRIPT = Path(__file__).with_name("distributed_ppo.py")


def free_port() -> int:
    with socket.socket() as sock:
        sock.bind(("127.0.0.1", 0))
        return sock.getsockname()[1]


def test_two_processes_agree_after_every_update(tmp_path: Path) -> None:
    common = {"WORLD_SIZE": "2", "MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(free_port()), "OMP_NUM_THREADS": "1"}
    running = [
        subprocess.Popen(
            [sys.executable, str(SCRIPT), str(tmp_path)],
            env={**os.environ, **common, "RANK": str(rank), "LOCAL_RANK": str(rank)},
            stderr=subprocess.PIPE,
            text=True,
        )
        for rank in range(2)
    ]
    try:
        for process in running:
            _, error = process.communicate(timeout=100)
            assert process.returncode == 0, error
    finally:
        for process in running:
            process.kill()
    one, two = (load_file(tmp_path / str(rank)) for rank in range(2))
    assert set(one) == set(two)
    for name, tensor in one.items():
        assert tensor.isfinite().all()
        assert torch.equal(tensor, two[name]), f"{name} differs"
    assert int(one["updates"]) == 4
