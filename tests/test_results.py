"""Every published figure comes from a record, and every recorded benchmark still runs."""

from __future__ import annotations

import contextlib
import io
import json
import re
import runpy
import sys
from importlib import import_module
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest

from falsework.cli.main import COMMANDS, main

REPOSITORY = Path(__file__).resolve().parents[1]
BENCHMARKS = REPOSITORY / "benchmarks"
FILES = sorted((BENCHMARKS / "results").glob("*.jsonl"))
RECORDS = [json.loads(line) for file in FILES for line in file.read_text(encoding="utf-8").splitlines()]
ORIGIN = {"benchmark": str, "command": str, "commit": str, "date": str, "device": str, "seeds": list, "versions": dict}
COMMAND_LINES = [str(record["command"]) for record in RECORDS]
SCRIPTS = sorted({found[1] for line in COMMAND_LINES if (found := re.search(r"benchmarks/(\w+)\.py", line))})
SMOKE = {
    "contacts": ["--structures", "bottle", "--repeats", "2"],
    "clearance": ["--structures", "bottle", "--directions", "20", "--repeats", "1"],
    "search": ["plan", "--structures", "arch:blocks=5"],
    "support": ["--structures", "arch:blocks=5", "--deadline", "5"],
    "search_compare": ["--structures", "arch:blocks=5", "--seeds", "1"],
    "luck": ["--structures", "arch:blocks=5", "--perturbations", "2", "--criterion", "equilibrium"],
    "stability": ["--structures", "arch:blocks=5", "--states", "8"],
    "verdicts": ["--structures", "arch:blocks=5", "--states", "8", "--rounds", "1"],
    "contact": ["all", "--structures", "arch:blocks=5", "--seeds", "1", "--repeat", "1"],
    "changes": ["--structures", "arch:blocks=5", "--draws", "2"],
    "judges": ["plans", "--structures", "stack:blocks=2", "--changes", "1"],
    "margins": ["truth", "--cases", "1"],
    "bricks": ["--heights", "1", "--repeats", "1"],
    "first_minute": ["--commands", "help", "--before", "", "--repeats", "1"],
    "scaling": ["--alone", "--parts", "60", "--repeats", "1"],
    "curved": ["--pairs", "4"],
    "free_edges": ["--cases", "first"],
    "holds": ["modes", "--structures", "arch:blocks=5"],
    "replan": ["complete", "--structures", "arch:blocks=5", "--seeds", "1"],
    "policies": ["cost", "--structures", "arch:blocks=5", "--kinds", "mlp"],
    "learning": ["table3", "--rows", "arch:blocks=5:2", "--seeds", "0", "--steps", "5", "--states", "5", "--quiet"],
}


