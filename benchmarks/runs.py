"""Runs of a benchmark side by side, each in a process of its own and a line of a file, from which it can be resumed.

A run is described by a JSON object; the process that makes it prints another one, with the figures, as its last line.
"""

from __future__ import annotations

import json
import os
import queue
import subprocess
import sys
import tempfile
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from concurrent.futures import ThreadPoolExecutor
from contextlib import contextmanager
from pathlib import Path
from typing import Any

Run = dict[str, Any]
"""Case of a benchmark with its figures."""
Key = tuple[Any, ...]
"""Fields that tell a run from all others."""

SOURCE = Path(__file__).resolve().parents[1]
"""Source tree of this file."""
_NUMBA_AND_BLAS = ("NUMBA_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS", "OMP_NUM_THREADS")


@contextmanager
def kept(path: Path | None) -> Iterator[Path]:
    """Yield a file for runs, a temporary one where none is given."""
    with tempfile.TemporaryDirectory() as folder:
        path = path or Path(folder, "runs.jsonl")
        path.parent.mkdir(parents=True, exist_ok=True)
        yield path


def read_runs(path: Path | None, key_of: Callable[[Run], Key]) -> dict[Key, Run]:
    """Return the runs of a file; a last line that was cut short is left out."""
    found: dict[Key, Run] = {}
    for line in path.read_text(encoding="utf-8").splitlines() if path is not None and path.exists() else ():
        try:
            run = json.loads(line)
        except json.JSONDecodeError:
            continue
        found[key_of(run)] = run
    return found


def append(path: Path, run: Run) -> None:
    """Write a run at the end of a file."""
    with path.open("a", encoding="utf-8") as file:
        file.write(json.dumps(run) + "\n")


def printed_by(command: Sequence[str], patience: float, source: Path = SOURCE) -> Run:
    """Return the figures that a script prints as its last line, in a process of its own with one thread.

    A process that fails, or is not done after `patience` seconds, has the figures `ended`, `failed` or `killed`, and
    `error`.

    Args:
        command: script and arguments.
        patience: seconds.
        source: source tree whose code runs.

    Raises:
        KeyboardInterrupt: the process was interrupted.
    """
    path = os.pathsep.join(str(folder) for folder in (source.resolve() / "src", Path(__file__).parent))
    environment = {**os.environ, **dict.fromkeys(_NUMBA_AND_BLAS, "1"), "PYTHONPATH": path}
    whole = [sys.executable, "-W", "ignore", *command]
    try:
        done = subprocess.run(whole, env=environment, capture_output=True, text=True, timeout=patience, check=False)
    except subprocess.TimeoutExpired:
        return {"ended": "killed", "error": f"not done after {patience:g} s"}
    if done.returncode in (-2, 130):
        raise KeyboardInterrupt
    if done.returncode:
        return {"ended": "failed", "error": done.stderr[-1000:] or f"exit code {done.returncode}"}
    return json.loads(done.stdout.splitlines()[-1])


def own_cores() -> list[int]:
    """Return the numbers of the cores that this process may use; of one where the system does not say."""
    return sorted(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else [0]


def run_all(
    todo: Sequence[Run],
    make: Callable[[Run, int], Run],
    note: Callable[[Run], None],
    processes: int,
    *,
    until: float | None = None,
) -> int:
    """Make runs side by side, and pass each to `note`; return how many were not begun in time.

    Args:
        todo: the cases.
        make: makes the run of a case on a core of this number.
        note: called with each run, one at a time.
        processes: runs at the same time.
        until: time by `time.perf_counter` after which no more runs begin.
    """
    cores = own_cores()
    free: queue.SimpleQueue[int] = queue.SimpleQueue()
    for number in range(processes):
        free.put(cores[number % len(cores)])
    lock = threading.Lock()

    def one(case: Run) -> int:
        if until is not None and time.perf_counter() > until:
            return 1
        core = free.get()
        try:
            run = make(case, core)
        finally:
            free.put(core)
        with lock:
            note(run)
        return 0

    with ThreadPoolExecutor(processes) as pool:
        try:
            return sum(pool.map(one, todo))
        except BaseException:
            pool.shutdown(cancel_futures=True)
            raise
