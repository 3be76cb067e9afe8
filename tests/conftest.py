"""Fixtures that every room's tests share."""

from __future__ import annotations

import os
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