@pytest.fixture
def tables(monkeypatch: pytest.MonkeyPatch) -> Any:
    """Return the module that fills pages with tables."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    return import_module("tables")


@pytest.fixture
def model(tables: Any) -> Any:
    """Return the module that makes a table of records."""
    return import_module("table_model")


def run(script: str, arguments: list[str], monkeypatch: pytest.MonkeyPatch) -> tuple[int, str]:
    """Run a benchmark in this process; return its exit code and what it printed."""
    monkeypatch.syspath_prepend(str(BENCHMARKS))
    monkeypatch.setattr(sys, "argv", [str(BENCHMARKS / f"{script}.py"), *arguments])
    printed, code = io.StringIO(), 0
    with contextlib.redirect_stdout(printed):
        try:
            runpy.run_path(sys.argv[0], run_name="__main__")
        except SystemExit as end:
            code = end.code if isinstance(end.code, int) else int(end.code is not None)
    return code, printed.getvalue()


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_records_name_their_origin(file: Path) -> None:
    for number, line in enumerate(file.read_text(encoding="utf-8").splitlines(), 1):
        record = json.loads(line)
        for key, kind in ORIGIN.items():
            known = isinstance(record[key], kind)
            assert known or (record[key] is None and record["provenance"]), f"{file.name}:{number}: {key}"
        assert re.fullmatch(r"20\d\d-\d\d-\d\d", record["date"]), f"{file.name}:{number}"
        assert re.fullmatch(r"[0-9a-f]{7}", record["commit"] or "0000000"), f"{file.name}:{number}: not a clean commit"
        assert record["benchmark"].split()[0] == file.stem, f"{file.name}:{number}"


@pytest.mark.parametrize("file", FILES, ids=lambda file: file.stem)
def test_no_record_is_there_twice(file: Path) -> None:
    """A merge may append the same lines again, and a table would then count a seed twice."""
    lines = file.read_text(encoding="utf-8").splitlines()
    assert len(set(lines)) == len(lines)


def test_pages_hold_what_the_records_say(tables: Any) -> None:
    stale = [page.name for page in tables.PAGES if tables.filled(page) != page.read_text(encoding="utf-8")]
    assert not stale, "run `make results`"


def test_another_figure_makes_another_table(tables: Any, model: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    page = BENCHMARKS / "RESULTS.md"
    changed = [{**record, "per_second": 10.0} for record in model.records("service")]
    before = tables.table("service", page)
    monkeypatch.setattr(model, "records", lambda _: changed)
    assert "| 9.98 |" in before
    assert "| 9.98 |" not in tables.table("service", page)


def test_every_table_has_rows_and_every_block_a_table(tables: Any) -> None:
    names = {*tables.README_TABLES, *tables.TABLES}
    for name in names:
        assert tables.table(name, BENCHMARKS / "RESULTS.md").count("\n") >= 4, name
    blocks = {name for page in tables.PAGES for _, name, _ in tables.BLOCK.findall(page.read_text(encoding="utf-8"))}
    assert blocks == names


def test_a_row_is_median_and_range_at_the_newest_commit(model: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    common = {"benchmark": "x", "name": "a", "command": "", "device": "d", "date": "today"}
    figures = [(0.1, "old"), (9.98, "new"), (9.5, "new"), (11.0, "new")]
    runs = [{**common, "s": s, "seeds": [seed], "commit": commit} for seed, (s, commit) in enumerate(figures)]
    monkeypatch.setattr(model, "records", lambda _: runs)
    made = model.Table("x", (("name", "{name}"),), (("seconds", "{s:s}"), ("none", "{missing}")))
    lines = made.text(REPOSITORY / "README.md").splitlines()
    assert lines[2] == "| a | 9.98 s (9.5 to 11) |"
    assert lines[-1].startswith("d, today (new). Seeds: 3. [x.jsonl]")


def test_the_page_of_results_is_short() -> None:
    """One table for each question: what else was measured stays in the records."""
    assert len((BENCHMARKS / "RESULTS.md").read_text(encoding="utf-8").split()) < 4000


def test_prose_of_the_results_holds_no_figures() -> None:
    text = (BENCHMARKS / "RESULTS.md").read_text(encoding="utf-8")
    prose = re.sub(r"<!-- results: .*?<!-- /results -->", "", text, flags=re.DOTALL)
    measured = r"\d[\d.,]*\s*(?:%|s\b|seconds|minutes|µs|times|MB|GB|GiB|TB/s|TFLOP)|\d+\.\d+"
    assert re.findall(measured, prose) == []


@pytest.mark.parametrize("script", SCRIPTS)
def test_recorded_benchmarks_still_start(script: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if script == "motion" and not all(map(find_spec, ("coal", "pinocchio"))):
        pytest.skip("needs Coal and Pinocchio")
    code, text = run(script, ["--help"], monkeypatch)
    assert code == 0
    assert "--out" in text
    asked = (re.search(rf"benchmarks/{script}\.py ([a-z][\w-]*)", line) for line in COMMAND_LINES)
    for what in {found[1] for found in asked if found}:
        assert what in text, f"benchmarks/{script}.py {what} is recorded, but no longer offered"


def test_recorded_commands_of_falsework_still_exist(capsys: pytest.CaptureFixture[str]) -> None:
    for name in {line.split()[1] for line in COMMAND_LINES if line.startswith("falsework ")}:
        assert name in COMMANDS
        assert main([name, "--help"]) == 0
    assert "--minutes" in capsys.readouterr().out


@pytest.mark.slow
@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_the_time_of_a_plan_is_measured_by_phase(criterion: str, monkeypatch: pytest.MonkeyPatch) -> None:
    code, text = run("scaling", ["--alone", "--plans", "--parts", "60", "--criteria", criterion], monkeypatch)
    record = json.loads(text)
    assert code == 0
    assert record["found"]
    assert record["reached"] == record["steps"] == 118
    phases = record["contacts_s"] + record["search_s"] + record["proofs_s"]
    assert record["plan_s"] == pytest.approx(phases, abs=0.01)


@pytest.mark.slow
@pytest.mark.parametrize("script", SMOKE)
def test_cheap_benchmarks_run(script: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    out = tmp_path / "records.jsonl"
    code, text = run(script, [*SMOKE[script], "--out", str(out)], monkeypatch)
    assert code == 0
    if script == "scaling":  # one size in this process prints its figures for the process that records them
        assert json.loads(text)["parts"] == 63
        return
    records = [json.loads(line) for line in out.read_text(encoding="utf-8").splitlines()]
    assert records == [json.loads(line) for line in text.splitlines()]
    for record in records:
        assert all(isinstance(record[key], kind) for key, kind in ORIGIN.items())
        assert record["benchmark"].split()[0] == script
        assert "--out" not in record["command"]
