"""Published structures that are in equilibrium on paper and slide in reality."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def public_structure(shared_assembly: Callable[[str], Path]) -> Callable[[str], Path]:
    """Look up a public structure by folder name; skips the test where the data is not there."""

    def find(name: str) -> Path:
        path = shared_assembly("bottle-12").parents[1] / "structures" / name
        if not path.is_dir():
            pytest.skip(f"no structure {name} in {path.parent}")
        return path

    return find
