"""docs/architecture.md names existing files, and every layer of the package."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

REPOSITORY = Path(__file__).resolve().parents[1]
SOURCE = REPOSITORY / "src" / "falsework"
TEXT = (REPOSITORY / "docs" / "architecture.md").read_text(encoding="utf-8")
PATHS = sorted({name for name in re.findall(r"`([^`\n]+)`", TEXT) if "/" in name or name.endswith(".py")})


@pytest.mark.parametrize("path", PATHS)
def test_paths_exist(path: str) -> None:
    assert (SOURCE / path).exists() or (REPOSITORY / path).exists()


def test_every_layer_is_described() -> None:
    folders = {path.parent.name + "/" for path in SOURCE.glob("*/__init__.py")}
    assert folders <= set(PATHS)
