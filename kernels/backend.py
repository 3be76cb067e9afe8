"""Build backend: hatchling, and before a wheel the archive of kernels, for which the package itself has to run.

An editable installation builds nothing: `make kernels` makes the archive there, and numba compiles until then.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tomllib
from pathlib import Path
from typing import Any

import hatchling.build
from hatchling.build import build_editable, build_sdist, get_requires_for_build_editable, get_requires_for_build_sdist

__all__ = [
    "build_editable",
    "build_sdist",
    "build_wheel",
    "get_requires_for_build_editable",
    "get_requires_for_build_sdist",
    "get_requires_for_build_wheel",
]

ROOT = Path(__file__).resolve().parents[1]


def get_requires_for_build_wheel(config_settings: dict[str, Any] | None = None) -> list[str]:
    """Return what the package needs to run, besides what hatchling needs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [*hatchling.build.get_requires_for_build_wheel(config_settings), *project["dependencies"]]


def build_wheel(folder: str, config_settings: dict[str, Any] | None = None, metadata: str | None = None) -> str:
    """Build a wheel with an archive that fits its sources; return its name."""
    source = os.pathsep.join([str(ROOT / "src"), *filter(None, [os.environ.get("PYTHONPATH")])])
    subprocess.run([sys.executable, ROOT / "kernels/archive.py"], check=True, env={**os.environ, "PYTHONPATH": source})
    return hatchling.build.build_wheel(folder, config_settings, metadata)
