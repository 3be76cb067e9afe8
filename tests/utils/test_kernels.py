"""Portable code of the kernels: made of the present source, compiled once, and left to numba where it does not fit."""

from __future__ import annotations

import ctypes
import gc
import importlib
import json
import os
import shutil
import subprocess
import sys
import warnings
import zipfile
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from llvmlite import binding as llvm

from falsework.utils import bits, kernel_code
from falsework.utils.cache import folder as cache_folder
from falsework.utils.kernel_code import ARCHIVE, Archive
from falsework.utils.kernels import Kernel, njit
from kernels.archive import GROUPS, make

ONE = np.array([[1, 0], [4, 2], [0, 0]], np.uint64)
TWO = np.array([[3, 0], [0, 6]], np.uint64)
MEET = [[True, False], [False, True], [False, False]]


@pytest.fixture(scope="module")
def archive(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The archive of one group, made here."""
    path = tmp_path_factory.mktemp("archive") / "kernels.zip"
    with pytest.MonkeyPatch.context() as patch:
        patch.setenv("FALSEWORK_CACHE", str(tmp_path_factory.mktemp("cache")))
        make(path, ["sets"])
    return path


@pytest.fixture
def start(archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Callable[[], Kernel]:
    """Return what makes a kernel as a new process does; the cache folder is empty at first."""
    monkeypatch.setenv("FALSEWORK_CACHE", str(tmp_path / "cache"))
    cache_folder.warn_of_no_cache.cache_clear()
    here = shutil.copy(archive, tmp_path / "kernels.zip")

    def start() -> Kernel:
        monkeypatch.setattr(kernel_code, "ARCHIVE", Archive(Path(here)))
        return Kernel(bits.intersect_into.py_func, {})

    return start


@pytest.fixture
def fresh(start: Callable[[], Kernel]) -> Kernel:
    """Return a kernel that has not been loaded."""
    return start()


@pytest.fixture
def without_numba(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fail where numba is asked; these tests have an archive of their own."""

    def refuse(_: Kernel) -> None:
        pytest.fail("numba is asked")

    monkeypatch.setattr(Kernel, "dispatcher", property(refuse))


def meets(kernel: Kernel, one: np.ndarray = ONE) -> list[list[bool]]:
    """Return which of the sets meet, as a kernel finds them."""
    found = np.zeros((len(one), len(TWO)), np.bool_)
    kernel(one, TWO, found)
    return found.tolist()


def test_the_archive_of_the_package_has_all_groups_of_the_present_sources() -> None:
    if not ARCHIVE.path.is_file():
        pytest.skip("no archive of kernels here: make kernels")
    assert list(ARCHIVE.index) == list(GROUPS)
    assert [group for group in GROUPS if not ARCHIVE.fits(group)] == [], "run `make kernels`"


def test_an_archive_that_fits_stays(archive: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """One of other sources is made anew, and what has been made of the present ones is not made again."""
    monkeypatch.setenv("FALSEWORK_CACHE", str(tmp_path / "cache"))
    here = Path(shutil.copy(archive, tmp_path / "kernels.zip"))
    before = here.stat().st_mtime_ns
    make(here, ["sets"])
    assert here.stat().st_mtime_ns == before
    index = Archive(here).index
    index["sets"]["digest"] = "other"
    with zipfile.ZipFile(here, "w") as file:
        file.writestr("index.json", json.dumps(index))
    make(here, ["sets"])
    assert Archive(here).fits("sets")
    assert Archive(here).bitcode("sets")
    monkeypatch.setattr("kernels.archive.record", lambda: pytest.fail("made again"))
    make(tmp_path / "other.zip", ["sets"])
    assert Archive(tmp_path / "other.zip").index == Archive(here).index
    assert Archive(tmp_path / "other.zip").bitcode("sets") == Archive(here).bitcode("sets")


@pytest.mark.usefixtures("without_numba")
def test_code_is_compiled_once_and_kept(
    start: Callable[[], Kernel], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    assert meets(start()) == MEET
    (kept,) = (tmp_path / "cache").iterdir()
    monkeypatch.setattr(kernel_code, "compile_code", lambda *_: pytest.fail("compiled again"))
    assert meets(start()) == MEET
    assert kept.name.startswith("sets-")


DAMAGE = {
    "empty": lambda content: b"",
    "truncated": lambda content: content[: len(content) // 2],
    "a changed bit": lambda content: content[:-99] + bytes([content[-99] ^ 1]) + content[-98:],
    "something else": lambda content: b"no code",
    "without a digest": lambda content: content[32:],
}


@pytest.mark.usefixtures("without_numba")
@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_damaged_code_is_compiled_again_with_one_warning(
    start: Callable[[], Kernel], tmp_path: Path, damage: Callable[[bytes], bytes]
) -> None:
    assert meets(start()) == MEET
    (kept,) = (tmp_path / "cache").iterdir()
    kept.write_bytes(damage(kept.read_bytes()))
    with pytest.warns(cache_folder.CacheWarning, match="is damaged") as said:
        assert meets(start()) == MEET
    assert len(said) == 1
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        assert meets(start()) == MEET


SOURCE = """
from falsework.utils.kernels import njit

@njit(cache=True)
def twice(value):
    return 2 * value
"""


@pytest.mark.parametrize("damage", DAMAGE.values(), ids=DAMAGE)
def test_damaged_files_of_numba_are_made_anew(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, damage: Callable[[bytes], bytes]
) -> None:
    (tmp_path / "doubling.py").write_text(SOURCE)
    monkeypatch.syspath_prepend(tmp_path)
    monkeypatch.setenv("FALSEWORK_CACHE", str(tmp_path / "cache"))

    def hits() -> int:
        """Call the function as a new process would; return how often its code was in a file."""
        monkeypatch.delitem(sys.modules, "doubling", raising=False)
        twice = importlib.import_module("doubling").twice
        assert twice(3) == 6
        return sum(twice.dispatcher.stats.cache_hits.values())

    assert [hits(), hits()] == [0, 1]
    files = list((tmp_path / "cache/numba").iterdir())
    assert sorted(file.suffix for file in files) == [".nbc", ".nbi"]
    for file in files:
        file.write_bytes(damage(file.read_bytes()))
        with pytest.warns(cache_folder.CacheWarning, match="is damaged"):
            assert hits() == 0
        assert hits() == 1


INNER = """
from falsework.utils.kernels import njit

@njit(cache=True, inline="always")
def scale(value):
    return {factor} * value
"""
OUTER = """
from inner import scale
from falsework.utils.kernels import njit

@njit(cache=True)
def scaled(value):
    return scale(value)
"""


def test_code_of_numba_is_found_by_all_sources_that_it_comes_from(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """In another folder too, but not where a function of another file that is inlined has changed."""
    monkeypatch.setenv("FALSEWORK_CACHE", str(tmp_path / "cache"))

    def hits(folder: str, factor: int) -> int:
        here = tmp_path / folder
        here.mkdir()
        (here / "inner.py").write_text(INNER.format(factor=factor))
        (here / "outer.py").write_text(OUTER)
        with monkeypatch.context() as patch:
            patch.syspath_prepend(here)
            for name in ("inner", "outer"):
                patch.delitem(sys.modules, name, raising=False)
            scaled = importlib.import_module("outer").scaled
        assert scaled(3) == 3 * factor
        return sum(scaled.dispatcher.stats.cache_hits.values())

    assert [hits("one", 2), hits("two", 2), hits("three", 5)] == [0, 1, 0]


@pytest.mark.usefixtures("without_numba")
def test_code_stays_as_long_as_a_kernel_may_call_it(fresh: Kernel, start: Callable[[], Kernel]) -> None:
    """It would be freed with the engine that owns it."""
    assert meets(fresh) == MEET
    start()
    gc.collect()
    assert meets(fresh) == MEET


def test_a_folder_that_cannot_be_written_costs_one_warning(fresh: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("FALSEWORK_CACHE", str(Path(__file__) / "cache"))
    with pytest.warns(cache_folder.CacheWarning, match="FALSEWORK_CACHE"):
        assert meets(fresh) == MEET
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        cache_folder.write_cache("again", b"")


def test_the_command_says_so_in_one_line(tmp_path: Path) -> None:
    pytest.importorskip("PIL", reason="needs Pillow; pip install 'falsework[picture]'")
    bad = str(Path(__file__) / "cache")
    done = subprocess.run(
        [sys.executable, "-m", "falsework", "picture", "arch:blocks=3", "--out", "arch.png"],
        env=os.environ | {"FALSEWORK_CACHE": bad, "NUMBA_CACHE_DIR": bad},
        cwd=tmp_path,
        capture_output=True,
        text=True,
        check=False,
    )
    assert done.returncode == 0
    assert (tmp_path / "arch.png").is_file()
    assert done.stderr.startswith("falsework: warning: compiled code cannot be kept in ")
    assert done.stderr.count("\n") == 1


@pytest.mark.parametrize(("seconds", "lines"), [(0.05, 0), (0.8, 1)])
def test_a_long_compilation_is_announced_once(seconds: float, lines: int) -> None:
    """While it lasts; compilations within others, and further ones, say nothing more."""
    program = f"""
import time
from numba.core.event import trigger_event
from falsework.utils.kernels import njit

njit()(lambda number: number).dispatcher  # of which there is no portable code
for _ in range(2):
    with trigger_event("numba:compile"):
        with trigger_event("numba:compile"):
            time.sleep({seconds / 2})
        time.sleep({seconds})
"""
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=True)
    assert done.stderr.count("numba compiles kernels") == done.stderr.count("\n") == lines


def test_changed_sources_go_to_numba(fresh: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(Archive, "fits", lambda archive, group: False)
    assert meets(fresh) == MEET
    assert fresh.dispatcher.signatures


def test_code_of_a_later_llvm_goes_to_numba(fresh: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    def refuse(*_: Any) -> bytes:
        raise RuntimeError("LLVM bitcode parsing error")

    monkeypatch.setattr(kernel_code, "compile_code", refuse)
    assert meets(fresh) == MEET
    assert fresh.dispatcher.signatures


@pytest.mark.parametrize(
    "one",
    [ONE.astype(np.int64), np.asfortranarray(ONE), np.repeat(ONE, 2, axis=1)[:, ::2]],
    ids=["another type", "another order", "strided"],
)
def test_other_arguments_go_to_numba(fresh: Kernel, one: np.ndarray) -> None:
    assert meets(fresh, one) == MEET
    assert fresh.dispatcher.signatures


def test_without_an_archive_numba_compiles(fresh: Kernel, tmp_path: Path) -> None:
    (tmp_path / "kernels.zip").unlink()
    assert meets(fresh) == MEET
    assert fresh.dispatcher.signatures


def test_numba_without_a_folder_compiles_with_a_warning(fresh: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    import numba

    real = numba.njit

    def without_folder(**options: Any) -> Any:
        if options.get("cache"):
            raise RuntimeError("cannot cache function: no locator available")
        return real(**options)

    monkeypatch.setattr(numba, "njit", without_folder)
    twice = njit(cache=True)(lambda value: 2 * value)
    with pytest.warns(cache_folder.CacheWarning):
        assert twice(3) == 6


@pytest.mark.usefixtures("without_numba")
def test_arrays_may_hold_nothing(fresh: Kernel) -> None:
    assert meets(fresh, ONE[:0]) == []


def test_failure_in_portable_code_is_an_error(fresh: Kernel, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(ctypes, "CFUNCTYPE", lambda *_: lambda _: lambda words, result: -1)
    with pytest.raises(RuntimeError, match="intersect_into failed"):
        meets(fresh)


@pytest.mark.slow
@pytest.mark.parametrize("triple", ["arm64-apple-macosx14.0.0", "x86_64-pc-windows-msvc", "aarch64-unknown-linux-gnu"])
def test_code_compiles_for_other_machines(triple: str) -> None:
    """Instructions can be selected for all groups; with optimization this is tried on the small ones, for time."""
    if not ARCHIVE.path.is_file():
        pytest.skip("no archive of kernels here: make kernels")
    llvm.initialize_all_targets()
    llvm.initialize_all_asmprinters()
    target = llvm.Target.from_triple(triple)
    machine = target.create_target_machine(opt=0)
    for group in GROUPS:
        module = llvm.parse_bitcode(ARCHIVE.bitcode(group))
        module.triple, module.data_layout = machine.triple, str(machine.target_data)
        assert machine.emit_object(module)
    for group in ("pictures", "sets"):
        assert kernel_code.compile_code(llvm, target.create_target_machine(opt=3), ARCHIVE.bitcode(group))
