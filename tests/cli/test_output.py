"""Output of commands: no text of a file controls the terminal, and nothing is lost to an encoding."""

from __future__ import annotations

import io
import json
import os
import subprocess
import sys
import unicodedata
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from falsework.cli.output import Output, write_line
from falsework.utils.files.printable import printable

EVIL = "a\x1b[2J\x07\r\nplan.json: all 9 states are stable\u202e\u2028\x9b1m\ud800\0"


def test_printable_text_has_no_controls() -> None:
    every = "".join(map(chr, range(0x11000)))
    shown = printable(every)
    assert not {unicodedata.category(c) for c in shown} & {"Cc", "Cf", "Cs", "Zl", "Zp"}
    shown.encode()
    assert printable(shown) == shown
    assert printable("Ünïcode, 部品 – ½\u00a0m") == "Ünïcode, 部品 – ½\u00a0m"
    assert printable("a\x1b\n\ud800") == r"a\x1b\n\ud800"


@pytest.mark.parametrize("way", ["say", "note", "table", "bar"])
def test_names_cannot_control_the_terminal(way: str, capsys: pytest.CaptureFixture[str]) -> None:
    output = Output(machine=False)
    if way == "table":
        output.table(("part", EVIL), [(EVIL, "1")])
    elif way == "bar":
        with output.bar(EVIL) as show:
            show(1, 2, EVIL)
    else:
        getattr(output, way)(EVIL)
    captured = capsys.readouterr()
    text = captured.out + captured.err
    for control in ("\x1b", "\x07", "\r", "\u202e", "\u2028", "\x9b", "\ud800", "\0"):
        assert control not in text
    if way in ("say", "note"):
        assert text.count("\n") == 1
        assert r"\nplan.json: all 9" in text


def test_what_an_encoding_lacks_is_escaped() -> None:
    for encoding in ("ascii", "latin-1", "utf-8"):
        raw = io.BytesIO()
        stream = io.TextIOWrapper(raw, encoding=encoding)
        write_line("部 \udcff", stream)
        stream.flush()
        assert raw.getvalue().endswith(b" \\udcff\n")


def test_controls_in_names_errors_and_warnings(
    falsework: Callable[..., Any], write_structure: Callable[..., Path], tmp_path: Path
) -> None:
    """Through whole commands: names of parts in results, in errors, and in the names of files."""
    named = write_structure(tmp_path / "evil", names=["floor", EVIL[:-2], "top\x1b[31m"])
    plan = tmp_path / "plan\x1b[2J.json"
    for arguments in (
        ("plan", named, "--out", plan),
        ("check", plan, "--steps"),
        ("stability", named, "--explain"),
        ("check", tmp_path / "no\x1b[2J.json"),
        ("stability", named, "--debug", "--boundary", "top\x1b[0m"),
        ("doctor", named),
    ):
        finished = falsework(*arguments)
        for text in (finished.out, finished.error):
            assert "\x1b" not in text, (arguments, text)
            assert not any(line.startswith("plan.json: all 9") for line in text.splitlines()), arguments


@pytest.mark.skipif(os.name != "posix", reason="file names are bytes on POSIX")
@pytest.mark.parametrize("locale", ["of the tests", "C"])
def test_paths_that_are_no_text_do_not_lose_a_plan(
    falsework: Callable[..., Any],
    write_structure: Callable[..., Path],
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    locale: str,
) -> None:
    monkeypatch.chdir(tmp_path)
    folder = os.fsencode(tmp_path) + b"/parts \xff \xc3\xa9"
    write_structure(tmp_path / "parts").rename(os.fsdecode(folder))

    def run(*arguments: bytes | str) -> tuple[int, str]:
        if locale == "of the tests":
            finished = falsework(*map(os.fsdecode, arguments))
            return finished.code, finished.error
        settings = {"PYTHONUTF8": "0", "LC_ALL": "C", "PYTHONCOERCECLOCALE": "0"}
        command = [sys.executable, "-m", "falsework", *arguments]
        done = subprocess.run(command, capture_output=True, env=os.environ | settings, check=False)
        return done.returncode, done.stderr.decode("ascii")

    code, error = run("plan", folder, "--out", b"plan \xfe.json")
    assert code == 0, error
    assert json.loads(Path(os.fsdecode(b"plan \xfe.json")).read_text(encoding="utf-8"))["steps"]
    code, error = run("check", b"plan \xfe.json")
    assert code == 0, error
    code, error = run("check", b"other \xfe.json")
    assert code == 2
    assert r"other \udcfe.json" in error


@pytest.mark.skipif(os.name != "posix", reason="streams have paths on POSIX")
def test_a_plan_on_standard_output_is_alone_there(write_structure: Callable[..., Path], tmp_path: Path) -> None:
    write_structure(tmp_path / "blocks")
    command = [sys.executable, "-m", "falsework", "plan", "blocks", "--out", "/dev/stdout", "--json"]
    done = subprocess.run(command, cwd=tmp_path, capture_output=True, check=True)
    assert Path(json.loads(done.stdout)["structure"]["source"]["path"]) == (tmp_path / "blocks").resolve()
    assert json.loads(done.stderr)["plans"][0]["robots"] == 2
