"""Fixtures that every room's tests share."""

from __future__ import annotations

import os
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]


def data_folder() -> Path | None:
    """Folder with `assemblies/`: FALSEWORK_DATA, else `shared/` beside the repository; None where neither exists."""
    named = os.environ.get("FALSEWORK_DATA")
    folder = Path(named) if named else REPOSITORY.parent / "shared"
    return folder if (folder / "assemblies").is_dir() else None


@pytest.fixture(scope="session")
def shared_assembly() -> Callable[[str], Path]:
    """Look up one of the paper's structures by folder name; skips the test where the data is not there."""

    def find(name: str) -> Path:
        folder = data_folder()
        if folder is None:
            pytest.skip("real structures not found: set FALSEWORK_DATA to the folder that holds assemblies/")
        path = folder / "assemblies" / name
        if not path.is_dir():
            pytest.skip(f"no structure {name} in {folder / 'assemblies'}")
        return path

    return find


@pytest.fixture(scope="session")
def run_processes(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., None]:
    """Run a script in several processes that find each other as under torchrun; skips the test where torch cannot."""
    torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[gpu]'")
    if not (torch.distributed.is_available() and torch.distributed.is_gloo_available()):
        pytest.skip("this torch has no gloo")

    def run(script: Path, processes: int, *arguments: object) -> None:
        # They meet in a store that is open before they start, as torchrun does it. Its port comes from the system, so
        # that nothing else can take it in between.
        store = torch.distributed.TCPStore("127.0.0.1", 0, is_master=True, wait_for_workers=False)
        common = {"MASTER_ADDR": "127.0.0.1", "MASTER_PORT": str(store.port), "TORCHELASTIC_USE_AGENT_STORE": "True"}
        common |= {"WORLD_SIZE": str(processes), "OMP_NUM_THREADS": "1"}
        command = [sys.executable, str(script), *map(str, arguments)]
        said = [tmp_path_factory.mktemp("process") / "stderr" for _ in range(processes)]
        running, codes, left = [], [], 100.0
        try:
            for rank, path in enumerate(said):
                own = {**os.environ, **common, "RANK": str(rank), "LOCAL_RANK": str(rank)}
                with path.open("w") as file:
                    running.append(subprocess.Popen(command, env=own, stderr=file))
            while None in (codes := [process.poll() for process in running]) and left > 0:
                time.sleep(0.05)
                left -= 1.0 if any(codes) else 0.05  # once one has failed, the others end soon or never
        finally:
            for process in running:
                process.kill()
                process.wait()
        assert codes == [0] * processes, "\n".join([f"they ended with {codes}", *(path.read_text() for path in said)])

    return run
