"""Time the first commands after installation, against an earlier commit: one JSON object per line.

    python benchmarks/first_minute.py
    python benchmarks/first_minute.py --before 2b3aed5 --earlier-repeats 1
    python benchmarks/first_minute.py --commands help --before ""

Each command runs in a process of its own. `cache` is `empty` where no compiled code was kept before, `warm` where the
same command has run once. `demo` is what `make demo` does after the installation: plan the built-in vault and check the
plan. Arms move where the structure bottle-12 is there. `seconds`, `processor_seconds` (of all threads and child
processes) and `peak_gib` are median and range over the repeats. `before` has the same of the earlier commit, from a git
worktree and in alternation with the present one, both with the archive of kernels that an installation has; an earlier
run from empty caches takes minutes, so there are fewer of those, and none of the plan that `demo` begins with.
`ratio` is processor time over that before.
"""

from __future__ import annotations

import os
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import tyro
from record import report, spread, write_to
from states import find, real_structures

REPOSITORY = Path(__file__).resolve().parents[1]
COMMANDS = {
    "help": ("--help",),
    "stability arch": ("stability arch",),
    "plan arch": ("plan arch --out arch.json",),
    "plan vault": ("plan vault --out vault.json",),
    "picture arch": ("picture arch --out arch.png",),
    "robots plan bottle-12": (f"robots plan {find('bottle-12')} --cell bottle-12 --out robot_plan.json",),
    "demo": ("plan vault --robots 2 --out vault.json", "check vault.json"),
}
ROWS = (
    ("help", "warm"),
    ("plan arch", "warm"),
    ("plan vault", "warm"),
    ("stability arch", "empty"),
    ("plan vault", "empty"),
    ("picture arch", "empty"),
    ("robots plan bottle-12", "empty"),
    ("demo", "empty"),
)


@dataclass(frozen=True)
class Options:
    """Commands and numbers of runs."""

    commands: tuple[str, ...] = ()
    """Names of commands; empty for all."""
    before: str = "2b3aed5"
    """Earlier commit; empty for none."""
    repeats: int = 5
    """Runs with warm caches."""
    cold_repeats: int = 3
    """Runs with empty caches."""
    earlier_repeats: int = 1
    """Runs of the earlier commit with empty caches."""
    out: Path | None = None
    """File to which the records are appended."""


@dataclass
class Runs:
    """Measurements of some runs of one command."""

    seconds: list[float] = field(default_factory=list)
    processor: list[float] = field(default_factory=list)
    peak: list[float] = field(default_factory=list)

    def run(self, command: str, source: Path, cache: Path) -> None:
        """Run a command once."""
        kept = {"NUMBA_CACHE_DIR": str(cache), "FALSEWORK_CACHE": str(cache / "falsework")}
        paths = {"PYTHONPATH": str(source / "src"), "OPENBLAS_NUM_THREADS": "1"}
        begun, spent, most = time.perf_counter(), 0.0, 0
        for line in COMMANDS[command]:
            child = subprocess.Popen(
                [sys.executable, "-m", "falsework", *line.split()],
                cwd=cache,
                env=os.environ | kept | paths,
                stdout=subprocess.DEVNULL,
            )
            _, status, used = os.wait4(child.pid, 0)
            child.returncode = os.waitstatus_to_exitcode(status)
            if child.returncode:
                raise SystemExit(f"falsework {line} failed in {source}")
            spent += used.ru_utime + used.ru_stime
            most = max(most, used.ru_maxrss)
        self.seconds.append(time.perf_counter() - begun)
        self.processor.append(spent)
        self.peak.append(most / 2**20)

    def figures(self) -> dict[str, Any]:
        """Return the figures of a record."""
        return {
            "runs": len(self.seconds),
            "seconds": spread(self.seconds),
            "processor_seconds": spread(self.processor),
            "peak_gib": spread(self.peak),
        }


def make_kernels(source: Path) -> None:
    """Make the archive of kernels that an installation has, where it is not in git."""
    script = source / "kernels/archive.py"
    if script.is_file():
        subprocess.run([sys.executable, script], env=os.environ | {"PYTHONPATH": str(source / "src")}, check=True)


@contextmanager
def checked_out(commit: str) -> Iterator[Path | None]:
    """Check out a commit beside the repository temporarily."""
    if not commit:
        yield None
        return
    git = ["git", "-C", str(REPOSITORY), "worktree"]
    with tempfile.TemporaryDirectory() as folder:
        place = Path(folder) / "before"
        subprocess.run([*git, "add", "--quiet", "--detach", str(place), commit], check=True)
        make_kernels(place)
        try:
            yield place
        finally:
            subprocess.run([*git, "remove", "--force", str(place)], check=True)


def measure(command: str, cache: str, places: dict[Path, Path], repeats: dict[Path, int]) -> list[Runs]:
    """Run a command in several source trees in turn, as often as `repeats` says; `places` has a folder per tree."""
    found = {source: Runs() for source in places}
    if cache == "warm":
        for source, place in places.items():
            Runs().run(command, source, place)
    for turn in range(max(repeats.values())):
        for source, place in places.items():
            if turn < repeats[source]:
                fresh = place if cache == "warm" else Path(tempfile.mkdtemp(dir=place))
                found[source].run(command, source, fresh)
    return list(found.values())


def main(options: Options) -> None:
    """Run the benchmark."""
    write_to(options.out)
    make_kernels(REPOSITORY)
    with checked_out(options.before) as earlier, tempfile.TemporaryDirectory() as folder:
        sources = [REPOSITORY] if earlier is None else [REPOSITORY, earlier]
        places = {source: Path(tempfile.mkdtemp(dir=folder)) for source in sources}
        for command, cache in ROWS:
            if options.commands and command not in options.commands:
                continue
            if "bottle-12" in command and not real_structures(("bottle-12",)):
                continue
            repeats = dict.fromkeys(sources, options.repeats)
            if cache == "empty":
                earlier_repeats = 0 if command == "plan vault" else options.earlier_repeats
                repeats = dict.fromkeys(sources, earlier_repeats) | {REPOSITORY: options.cold_repeats}
            now, *before = [runs.figures() for runs in measure(command, cache, places, repeats) if runs.seconds]
            figures: dict[str, Any] = {"what": command, "cache": cache, **now}
            if before:
                figures["before"] = {"commit": options.before, **before[0]}
                medians = [one["processor_seconds"]["median"] for one in (now, before[0])]
                figures["ratio"] = medians[0] / medians[1]
            report("first_minute", **figures)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))
