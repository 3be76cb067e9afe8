"""Fixtures shared by the tests of all sub-packages."""

from __future__ import annotations

import gc
import json
import os
import signal
import subprocess
import sys
import threading
import time
import tracemalloc
from collections import Counter
from collections.abc import Callable, Generator, Iterator, Mapping
from dataclasses import replace
from functools import cache, partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import pytest

from falsework import Assembly, Plan
from falsework.assembly import HELD, INSTALLED, ContactWarning
from falsework.assembly.library.blocks import box, gather
from falsework.assembly.library.catalogue import Structure
from falsework.geometry import TriangleMesh
from falsework.stability.holds import Press
from falsework.utils.kernel_code import ARCHIVE
from falsework.utils.kernels import Kernel

REPOSITORY = Path(__file__).resolve().parents[1]


def data_folder() -> Path | None:
    """Folder with `assemblies/`: FALSEWORK_DATA, else `shared/` beside the repository; None where neither exists."""
    named = os.environ.get("FALSEWORK_DATA")
    folder = Path(named) if named else REPOSITORY.parent / "shared"
    return folder if (folder / "assemblies").is_dir() else None


@pytest.hookimpl(wrapper=True)
def pytest_make_collect_report(
    collector: pytest.Collector,
) -> Generator[None, pytest.CollectReport, pytest.CollectReport]:
    """Let every second worker collect folders backwards.

    Where nothing is compiled yet, two that went the same way would compile the same files at the same time. So they
    meet in the middle, and each loads what the other one has compiled.
    """
    report = yield
    number = os.environ.get("PYTEST_XDIST_WORKER", "gw0").removeprefix("gw")
    if int(number) % 2 and isinstance(collector, (pytest.Session, pytest.Directory)):
        report.result.reverse()
    return report


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Run files with slow tests first, so that at the end no worker waits for another that has just begun one."""
    slow = {item.path for item in items if item.get_closest_marker("slow")}
    items.sort(key=lambda item: (item.path not in slow, item.path))


# Looked at every 700 objects, those of thousands of tests take a third of the time in which they are collected.
gc.set_threshold(100_000, 20, 100)


def pytest_collection_finish() -> None:
    """Let the garbage collector leave alone what stays to the end, tests and packages."""
    gc.collect()
    gc.freeze()


@pytest.hookimpl(wrapper=True, tryfirst=True)
def pytest_terminal_summary(terminalreporter: pytest.TerminalReporter) -> Iterator[None]:
    """Say at the end which tests did not run and for want of what; only pytest's closing line follows."""
    yield
    skipped = [report.longrepr[2] for report in terminalreporter.stats.get("skipped", [])]
    for reason, count in sorted(Counter(reason.removeprefix("Skipped: ") for reason in skipped).items()):
        terminalreporter.write_line(f"not run: {count} {'test' if count == 1 else 'tests'} ({reason})")


_made: dict[tuple[str, ...], Assembly] = {}


@pytest.fixture(scope="module", autouse=True)
def structures_are_made_once(request: pytest.FixtureRequest) -> Iterator[None]:
    """Built-in structures, which never change, are shared by tests: each worker finds contacts and ways out once.

    Tests of how structures are made make their own.
    """
    make = Structure.make

    def once(self: Structure, values: Mapping[str, Any], **material: float | None) -> Assembly:
        key = self.name, repr(sorted(values.items())), repr(material)
        found = _made.get(key) or make(self, values, **material)
        if found.part_count <= 100:  # larger ones are seldom asked for again, and take memory
            _made[key] = found
        return found

    with pytest.MonkeyPatch.context() as patch:
        if not {"assembly", "geometry"} & set(request.path.relative_to(REPOSITORY).parts):
            patch.setattr(Structure, "make", once)
        yield


@pytest.fixture(scope="session")
def read_answer() -> Callable[[str], dict[str, Any]]:
    """Read what a command prints with `--json`: one line, which the published schema describes."""
    import jsonschema

    from falsework.cli.output import answer_schema

    validator = jsonschema.Draft202012Validator(answer_schema())

    def read(text: str) -> dict[str, Any]:
        (line,) = text.splitlines()
        answer = json.loads(line)
        validator.validate(answer)
        return answer

    return read


@pytest.fixture(scope="session")
def planned_once(tmp_path_factory: pytest.TempPathFactory) -> Callable[..., bytes]:
    """Return the plan file that `falsework plan` writes for its arguments; each worker plans once."""
    from falsework.cli.main import main

    @cache
    def plan(*arguments: str) -> bytes:
        out = tmp_path_factory.mktemp("planned") / "plan.json"
        assert main(["plan", *arguments, "--out", str(out)]) == 0
        return out.read_bytes()

    return plan


