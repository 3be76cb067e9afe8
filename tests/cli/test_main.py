"""The entry point: help, exit codes, and one line for every error."""

from __future__ import annotations

import errno
import json
import os
import re
import subprocess
import sys
import warnings
from collections.abc import Callable
from dataclasses import dataclass, is_dataclass
from pathlib import Path
from typing import Any, get_type_hints

import pytest

from falsework import __version__
from falsework.cli import main as entry
from falsework.cli.command import Command
from falsework.cli.exit_code import Exit
from falsework.errors import InputError


def run_with(monkeypatch: pytest.MonkeyPatch, behaviour: Any, *options: str) -> int:
    """Run `falsework structures` with its work replaced."""

    @dataclass(frozen=True, kw_only=True)
    class Replaced(Command):
        """Stands in for a subcommand."""

        def run(self, output: Any) -> Exit:
            return behaviour(output)

    monkeypatch.setattr(entry, "command_class", lambda name: Replaced)
    return entry.main(["structures", *options])


def processor_seconds() -> float:
    """Seconds that ended child processes have used, whatever else the machine does."""
    spent = os.times()
    return spent.children_user + spent.children_system


def test_help_is_fast_and_names_every_command() -> None:
    best = float("inf")
    for _ in range(3):
        begun = processor_seconds()
        done = subprocess.run([sys.executable, "-m", "falsework", "--help"], capture_output=True, text=True, check=True)
        best = min(best, processor_seconds() - begun)
    for name in entry.COMMANDS:
        assert name in done.stdout
    assert "Example:" in done.stdout
    assert best < 0.4  # 0.1 s on an idle machine; more means that something heavy is imported


def caused(error: Exception, cause: Exception) -> Exception:
    error.__cause__ = cause
    return error


@pytest.mark.parametrize(("arguments", "more"), [(["--help"], {"tyro"}), (["plan", "--help"], set())])
def test_help_imports_nothing_heavy(arguments: list[str], more: set[str]) -> None:
    program = (
        f"import sys\nfrom falsework.cli.main import main\nmain({arguments})\n"
        f"heavy = {more | {'numpy', 'scipy', 'numba', 'trimesh', 'rich', 'clarabel', 'typeguard'}} & set(sys.modules)\n"
        "sys.exit(f'imported {heavy}' if heavy else 0)"
    )
    done = subprocess.run([sys.executable, "-c", program], capture_output=True, text=True, check=False)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("name", entry.COMMANDS)
