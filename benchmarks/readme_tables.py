"""Tables of the README, whose rows come from several benchmarks."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any

from table_list import over_draws
from table_model import Runs, commits, fill_in, look_up, markdown, notes, origin, records, seeds


@dataclass(frozen=True)
class Line:
    """Row of a table."""

    subject: str
    source: str
    where: dict[str, Any]
    """Values by path that records must have."""
    value: str
    """Template of the figures, in which `{mean}` is the mean over draws, with their range."""
    comparison: str = ""

    def runs(self) -> Runs:
        """Return the records at the newest commit."""
        found = [r for r in records(self.source) if all(look_up(r, path) == want for path, want in self.where.items())]
        return [run for run in found if run["commit"] == found[-1]["commit"]]


HEADLINE = (
    Line(
        "Plan for vault-62 with two robots, every state proven, the whole plan replayed",
        "contact",
        {"benchmark": "contact plan", "structure": "vault-62"},
        "{seconds:s}",
    ),
    Line(
        "The same for dome-72",
        "contact",
        {"benchmark": "contact plan", "structure": "dome-72"},
        "{seconds:s}",
    ),
    Line(
        "A verdict of vault-62 on a GPU, device time, batches of 1,024 (`equilibrium`)",
        "gpu_stability",
        {"benchmark": "gpu_stability", "structure": "vault-62", "drawn_from": "states that a search asks about"},
        "{ms_a_state.1024:ms}, {same_as_cpu} of {states} verdicts as on the processor",
        "published method, re-implemented: {shared_inverse.ms_a_state} ms, "
        "{shared_inverse.wrong} of {shared_inverse.states} wrong",
    ),
    Line(
        "The same, whole call with certificates",
        "gpu_stability",
        {"benchmark": "gpu_stability", "structure": "vault-62", "drawn_from": "states that a search asks about"},
        "{check_ms.1024:ms}",
        "{shared_inverse.ms_a_state/check_ms.1024} times less than the re-implemented method",
    ),
    Line(
        "Device time beside the published implementation, in another run",
        "gpu_stability",
        {"benchmark": "gpu_stability published", "structure": "vault-62"},
        "{ms_a_state.1024:ms}",
        "{published_ms:ms}",
    ),
    Line(
        "Wrong verdicts in that run, states of five structures",
        "gpu_stability",
        {"benchmark": "gpu_stability published-errors"},
        "{wrong} of {states}",
        "{published_wrong} of {states} with the paper's settings, {published_wrong_defaults} with the defaults",
    ),
    Line(
        "Policy for vault-62, success from unseen states, criterion `contact`",
        "learning",
        {
            "benchmark": "learning draws",
            "structure": "vault-62",
            "data": "wide",
            "criterion": "contact",
            "label": "",
        },
        "{mean} % after {seconds} s and {search_seconds} s of searches, mean over draws of unseen states",
        "paper, under equilibrium: {paper.test:%} % after {paper.hours} hours",
    ),
    Line(
        "The same for dome-72, criterion `contact`",
        "learning",
        {
            "benchmark": "learning draws",
            "structure": "dome-72",
            "data": "wide",
            "criterion": "contact",
            "label": "",
        },
        "{mean} % after {seconds} s and {search_seconds} s of searches, mean over draws of unseen states",
        "paper, under equilibrium: {paper.test:%} % after {paper.hours} hours",
    ),
    Line(
        "The same for dome-72, criterion `equilibrium`",
        "learning",
        {
            "benchmark": "learning table3",
            "structure": "dome-72",
            "data": "wide",
            "evaluated": "all states",
            "criterion": "equilibrium",
        },
        "{test.success:%} % of {test.states} after {seconds} s",
        "paper: {paper.test:%} % after {paper.hours} hours",
    ),
    Line(
        "Policy for vault-62 trained on the paper's own data, criterion `equilibrium`",
        "learning",
        {
            "benchmark": "learning draws",
            "structure": "vault-62",
            "robots": 2,
            "data": "width64",
            "label": "explored",
        },
        "{mean} % after {seconds} s and {search_seconds} s of searches, mean over draws of unseen states",
        "paper: {paper.test:%} % after {paper.hours} hours, one draw",
    ),
)


def _vault(parts: int, criterion: str, robots: int) -> Line:
    """Return the row of a built-in vault."""
    where = {"benchmark": "scaling plan", "parts": parts, "criterion": criterion, "robots": robots}
    return Line(f"vault of {parts:,} parts", "scaling", where, "{plan_s}")


def _searched(structure: str, subject: str, robots: int) -> Line:
    """Return the row of a structure whose seeds were searched in one run, by the name or path of the structure."""
    where = {"benchmark": "search_compare plans", "structure": structure, "criterion": "contact", "robots": robots}
    return Line(subject, "search_compare", where, "{cpu_seconds}")


LARGE = (
    _vault(989, "equilibrium", 2),
    _vault(2012, "equilibrium", 2),
    _vault(3998, "equilibrium", 2),
    _vault(10021, "equilibrium", 2),
    _vault(126, "contact", 2),
    _vault(126, "contact", 3),
    _vault(246, "contact", 2),
    _vault(246, "contact", 3),
    _searched("vault:parts=500", "vault of 510 parts", 2),
    _vault(510, "contact", 3),
    _vault(510, "contact", 4),
    _searched("vault:parts=1000", "vault of 989 parts", 2),
    _searched("vault:parts=4000", "vault of 3,998 parts", 2),
    _searched("pavilion-vault-387", "pavilion of 387 parts", 2),
    _searched("armadillo-399-cra", "Armadillo, a shell of 399 parts, friction 0.84", 4),
    _searched("armadillo-399", "Armadillo, friction 0.55", 4),
)


def with_mean(template: str, runs: Runs) -> str:
    """Put the mean success over draws into a template that asks for it."""
    return template.replace("{mean}", over_draws("success", "%")(runs)) if "{mean}" in template else template


def headline(page: Path) -> str:
    """Return few figures, each with its comparison."""
    found = [(line, line.runs()) for line in HEADLINE]
    body = [
        [
            line.subject,
            fill_in(with_mean(line.value, runs), runs),
            fill_in(line.comparison, runs),
            seeds(runs),
            commits(runs),
        ]
        for line, runs in found
    ]
    return _with_origin(["", "falsework", "compared with", "seeds", "commit"], body, HEADLINE, page)


def large(page: Path) -> str:
    """Return what plans of large structures take, and where none is found."""
    body = []
    for line in LARGE:
        runs = line.runs()
        found = sum(int(run["found"]) for run in runs)  # of one seed, whether there is a plan
        tried = sum(len(run["seeds"]) for run in runs)
        task = [str(line.where["criterion"]), str(line.where["robots"])]
        effort = [fill_in(line.value, runs), fill_in("{memory_gib}", runs)]
        body.append([line.subject, *task, f"{found} of {tried}", *effort, commits(runs), notes(runs)])
    heads = ["structure", "criterion", "robots", "plans of seeds", "CPU time, s", "memory, GiB", "commit", "note"]
    return _with_origin(heads, body, LARGE, page)


def _with_origin(heads: list[str], body: list[list[str]], lines: tuple[Line, ...], page: Path) -> str:
    used = [run for line in lines for run in line.runs()]
    return markdown(heads, body) + "\n\n" + origin(used, [line.source for line in lines], page)


README_TABLES = {"headline": headline, "large": large}