@pytest.fixture
def without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail where a kernel has no portable code for its arguments; skips the test where no archive was made."""
    if not ARCHIVE.path.is_file():
        pytest.skip("no archive of kernels here: make kernels")

    def refuse(kernel: Kernel) -> None:
        pytest.fail(f"numba is asked to compile {kernel.__name__}")

    monkeypatch.setattr(Kernel, "dispatcher", property(refuse))


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
def public_structure_path() -> Callable[[str], Path]:
    """Look up a folder or file of `structures/` by name; skips the test where the data is not there."""

    def find(name: str) -> Path:
        folder = data_folder()
        if folder is None or not (folder / "structures" / name).exists():
            pytest.skip(f"no public structure {name}: set FALSEWORK_DATA to the folder that holds structures/")
        return folder / "structures" / name

    return find


@pytest.fixture(scope="session")
def beam_on_ridge() -> Assembly:
    """A beam (part 2) across a flat block (0) and the ridge of a roof (1), both boundary: an area and a line."""
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
    faces += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    roof = [(0, 1, 2), (3, 5, 4), (0, 3, 4), (0, 4, 1), (1, 4, 5), (1, 5, 2), (2, 5, 3), (2, 3, 0)]
    meshes = [
        TriangleMesh.from_arrays("block", [(x, y, z) for x in (0, 0.2) for y in (0, 1) for z in (0, 1)], faces),
        TriangleMesh.from_arrays("roof", [(x, y, z) for y in (0, 1) for x, z in ((2.5, 0), (3.5, 0), (3, 1))], roof),
        TriangleMesh.from_arrays("beam", [(x, y, z) for x in (0, 3.2) for y in (0.4, 0.6) for z in (1, 1.1)], faces),
    ]
    with pytest.warns(ContactWarning):
        return Assembly.from_meshes(meshes, boundary=[0, 1], name="beam-on-ridge")


@pytest.fixture(scope="session")
def drawer() -> Assembly:
    """A drawer in a case with a lip in front of it: it must be lifted, and then pulled out."""
    blocks = gather(
        [
            box("drawer", (0.0, 0.0, 0.0), (0.3, 0.2, 0.1)),
            box("floor", (-0.05, -0.05, -0.05), (0.35, 0.25, 0.0), fixed=True),
            box("back", (-0.05, -0.05, 0.0), (0.0, 0.25, 0.25), fixed=True),
            box("side", (0.0, -0.05, 0.0), (0.3, 0.0, 0.25), fixed=True),
            box("side", (0.0, 0.2, 0.0), (0.3, 0.25, 0.25), fixed=True),
            box("top", (-0.05, -0.05, 0.25), (0.35, 0.25, 0.3), fixed=True),
            box("lip", (0.3, -0.05, 0.0), (0.35, 0.25, 0.06), fixed=True),
        ]
    )
    return Assembly.from_meshes(blocks.meshes, boundary=blocks.boundary, name="drawer")


@pytest.fixture
def start_command() -> Iterator[Callable[..., subprocess.Popen[str]]]:
    """Start the command line as a shell does, in the foreground or not; it is killed after the test or a minute.

    `first` is code that runs before the command.
    """
    if os.name == "nt":
        pytest.skip("signals are sent differently on Windows")
    started: list[tuple[subprocess.Popen[str], threading.Timer]] = []

    def start(
        *arguments: str, foreground: bool = True, seconds: float = 60.0, first: str = ""
    ) -> subprocess.Popen[str]:
        # Set in both cases: a process inherits whether interrupts are ignored, and so do the tests themselves.
        handler = signal.default_int_handler if foreground else signal.SIG_IGN
        program = ("-c", f"{first}; import runpy; runpy.run_module('falsework', run_name='__main__')")
        process = subprocess.Popen(
            [sys.executable, *(program if first else ("-m", "falsework")), *arguments],
            stdout=subprocess.PIPE,
            stderr=subprocess.PIPE,
            text=True,
            preexec_fn=partial(signal.signal, signal.SIGINT, handler),
        )
        limit = threading.Timer(seconds, process.kill)
        limit.start()
        started.append((process, limit))
        return process

    yield start
    for process, limit in started:
        limit.cancel()
        process.kill()
        process.communicate()


@pytest.fixture(scope="session")
def peak() -> Callable[[Callable[[], Any]], int]:
    """Run code and return the largest memory that it has at a time, bytes."""

    def measure(read: Callable[[], Any]) -> int:
        tracemalloc.start()
        try:
            read()
        finally:
            size = tracemalloc.get_traced_memory()[1]
            tracemalloc.stop()
        return size

    return measure


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


@pytest.fixture(scope="session")
def press_once() -> Callable[..., tuple[Plan, int, int]]:
    """Add a press to the first step of a plan in which a part is released while a robot holds another one.

    Returns:
        The plan, the number of the step, and the part that is pressed.
    """

    def change(plan: Plan, wrench: tuple[float, ...]) -> tuple[Plan, int, int]:
        for step, (before, after) in enumerate(pairwise(plan.states)):
            held = (before == HELD) & (after == HELD) & ~plan.boundary
            if held.any() and ((before == HELD) & (after == INSTALLED)).any():
                part = int(held.argmax())
                presses: list[tuple[Press, ...]] = [()] * len(plan)
                presses[step] = (Press(part, wrench),)
                return replace(plan, presses=tuple(presses)), step + 1, part
        raise AssertionError("no robot holds a part while another one is released")

    return change
