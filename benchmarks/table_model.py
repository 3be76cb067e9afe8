"""Tables of records: one row per subject, from the runs at the newest commit."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from statistics import median
from typing import Any

REPOSITORY = Path(__file__).resolve().parents[1]
RESULTS = REPOSITORY / "benchmarks" / "results"
Record = dict[str, Any]
Runs = Sequence[Record]
"""Records of one row."""


_KEYS = {"two_states": "goal_conditioned"}
_NETWORKS = {"residual": "resmlp", "parts": "transformer", "graph": "gat"}
_KINDS = {"policy", "kind"}
"""Keys that name a network."""


@cache
def records(source: str) -> tuple[Record, ...]:
    """Return all records of a file, the oldest first."""
    lines = (RESULTS / f"{source}.jsonl").read_text(encoding="utf-8").splitlines()
    return tuple(_translated(json.loads(line)) for line in lines)


def _translated(record: Record) -> Record:
    """Return a record with the present names of keys that records of earlier versions name differently."""
    translated = {_KEYS.get(key, key): value for key, value in record.items()}
    return translated | {key: _NETWORKS.get(translated[key], translated[key]) for key in _KINDS & translated.keys()}


def look_up(record: Record, path: str) -> Any:
    """Return the value at a path such as `test.success`; None where there is none."""
    value: Any = record
    for word in path.split("."):
        if isinstance(value, list) and word.isdigit():
            value = value[int(word)] if int(word) < len(value) else None
        else:
            value = value.get(word) if isinstance(value, dict) else None
    return value


def number(value: float, form: str = "") -> str:
    """Write a number: three digits, four from 10 on, percentages (form `%`) with two decimals, no trailing zeros."""
    if form == "%":
        return f"{100 * value:.2f}".rstrip("0").rstrip(".")
    if isinstance(value, int) or abs(value) >= 100:
        return f"{value:,.0f}"
    text = f"{value:.{3 if abs(value) < 10 else 4}g}"
    return f"{value:.6f}".rstrip("0") if "e" in text else text


def spread(values: Sequence[float], form: str = "") -> str:
    """Write the median with its unit (any form but `%`) and the range, the range only where it is one."""
    low, middle, high = (number(value, form) for value in (min(values), median(values), max(values)))
    unit = "" if form in ("", "%") else f" {form}"
    return middle + unit if low == high else f"{middle}{unit} ({low} to {high})"


def typical(value: Any) -> float | None:
    """Return a figure, or the median of several."""
    return median(value) if isinstance(value, list) else value


def figure(runs: Runs, path: str, form: str = "") -> str:
    """Write the figure at a path, or the quotient of two, over some runs; empty where no run has it."""
    if "/" in path:
        over, under = (typical(look_up(runs[-1], one)) for one in path.split("/"))
        return "" if over is None or under is None else number(over / under)
    found = [value for value in (look_up(run, path) for run in runs) if value is not None]
    if not found:
        return ""
    if isinstance(found[0], str | bool):
        found = [one if isinstance(one, str) else "yes" if one else "no" for one in found]
        return ", ".join(dict.fromkeys(found))
    if isinstance(found[0], dict) and "median" in found[0]:
        if len(found) > 1:
            return spread([value["median"] for value in found], form)
        if "least" in found[0]:
            return spread([found[0]["least"], found[0]["median"], found[0]["most"]], form)
        most = found[0].get("most")
        return number(found[0]["median"], form) + ("" if most is None else f" (worst {number(most, form)})")
    return spread([one for value in found for one in (value if isinstance(value, list) else [value])], form)


def fill_in(template: str, runs: Runs) -> str:
    """Put figures into a template such as `{agree} of {states}`; empty where one is missing."""
    found = [figure(runs, *match.split(":")) for match in re.findall(r"{([^}]*)}", template)]
    return "" if not all(found) else re.sub(r"{[^}]*}", lambda _: found.pop(0), template)


def seeds(runs: Runs) -> str:
    """Write the number of seeds; empty where it is unknown or nothing is random."""
    count = sum(len(run["seeds"]) for run in runs)
    return str(count) if count else ""


def notes(runs: Runs) -> str:
    """Write remarks on the runs: notes, shared machines, missing origins."""
    found = [part for run in runs for part in (run.get("note") or "").split("; ") if part]
    loads = [run["load_before"] for run in runs if run.get("load_before", 0) > 1]
    if loads:
        found.append(f"shared machine, load {number(max(loads))}")
    if any(run["command"] is None for run in runs):
        found.append("command not recorded")
    return "; ".join(dict.fromkeys(found))


def commits(runs: Runs) -> str:
    """Write the commits of some runs."""
    return ", ".join(dict.fromkeys(run["commit"] or "not recorded" for run in runs))


@dataclass(frozen=True)
class Table:
    """A table with a row for each subject, from the runs at the newest commit that has it."""

    source: str
    """Name of the file of records."""
    key: tuple[tuple[str, str], ...]
    """Header and template of the columns that identify a row."""
    columns: tuple[tuple[str, str | Callable[[Runs], str]], ...]
    """Header, and template or function of the runs of a row."""
    benchmark: str | tuple[str, ...] = ""
    """Name of the benchmark in the records, or several; the name of the file if empty."""
    where: Callable[[Record], bool] = lambda _: True
    """Which records belong to the table."""
    apart: str = ""
    """Key of runs of one row that are compared: of each value there are the runs at the newest commit that has it."""
    newest: str = "commit"
    """Key of which a row has the runs with the newest value; another one gathers the runs of several commits."""

    def rows(self) -> list[Runs]:
        """Return the newest runs of each subject, in the order of their first records."""
        groups: dict[tuple[str, ...], list[Record]] = {}
        names = (self.benchmark or self.source,) if isinstance(self.benchmark, str) else self.benchmark
        for record in records(self.source):
            if record["benchmark"] in names and self.where(record):
                groups.setdefault(tuple(fill_in(template, [record]) for _, template in self.key), []).append(record)
        newest = [{run.get(self.apart): run[self.newest] for run in runs} for runs in groups.values()]
        return [
            [run for run in runs if run[self.newest] == last[run.get(self.apart)]]
            for runs, last in zip(groups.values(), newest, strict=True)
        ]

    def text(self, page: Path) -> str:
        """Return the table as Markdown, with its devices and a link to its data."""
        rows = self.rows()
        heads = [head for head, _ in (*self.key, *self.columns)]
        body = [
            [fill_in(template, runs) for _, template in self.key]
            + [column(runs) if callable(column) else fill_in(column, runs) for _, column in self.columns]
            for runs in rows
        ]
        used = [run for runs in rows for run in runs]
        below = []
        if counts := sorted({int(count) for runs in rows if (count := seeds(runs))}):
            below.append(f"Seeds: {' to '.join(dict.fromkeys(map(str, (counts[0], counts[-1]))))}.")
        if said := notes(used):
            below.append(f"{said[0].upper()}{said[1:]}.")
        below.append(f"{data_link(self.source, page)}.")
        return "\n\n".join([markdown(heads, body), " ".join([f"{places(used)}.", *below])])


def markdown(heads: Sequence[str], body: Sequence[Sequence[str]]) -> str:
    """Write a table without its empty columns."""
    shown = [n for n in range(len(heads)) if any(row[n] for row in body)]
    lines = [[heads[n] for n in shown], ["---"] * len(shown), *([row[n] for n in shown] for row in body)]
    return "\n".join(re.sub(r"  (?=\|)", " ", f"| {' | '.join(line)} |") for line in lines)


def origin(runs: Iterable[Record], sources: Sequence[str], page: Path) -> str:
    """Write device and date of runs, and where their data and commands are."""
    files = ", ".join(data_link(source, page) for source in dict.fromkeys(sources))
    return f"{places(runs)}. Data and commands: {files}."


def places(runs: Iterable[Record]) -> str:
    """Write devices, dates and commits of runs."""
    devices: dict[str, dict[str, dict[str, None]]] = {}
    for run in runs:
        days = devices.setdefault(run["device"], {})
        days.setdefault(run["date"], {})[run["commit"] or "not recorded"] = None
    each = {
        device: ", ".join(f"{day} ({', '.join(names)})" for day, names in days.items())
        for device, days in devices.items()
    }
    return "; ".join(f"{device}, {days}" for device, days in each.items())


def data_link(source: str, page: Path) -> str:
    """Write a link to a file of records; its path alone in the pages that Sphinx builds."""
    path = RESULTS / f"{source}.jsonl"
    if "docs" in page.relative_to(REPOSITORY).parts:
        return f"`benchmarks/results/{path.name}`"
    return f"[{path.name}]({path.relative_to(page.parent).as_posix()})"
