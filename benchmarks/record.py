"""Record of a benchmark: its figures and the run that they come from, as one JSON object per line.

Every benchmark prints its figures by `report` and, with `--out`, appends them to a file of `benchmarks/results`, from
which `benchmarks/tables.py` makes the tables of README and documentation.
"""

from __future__ import annotations

import json
import os
import platform
import shlex
import subprocess
import sys
from collections.abc import Sequence
from datetime import date
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

import numpy as np

ORIGIN = ("benchmark", "command", "commit", "date", "device", "seeds", "versions")
"""Keys of every record. Where the command is not known, `provenance` names the source of the figures."""
LOAD_BEFORE = os.getloadavg()[0] if hasattr(os, "getloadavg") else None
"""Load average of the machine over the minute before the benchmark began; above 1, other processes were computing."""

_PACKAGES = ("falsework", "numpy", "numba", "torch", "stable_baselines3")
_files: list[Path] = []


def write_to(path: Path | None) -> None:
    """Append all further records to a file."""
    _files[:] = [] if path is None else [path]


def report(benchmark: str, *, seeds: Sequence[int] = (), device: Any = "cpu", **figures: Any) -> None:
    """Print one record, and append it to the file of `write_to`.

    Args:
        benchmark: the name of the script and what it measures, such as `search plan`.
        seeds: seeds of the run; empty where nothing is random.
        device: where the work was done: `cpu`, `cuda`, or a device of torch.
        figures: the figures, in units that their names give.
    """
    line = json.dumps({"benchmark": benchmark, **rounded(figures), "seeds": list(seeds), **origin(device)})
    print(line, flush=True)
    for path in _files:
        path.parent.mkdir(parents=True, exist_ok=True)
        with path.open("a", encoding="utf-8") as file:
            file.write(line + "\n")


def rounded(value: Any) -> Any:
    """Return a value with every float rounded to six digits."""
    if isinstance(value, dict):
        return {key: rounded(inner) for key, inner in value.items()}
    if isinstance(value, list | tuple):
        return [rounded(inner) for inner in value]
    return float(f"{value:.6g}") if isinstance(value, float) else value


def spread(values: Sequence[float]) -> dict[str, float]:
    """Return median and range."""
    low, median, high = (float(value) for value in np.quantile(values, [0, 0.5, 1]))
    return {"median": median, "least": low, "most": high}


def origin(device: Any = "cpu") -> dict[str, Any]:
    """Return command, commit, date, device and versions of this process."""
    found = {
        "command": command(),
        "commit": commit(),
        "date": date.today().isoformat(),
        "device": gpu() if str(device).startswith("cuda") else processor(),
        "versions": versions(),
    }
    return found if LOAD_BEFORE is None else {**found, "load_before": round(LOAD_BEFORE, 2)}


def command() -> str:
    """Return the command line that repeats this run, without `--out`."""
    words = iter(sys.argv[1:])
    kept = []
    for word in words:
        if word == "--out":
            next(words, None)
        elif not word.startswith("--out="):
            kept.append(word)
    processes = int(os.environ.get("WORLD_SIZE", "1"))
    start = f"torchrun --nproc-per-node {processes}" if processes > 1 else "python"
    return f"{start} benchmarks/{Path(sys.argv[0]).name} {shlex.join(kept)}".strip()


def commit() -> str:
    """Return the current commit, with `-dirty` where code has changed since; COMMIT where there is no git."""
    here = str(Path(__file__).parent)
    hashed = subprocess.run(
        ["git", "-C", here, "rev-parse", "--short=7", "HEAD"], capture_output=True, text=True, check=False
    )
    if hashed.returncode:
        return os.environ.get("COMMIT", "unknown")
    changed = [
        "git",
        "-C",
        here,
        "status",
        "--porcelain",
        "--untracked-files=no",
        "--",
        ".",
        "../src",
        ":!results",
        ":!*.md",
    ]
    dirty = subprocess.run(changed, capture_output=True, text=True, check=False).stdout.strip()
    return hashed.stdout.strip() + ("-dirty" if dirty else "")


def processor() -> str:
    """Return the CPU model and the number of cores that this process may use."""
    model = platform.processor() or platform.machine()
    about = Path("/proc/cpuinfo")
    if about.exists():
        names = [line.partition(":")[2].strip() for line in about.read_text().splitlines() if "model name" in line]
        model = names[0] if names else model
    from falsework.utils.cores import core_count  # here, since benchmarks run with the code of older commits too

    cores = core_count()
    return f"{model}, {cores} core{'s' if cores != 1 else ''}"


def gpu() -> str:
    """Return name and driver of the GPU."""
    query = ["nvidia-smi", "--query-gpu=name,driver_version", "--format=csv,noheader"]
    first = subprocess.run(query, capture_output=True, text=True, check=True).stdout.splitlines()[0]
    return first.replace(", ", ", driver ")


def versions() -> dict[str, str]:
    """Return the versions of Python and of the packages in use."""
    found = {"python": platform.python_version()}
    for name in _PACKAGES:
        if name in sys.modules:
            try:
                found[name] = version(name)
            except PackageNotFoundError:
                continue
    return found
