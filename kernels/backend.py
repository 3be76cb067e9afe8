"""Build backend: hatchling, and before a wheel the archive of kernels, for which the package itself has to run.

An editable installation builds nothing: `make kernels` makes the archive there, and numba compiles until then.
"""

from __future__ import annotations

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
RUN = "import runpy, sys; sys.path.insert(0, sys.argv.pop(1)); runpy.run_path(sys.argv.pop(1), run_name='__main__')"
"""Program that runs a script with a folder to import from. `PYTHONPATH` does not do: where that folder is installed as
editable, pip takes it out of the paths of the interpreter."""


def get_requires_for_build_wheel(config_settings: dict[str, Any] | None = None) -> list[str]:
    """Return what the package needs to run, besides what hatchling needs."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    return [*hatchling.build.get_requires_for_build_wheel(config_settings), *project["dependencies"]]


def build_wheel(folder: str, config_settings: dict[str, Any] | None = None, metadata: str | None = None) -> str:
    """Build a wheel with an archive that fits its sources; return its name."""
    subprocess.run([sys.executable, "-c", RUN, ROOT / "src", ROOT / "kernels/archive.py"], check=True)
    return hatchling.build.build_wheel(folder, config_settings, metadata)