def test_every_command_has_help_with_an_example(name: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.main([*name.split(), "--help"]) == 0
    text = capsys.readouterr().out
    assert f"  falsework {name}" in text.split("Example", 1)[1]
    assert "--json" in text
    assert "--debug" not in text
    assert entry.main([*name.split(), "--help-all"]) == 0
    everything = capsys.readouterr().out
    assert "--debug" in everything
    brief, whole = (set(re.findall(r"^[│ ] +(--[\w-]+)", shown, re.MULTILINE)) for shown in (text, everything))
    assert brief < whole
    assert len(brief) <= 16, "options that are seldom needed belong in `rare`"


@pytest.mark.parametrize(
    ("arguments", "hint"),
    [
        ([], "structures"),
        (["robots"], "export"),
        (["robots", "dance"], "plan"),
        (["pla"], "plan"),
        (["plan"], "STRUCTURE"),
        (["plan", "arch", "--robot", "2"], "--robots"),
        (["plan", "arch", "--robots", "two"], "two"),
        (["plan", "arch", "surplus"], "surplus"),
        (["stability", "arch", "--cone", "round"], "octagon"),
    ],
)
def test_wrong_usage_is_one_line(arguments: list[str], hint: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.main(arguments) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert captured.err.startswith("falsework: ")
    assert hint in captured.err
    assert "│" not in captured.err


@pytest.mark.parametrize(
    ("arguments", "line"),
    [
        ("plan", "missing from falsework plan: STRUCTURE; for help, run: falsework plan --help"),
        ("export plan.json", "missing from falsework export: --out PATH; for help, run: falsework export --help"),
        (
            "plan arch --robot 2",
            "unrecognized options: --robot; perhaps you meant: --robots NUMBER, --robust; "
            "for help, run falsework plan --help",
        ),
        ("cell new ur5e ur5e --out c.toml", "too many values: ur5e; name a structure with --structure; for help, run"),
        ("check plan.json vault", "too many values: vault; name a structure with --structure; for help, run"),
        ("view plan.json vault", "too many values: vault; name a structure with --structure; for help, run"),
        ("plan vault arch", "too many values: arch; for help, run falsework plan --help"),
        ("doctor gone.toml", "there is no cell file gone.toml; `falsework cell new` writes one"),
        ("robots plan arch --cell gone.toml", "there is no cell file gone.toml; `falsework cell new` writes one"),
        ("plan arch --friction x", "--friction is 'x'; give a number; for help, see falsework plan --help"),
        ("plan arch --hold-stiffness 1kN/m", "--hold-stiffness is '1kN/m'; give a number; for help"),
        ("doctor arch", "there is no folder or file arch, and built-in structures need no doctor; give meshes"),
        ("plan arch --props 1.5", "--props is '1.5'; give a whole number"),
        ("plan arch --robots", "--robots has no value; give one"),
        ("replan --cell dome-37", "STRUCTURE is missing, or an option does not exist; for help"),
        ("cell new --arms ur5e --out c.toml", "ARMS is missing, or an option does not exist; for help"),
        ("check plan.json --robot 2 --x -1 --y", "unrecognized options: --robot, --x, --y; "),
        ("train arch --policy cnn", "unknown policy kind 'cnn'; choose resmlp, transformer, local, gat, mlp, or"),
        ("plna arch", "there is no subcommand 'plna'; perhaps you meant: plan; for all, run falsework --help"),
        ("robot plan", "there is no subcommand 'robot'; perhaps you meant: robots plan; for all"),
        ("robots plna", "there is no subcommand 'robots plna'; perhaps you meant: robots plan; for all"),
        ("robots", "there is no subcommand 'robots'; perhaps you meant: robots plan, robots check, robots export; for"),
        ("robots --json", "there is no subcommand 'robots'; perhaps you meant: robots plan, robots check, robots"),
        ("--json plan arch", "give a subcommand before --json: structures, doctor,"),
        ("picture arch --step 3", "step 3 does not exist; there are no steps"),
        ("cell check x.toml", "there is no subcommand 'cell check'; perhaps you meant: cell new; for all"),
    ],
)
def test_wrong_usage_names_options_without_their_help(
    arguments: str, line: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert entry.main(arguments.split()) == 2
    assert capsys.readouterr().err.startswith(f"falsework: {line}")


def test_version(capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.main(["--version"]) == 0
    assert capsys.readouterr().out == f"falsework {__version__}\n"


@pytest.mark.parametrize(
    ("error", "text"),
    [
        (InputError("part 3 is\nopen; close it"), "part 3 is open; close it"),
        (FileNotFoundError(2, "No such file or directory", "x.json"), "x.json: No such file or directory"),
        (KeyError("surprise"), "unexpected KeyError"),
    ],
)
def test_errors_become_one_line(
    error: Exception, text: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: Any) -> Exit:
        raise error

    assert run_with(monkeypatch, fail) == 2
    captured = capsys.readouterr()
    assert captured.err.count("\n") == 1
    assert text in captured.err
    assert "Traceback" not in captured.err


@pytest.mark.parametrize(
    "error",
    [
        MemoryError(),
        OSError(errno.ENOMEM, "Cannot allocate memory"),
        ImportError("solver.so: failed to map segment from shared object"),
        caused(InputError("the solver cannot be used"), MemoryError()),
    ],
)
def test_want_of_memory_is_not_wrong_input(
    error: Exception, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def fail(_: Any) -> Exit:
        raise error

    assert run_with(monkeypatch, fail) == 4
    assert capsys.readouterr().err == "falsework: out of memory; try a smaller structure or search width\n"


def test_debug_shows_the_traceback(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def fail(_: Any) -> Exit:
        raise InputError("no")

    assert run_with(monkeypatch, fail, "--debug") == 2
    assert "Traceback" in capsys.readouterr().err


def test_interruption_is_no_error_message(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def interrupt(_: Any) -> Exit:
        raise KeyboardInterrupt

    assert run_with(monkeypatch, interrupt) == 130
    assert capsys.readouterr().err == "falsework: interrupted\n"


def test_warnings_are_one_line_and_keep_the_exit_code(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    def warn(_: Any) -> Exit:
        warnings.warn("part 2 had\n3 holes", UserWarning, stacklevel=1)
        return Exit.NO

    assert run_with(monkeypatch, warn) == 1
    assert capsys.readouterr().err == "falsework: warning: part 2 had 3 holes\n"


@pytest.mark.parametrize("name", entry.COMMANDS)
def test_rare_options_exist(name: str) -> None:
    kind = entry.command_class(name)
    hints = get_type_hints(kind)
    for one in (kind, *(hint for hint in hints.values() if is_dataclass(hint))):
        fields = set(one.__dataclass_fields__)
        assert {option for base in one.__mro__ for option in vars(base).get("rare", ())} <= fields


def test_options_of_the_structure_are_described_once(capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.main(["structures", "--help"]) == 0
    described = capsys.readouterr().out
    for option in ("--unit", "--density", "--friction", "--boundary", "--ground", "--load", "--earthquake"):
        assert re.search(rf"^ +{option}\b", described, re.MULTILINE), described
    for command in ("plan", "check", "doctor", "picture"):
        assert entry.main([command, "--help-all"]) == 0
        text = capsys.readouterr().out
        assert "--earthquake" not in text
        assert "falsework structures --help" in text
    # Help leaves options out; the command still takes them.
    assert entry.main(["stability", "stack:blocks=2", "--friction", "0.4"]) == 0


@pytest.mark.parametrize("shell", ["bash", "zsh", "fish"])
def test_completions(shell: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert entry.main(["--tyro-write-completion", shell, str(tmp_path / "script")]) == 0
    text = (tmp_path / "script").read_text()
    assert "margins" in text
    assert "friction" in text
    for words in (["ksh", "file"], ["bash"]):
        assert entry.main(["--tyro-write-completion", *words]) == 2
        assert "takes a shell (bash, zsh, tcsh, fish) and the file" in capsys.readouterr().err


def test_records_are_for_machines_only(monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]) -> None:
    def work(output: Any) -> Exit:
        output.record({"answer": 42})
        output.say("the answer is 42")
        output.note("that took long")
        return Exit.DONE

    assert run_with(monkeypatch, work) == 0
    assert capsys.readouterr() == ("the answer is 42\n", "that took long\n")
    assert run_with(monkeypatch, work, "--json") == 0
    out, error = capsys.readouterr()
    assert error == "that took long\n"
    assert json.loads(out) == {
        "format": "falsework.answer/1",
        "command": "structures",
        "ok": True,
        "outcome": "done",
        "files": [],
        "notes": ["that took long"],
        "answer": 42,
    }


@pytest.mark.parametrize(
    ("arguments", "outcome"),
    [
        (("plan", "nowhere", "--json"), "wrong_input"),
        (("plan", "arch", "--robot", "2", "--json"), "wrong_input"),
        (("plna", "arch", "--json"), "wrong_input"),
    ],
)
def test_errors_are_answers_too(
    arguments: tuple[str, ...], outcome: str, capsys: pytest.CaptureFixture[str], read_answer: Callable[[str], Any]
) -> None:
    assert entry.main(arguments) == 2
    out, error = capsys.readouterr()
    answer = read_answer(out)
    assert (answer["ok"], answer["outcome"], answer["files"]) == (False, outcome, [])
    assert error == f"falsework: {answer['error']}\n"


def test_warnings_are_notes_of_the_answer(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str], read_answer: Callable[[str], Any]
) -> None:
    def warn(_: Any) -> Exit:
        warnings.warn("part 2 had 3 holes", UserWarning, stacklevel=1)
        return Exit.DONE

    assert run_with(monkeypatch, warn, "--json") == 0
    assert read_answer(capsys.readouterr().out)["notes"] == ["warning: part 2 had 3 holes"]


def test_logs_get_a_line_of_progress_now_and_then(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    clock = iter(range(0, 1000, 10))
    monkeypatch.setattr("falsework.cli.output.time.monotonic", lambda: float(next(clock)))

    def work(output: Any) -> Exit:
        with output.bar("counting") as show:
            for done in range(1, 9):
                show(done, 8, f"{done} of 8")
        return Exit.DONE

    assert run_with(monkeypatch, work) == 0
    out, error = capsys.readouterr()
    assert out == ""
    assert error.splitlines() == ["counting: 3 of 8", "counting: 6 of 8"]


def test_a_reader_that_leaves_is_no_error() -> None:
    command = f"{sys.executable} -m falsework plan --help | head -c 1"
    done = subprocess.run(["bash", "-c", command], capture_output=True, text=True, check=True)
    assert done.stderr == ""


def test_an_interrupt_while_modules_are_imported_is_one_line() -> None:
    code = """
import sys
class Interrupted:
    def find_spec(self, name, path=None, target=None):
        if name == "falsework.cli.main":
            raise KeyboardInterrupt
sys.meta_path.insert(0, Interrupted())
from falsework.__main__ import main
sys.exit(main())
"""
    done = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=False)
    assert (done.returncode, done.stdout, done.stderr) == (130, "", "falsework: interrupted\n")


@pytest.mark.skipif(sys.platform != "linux", reason="Linux limits the address space")
def test_a_lack_of_memory_is_said(tmp_path: Path) -> None:
    """Under a limit that begins when OpenBLAS has started, which loops when it finds no memory."""
    code = """
import resource, sys
import numpy, scipy.linalg
taken = int(open("/proc/self/statm").read().split()[0]) * resource.getpagesize()
resource.setrlimit(resource.RLIMIT_AS, (taken + 30_000_000,) * 2)
from falsework.__main__ import main
sys.exit(main())
"""
    command = [sys.executable, "-c", code, "plan", "vault:parts=246", "--out", str(tmp_path / "plan.json")]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=60)
    assert (done.returncode, done.stdout) == (4, "")
    assert done.stderr == "falsework: out of memory; try a smaller structure or search width\n"
    assert not (tmp_path / "plan.json").exists()
