"""Benchmark of luck: how often searches find a plan, what it costs, and how much that depends on chance.

    python benchmarks/luck.py --runs out/luck.jsonl --processes 16 --out benchmarks/results/luck.jsonl
    python benchmarks/luck.py --runs out/before.jsonl --source ../before --half tuned
    python benchmarks/luck.py --structures vault-62 cube-17 --robots 2 --perturbations 2
    python benchmarks/luck.py --runs out/rules.jsonl --without each all --perturbations 3 --processes 16 \\
        --out benchmarks/results/rules.jsonl
    python benchmarks/luck.py --runs out/rules.jsonl --without each all --perturbations 3 --table

Twenty structures of 12 to 500 parts, each with two numbers of robots, none proven to be too few, under both criteria.
Each case is searched for a plan ten times: as it is, and in nine perturbations that change nothing that matters. Each
perturbation draws from a random generator of its own the seed of the search, factors of 1 ± 1e-12 on the weights, the
numbers of the parts, and an angle by which the structure is turned about the vertical.

A run costs verdicts, repeated ones included as searches count them, and replayed steps, of which there are some only
under `contact`. It ends with a plan (`found`), with nothing left to try (`exhausted`, `impossible`), after `--budget`
times as many verdicts and steps as the structure has parts (`budget`), or after `--limit` seconds of processor time
(`limit`), which depends on the machine. Loading, compilation and the proofs of the plan do not count. The proof that
robots are too few, which a search tries after some seconds, is left out, since it depends on time too. Searches have
the default reserve: under `contact` a plan that does without it, or falls under a change of settings, does not count as
solved, but in `without_reserve`.
Each run is a process of its own that keeps to one core.

Half of the structures are held out: they are of the same kinds and sizes as the others, and nothing is tuned on them.
Change neither half; compare their scores from commit to commit.

Each run is a line of the file `--runs`, and is skipped where it is there already: the same command goes on with an
interrupted benchmark, also after `--minutes`. Once all are there, records follow: scores of each half and of both
(`luck halves`), with costs per part, and of each case (`luck cases`). `spread` is the cost that 90 % of the solved
perturbations keep over that of 10 %, of several cases the median; `mixed` is the share of cases of which some
perturbations are solved and others are not. Real structures are found by FALSEWORK_DATA, see `states.py`.

`--without` makes all searches with the rules of `search_rules.py` first, then again without each of those named where
the rule took effect, and compares these pairs (`rules sweep`): shares solved and without the reserve, numbers of pairs
of which only one is solved, and ratios of medians (without the rule over with it) over perturbations in which both find
a plan with the same reserve, of several cases the median with the range. Cases that take too long with all rules are
left out, unless structures are named; `--table` prints the comparison of the runs that are there so far.
"""

from __future__ import annotations

import json
import os
import resource
import subprocess
import sys
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import wraps
from inspect import signature
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np
import tyro
from numpy.typing import NDArray
from record import report, rounded, spread, write_to
from runs import SOURCE, Run, append, kept, own_cores, printed_by, read_runs, run_all
from search_rules import LEFT_OUT, acts_in, comparison, each_of, probe_all, switch_off

if TYPE_CHECKING:
    from falsework import Assembly
    from falsework.search.planning import Planning

Half = Literal["tuned", "held-out"]
Criterion = Literal["contact", "equilibrium"]

TUNED: dict[str, tuple[int, ...]] = {
    "bottle-12": (1, 2),
    "tetris-14": (1, 2),
    "cube-17": (1, 2),
    "dog-35": (1, 2),
    "vault-62": (2, 3),
    "dome:rings=6,blocks=14": (2, 3),
    "barrel-vault-121": (2, 3),
    "crossvault-184": (2, 3),
    "vault:parts=250": (2, 3),
    "armadillo-399": (3, 4),
}
"""Structures that searches may be tuned on, with numbers of robots."""
HELD_OUT: dict[str, tuple[int, ...]] = {
    "tetris-13": (1, 2),
    "tetris-17": (1, 2),
    "polycube:pieces=20,seed=1": (1, 2),
    "dome-37": (2, 3),
    "dome-72": (2, 3),
    "dome-90": (3, 4),
    "genevault-110": (2, 3),
    "vault:parts=190,span=5,rise=1.6,thickness=0.16": (2, 3),
    "pavilion-vault-387": (2, 3),
    "vault:parts=480,span=6,rise=1.5,thickness=0.15": (3, 4),
}
"""Structures that nothing is tuned on, never."""

_REAL = {name for name in (*TUNED, *HELD_OUT) if ":" not in name}
"""Those that come from files."""
_KEY = ("source", "structure", "robots", "criterion", "perturbation", "budget", "limit", "without")
"""Fields that tell a run from all others."""
_WEIGHT = 1e-12
"""Largest relative change of a weight."""
_GRACE = 120.0
"""Seconds after which a process is killed, in addition to five times its limit: to load and to prove."""


@dataclass(frozen=True)
class Options:
    """Cases, effort and files."""

    runs: Path | None = None
    """File to which each run is appended, and whose runs are not repeated; use one for each state of the code."""
    out: Path | None = None
    """File to which the records are appended once all runs are there."""
    structures: tuple[str, ...] = ()
    """Names among those of the benchmark, or any others; all of the benchmark if not given."""
    half: Half | None = None
    """Only this half of the structures."""
    robots: tuple[int, ...] = ()
    """Numbers of robots, in place of those of each structure."""
    criterion: tuple[Criterion, ...] = ("contact", "equilibrium")
    """Criteria of the plans."""
    perturbations: int = 10
    """Perturbations of each case; number 0 is the structure as it is, with seed 0."""
    budget: float = 50.0
    """Verdicts and replayed steps of a search, as a multiple of the number of parts."""
    limit: float = 40.0
    """Seconds of processor time of a search."""
    without: tuple[str, ...] = ()
    """Rules that are switched off, one after the other; `each` for every rule, `all` for all at once, names joined by
    `+` for several at once."""
    table: bool = False
    """Make no runs; print the comparison of rules over those that are there."""
    processes: int = 1
    """Searches at the same time, each on a core of its own (Linux)."""
    minutes: float | None = None
    """Minutes after which no more runs begin."""
    source: Path = SOURCE
    """Source tree whose searches are measured, such as a worktree of another commit."""
    source_name: str = ""
    """Name of this tree in the runs and records; its commit if not given."""
    child: str = ""
    """Make the run that this JSON object describes in this process, and print its figures."""


@dataclass(frozen=True)
class Perturbation:
    """Change of a structure that changes no verdict, and a seed."""

    seed: int
    """Of the search."""
    order: NDArray[np.int64]
    """Present number of each part in its new order, shape (parts,)."""
    weights: NDArray[np.float64]
    """Factors on the weights of the parts in their present order, shape (parts,)."""
    angle: float
    """By which the structure is turned about the vertical, radians."""

    @classmethod
    def draw(cls, number: int, parts: int) -> Perturbation:
        """Return a perturbation of a structure of some parts, always the same; number 0 changes nothing."""
        if number == 0:
            return cls(0, np.arange(parts), np.ones(parts), 0.0)
        rng = np.random.default_rng((number, parts))
        seed, order = int(rng.integers(2**31)), rng.permutation(parts)
        return cls(seed, order, 1.0 + rng.uniform(-_WEIGHT, _WEIGHT, parts), float(rng.uniform(0.0, 2 * np.pi)))

    def of(self, assembly: Assembly) -> Assembly:
        """Return the perturbed structure, whose contacts are found anew.

        Raises:
            ValueError: a structure with given contacts, loads, joints or props, which are not perturbed.
        """
        from falsework import Assembly
        from falsework.geometry import TriangleMesh

        if assembly.contacts_given or assembly.props or not (assembly.loads is None and assembly.joints is None):
            raise ValueError(f"{assembly.name} has more than parts and dry contacts; leave it out")
        cos, sin = np.cos(self.angle), np.sin(self.angle)
        turn = np.array([[cos, -sin, 0.0], [sin, cos, 0.0], [0.0, 0.0, 1.0]])
        parts = [assembly.meshes[part] for part in self.order]
        return Assembly.from_meshes(
            [TriangleMesh.from_arrays(part.name, part.vertices @ turn.T, part.faces) for part in parts],
            boundary=assembly.boundary[self.order],
            density=(assembly.density * self.weights)[self.order],
            friction=assembly.friction,
            name=assembly.name,
            contact_settings=assembly.contact_settings,
        )


class _Spent(KeyboardInterrupt):
    """Budget or limit used up in the middle of a level: searches end in good order, as when interrupted."""


class Meter:
    """Count of the verdicts and replayed steps of a search, which ends it when they are used up."""

    def __init__(self, budget: float, limit: float) -> None:
        """Begin with nothing, at the present processor time."""
        self.verdicts = self.replayed = 0
        self.ended = ""
        """What is used up, `budget` or `limit`; empty if nothing is."""
        self.running = True
        """Whether calls count."""
        self._budget, self._limit = budget, limit
        self._begun, self._uncounted = time.process_time(), 0.0
        self._inside = threading.local()
        self._lock = threading.Lock()

    @property
    def cost(self) -> int:
        """Verdicts and replayed steps."""
        return self.verdicts + self.replayed

    @property
    def seconds(self) -> float:
        """Processor time since the beginning, that of `without` left out."""
        return time.process_time() - self._begun - self._uncounted

    def spent(self) -> bool:
        """Return whether budget or limit are used up; remember which was first."""
        if not self.ended and self.running:
            self.ended = "budget" if self.cost >= self._budget else "limit" if self.seconds >= self._limit else ""
        return bool(self.ended)

    def watch_all(self, oracle: type, replayer: type) -> None:
        """Count what an oracle and a replayer are asked."""
        for method in ("verdicts", "plausible", "judge", "check"):  # the last two in older commits
            self.watch(oracle, method, _one_each)
        self.watch(replayer, "replay", _steps)

    def watch(self, kind: type, method: str, count: Callable[..., tuple[int, int]]) -> None:
        """Count all calls of a method, but not those that others that are watched make.

        Args:
            kind: class of the method; nothing is watched where it has none of this name, as in older commits.
            method: name of the method.
            count: returns verdicts and steps of a call, from its result and its arguments after `self`.
        """
        call = getattr(kind, method, None)
        if call is None:
            return

        @wraps(call)
        def counted(this: Any, *arguments: Any, **named: Any) -> Any:
            if not self.running or getattr(self._inside, "call", False):
                return call(this, *arguments, **named)
            if self.spent():
                raise _Spent
            self._inside.call = True
            try:
                result = call(this, *arguments, **named)
            finally:
                self._inside.call = False
            verdicts, steps = count(result, *arguments, **named)
            with self._lock:
                self.verdicts, self.replayed = self.verdicts + verdicts, self.replayed + steps
            return result

        setattr(kind, method, counted)

    def without(self, call: Callable[..., Any]) -> Callable[..., Any]:
        """Return a function that does not count, nor its time."""

        @wraps(call)
        def uncounted(*arguments: Any, **named: Any) -> Any:
            begun, self.running = time.process_time(), False
            try:
                return call(*arguments, **named)
            finally:
                self._uncounted += time.process_time() - begun
                self.running = True

        return uncounted


def _one_each(result: Any, *_: Any, **__: Any) -> tuple[int, int]:
    return len(result), 0


def _steps(result: Any, _: Any, history: Any = None, *__: Any, **___: Any) -> tuple[int, int]:
    """Count the steps of a replay up to and with the first state that does not come to rest."""
    rests = np.asarray(result.stands) == 1
    tried = len(rests) if rests.all() else int(rests.argmin()) + 1
    return 0, tried - (history is not None and tried > 0)


def search(case: Run) -> Run:
    """Search for one plan in this process, and return its figures.

    Args:
        case: `path`, `robots`, `criterion`, `perturbation`, `budget`, `limit` and `core`; `without` names rules to
            switch off, `probe` has those noted that take effect.
    """
    if hasattr(os, "sched_setaffinity"):
        os.sched_setaffinity(0, {case["core"]})
    from falsework import PlannerSettings, StabilityOracle, StabilitySettings, find_plans, load_structure
    from falsework.search import find
    from falsework.stability.contact.replay import Replayer

    switch_off(case.get("without", ""))
    acts = probe_all() if case.get("probe") else None
    stability = StabilitySettings(criterion=case["criterion"])
    if case["criterion"] == "contact":
        stability = getattr(find, "PLANS", stability)  # with a reserve; not in old commits
    known = "stability" in signature(find_plans).parameters

    def plan(structure: Assembly, **options: Any) -> Planning:
        how: dict[str, Any] = {"stability": stability} if known else {"oracle": StabilityOracle(structure, stability)}
        return find_plans(structure, forces=False, **how, **options)

    plan(load_structure("arch:blocks=5"))  # have everything compiled
    if acts is not None:
        acts.clear()
    assembly = load_structure(case["path"])
    perturbation = Perturbation.draw(case["perturbation"], assembly.part_count)
    if case["perturbation"]:
        assembly = perturbation.of(assembly)
    late: dict[str, Any] = {"bound_after": np.inf}
    if "bound_after" not in signature(PlannerSettings).parameters:  # in old commits
        vars(find)["_BOUND_AFTER"] = late.pop("bound_after")
    begun, planning = time.perf_counter(), None
    meter = Meter(case["budget"] * assembly.part_count, case["limit"])
    meter.watch_all(StabilityOracle, Replayer)
    vars(find)["plan_of"] = meter.without(find.prove_route)
    try:
        settings = PlannerSettings(seed=perturbation.seed, **late)
        planning = plan(assembly, robots=case["robots"], settings=settings, stop=meter.spent)
    except _Spent:  # before the search itself began
        pass
    result, plans = (planning.result, planning.plans) if planning is not None else (None, ())
    if result is not None and result.interrupted and not meter.ended:
        raise KeyboardInterrupt
    ended = "exhausted" if result is None or result.outcome != "proved_impossible" else "impossible"
    reserve = getattr(plans[0].claim, "reserve", 1.0) if plans else None
    keeps = getattr(planning, "accepted", True)  # not in old commits
    return {
        "parts": assembly.part_count,
        "seed": perturbation.seed,
        "ended": "found" if plans else meter.ended or ended,
        "reserve": reserve,
        "solved": reserve is not None and reserve >= getattr(stability, "reserve", 1.0) and keeps,
        "verdicts": meter.verdicts,
        "replayed": meter.replayed,
        "cost": meter.cost,
        "reached": 0 if result is None else result.reached,
        "steps": None if result is None else result.steps,
        "processor_seconds": meter.seconds,
        "seconds": time.perf_counter() - begun,
        "memory_gib": resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20,
        **({} if acts is None else {"acts": sorted(acts)}),
    }


def cases(options: Options) -> list[Run]:
    """Return the runs that are asked for, perturbation by perturbation, without their figures."""
    halves: dict[str, dict[str, tuple[int, ...]]] = {"tuned": TUNED, "held-out": HELD_OUT}
    half_of = {name: half for half, structures in halves.items() for name in structures}
    names = options.structures or tuple(half_of)
    return [
        {"structure": name, "half": half, "robots": robots, "criterion": criterion, "perturbation": number}
        for number in range(options.perturbations)
        for name in names
        if options.half in (None, half := half_of.get(name, "other"))
        for robots in options.robots or halves.get(half, {}).get(name, (2,))
        for criterion in options.criterion
        if not options.without or options.structures or (name, robots, criterion) not in LEFT_OUT
    ]


def key_of(run: Run) -> tuple[Any, ...]:
    """Return what tells a run from all others."""
    return tuple(run.get(name, "") if name == "without" else run[name] for name in _KEY)


def apart(case: Run, options: Options, core: int) -> Run:
    """Make one run in a process of its own, and return it with its figures.

    A process that fails, or takes too long by far, makes a run without a plan: `failed` or `killed`.
    """
    from states import find

    asked = {**case, "path": find(case["structure"]), "core": core, "probe": bool(options.without)}
    nothing = {"solved": False, "reserve": None, "verdicts": 0, "replayed": 0, "cost": 0, "processor_seconds": 0.0}
    command = [__file__, "--child", json.dumps(asked)]
    return {**case, **nothing, **printed_by(command, 5 * case["limit"] + _GRACE, options.source)}


def _cost(runs: Sequence[Run], share: float, *, each_part: bool) -> float | None:
    """Return the cost that a share of solved runs keep, of each part if asked for."""
    costs = [run["cost"] / (run["parts"] if each_part else 1) for run in runs]
    return float(np.quantile(costs, share)) if costs else None


def _ratio(costs: Sequence[float]) -> float:
    low, high = np.quantile(costs, [0.1, 0.9])
    return float(high / low)


def by_case(runs: Sequence[Run]) -> list[list[Run]]:
    """Return the perturbations of each case: structure, robots and criterion."""
    found: dict[tuple[Any, ...], list[Run]] = {}
    for run in runs:
        found.setdefault((run["structure"], run["robots"], run["criterion"]), []).append(run)
    return list(found.values())


def summary(runs: Sequence[Run], *, each_part: bool = False) -> Run:
    """Return the scores of some runs.

    Args:
        runs: of one case, or of several.
        each_part: give costs as multiples of the numbers of parts, as of structures of several sizes.
    """
    solved = [run for run in runs if run["solved"]]
    found = [run for run in runs if run["ended"] == "found"]
    groups = by_case(runs)
    good = [[run for run in group if run["solved"]] for group in groups]
    ranges = [_ratio([run["cost"] for run in some]) for some in good if len(some) > 1]
    mixed = [0 < len(some) < len(group) for some, group in zip(good, groups, strict=True)]
    ended = [run["ended"] for run in runs]
    costs = {"median": _cost(solved, 0.5, each_part=each_part), "ninety": _cost(solved, 0.9, each_part=each_part)}
    return {
        "runs": len(runs),
        "cases": len(groups),
        "solved": len(solved) / len(runs),
        "without_reserve": (len(found) - len(solved)) / len(runs),
        "cost": costs if solved else None,
        "verdicts": spread([run["verdicts"] for run in solved]) if solved else None,
        "replayed": spread([run["replayed"] for run in solved]) if solved else None,
        "spread": spread(ranges) if ranges else None,
        "mixed": sum(mixed) / len(groups),
        "processor_seconds": spread([run["processor_seconds"] for run in runs]),
        "processor_hours": sum(run["processor_seconds"] for run in runs) / 3600,
        "limited": ended.count("limit") / len(runs),
        "ended": {name: ended.count(name) for name in sorted(set(ended))},
    }


def report_all(runs: Sequence[Run], options: Options) -> None:
    """Report scores of each half and of both, under each criterion and both, and of each case."""
    common = {"budget": options.budget, "limit": options.limit, "source": runs[0]["source"]}
    common["seeds"] = range(options.perturbations)

    for half, halves in _sets([run["half"] for run in runs]):
        for criterion, criteria in _sets([run["criterion"] for run in runs]):
            some = [run for run in runs if run["half"] in halves and run["criterion"] in criteria]
            structures = len({run["structure"] for run in some})
            figures = summary(some, each_part=True)
            report("luck halves", half=half, criterion=criterion, structures=structures, **figures, **common)
    for some in by_case(runs):
        names = "structure", "half", "robots", "criterion"
        sizes = {run["parts"] for run in some if "parts" in run}
        shown = {name: some[0][name] for name in names} | {"parts": max(sizes, default=None)}
        report("luck cases", **shown, **summary(some), **common)


def compared(known: dict[tuple[Any, ...], Run], wanted: Sequence[Run], names: Sequence[str]) -> Iterator[Run]:
    """Yield the comparison of the search with each of some rules, or some at once, and that without it.

    Args:
        known: runs by their keys; those that are not there yet are left out.
        wanted: runs with all rules, with or without their figures.
        names: of what is switched off.
    """
    bases = [known[key_of(run)] for run in wanted if key_of(run) in known]
    for name in names:
        acting = {key_of(base): key_of({**base, "without": name}) for base in bases if acts_in(name, base)}
        there = [base for base in bases if key_of(base) not in acting or acting[key_of(base)] in known]
        for half, halves in _sets([base["half"] for base in there]):
            for criterion, criteria in _sets([base["criterion"] for base in there]):
                some = [base for base in there if base["half"] in halves and base["criterion"] in criteria]
                pairs = [(base, known[acting[key_of(base)]]) for base in some if key_of(base) in acting]
                yield {"without": name, "half": half, "criterion": criterion, **comparison(pairs, len(some))}


def _sets(names: Sequence[str]) -> Iterator[tuple[str, set[str]]]:
    """Yield each of some names, and `both` of two."""
    each = list(dict.fromkeys(names))
    yield from ((name, {name}) for name in each)
    if len(each) > 1:
        yield "both", set(each)


def table_of(rows: Sequence[Run]) -> str:
    """Write comparisons as the table of the published results."""
    from table_list import RULES, RULES_KEY
    from table_model import fill_in, markdown

    columns = (*RULES_KEY, *RULES)
    shown = [[write([row]) if callable(write) else fill_in(write, [row]) for _, write in columns] for row in rows]
    return markdown([head for head, _ in columns], shown)


def source_name(options: Options) -> str:
    """Return the name of the measured source tree: its commit, where none is given."""
    git = ["git", "-C", str(options.source), "rev-parse", "--short=7", "HEAD"]
    done = subprocess.run(git, capture_output=True, text=True, check=False)
    return options.source_name or done.stdout.strip() or os.environ.get("COMMIT", "unknown")


def make_all(
    asked: Sequence[Run], known: dict[tuple[Any, ...], Run], path: Path, options: Options, begun: float
) -> int:
    """Make the runs that are not known yet, and add them to those and to a file; return how many were not begun."""

    def note(run: Run) -> None:
        known[key_of(run)] = run
        append(path, run)
        case = f"{run['structure']} robots={run['robots']} {run['criterion']} {run['perturbation']}"
        case += f" without {run['without']}" if run["without"] else ""
        done = sum(key_of(one) in known for one in asked)
        print(f"{done}/{len(asked)} {case}: {run['ended']}, {run['processor_seconds']:.1f} s", file=sys.stderr)

    def make(case: Run, core: int) -> Run:
        return apart(case, options, core)

    until = None if options.minutes is None else begun + 60 * options.minutes
    return run_all([run for run in asked if key_of(run) not in known], make, note, options.processes, until=until)


def without_rules(known: dict[tuple[Any, ...], Run], wanted: Sequence[Run], names: Sequence[str]) -> list[Run]:
    """Return the runs to be made without rules where these take effect, the longest of a perturbation first."""
    ordered = sorted(wanted, key=lambda run: (run["perturbation"], -known[key_of(run)]["processor_seconds"]))
    return [{**run, "without": name} for run in ordered for name in names if acts_in(name, known[key_of(run)])]


def main(options: Options) -> None:
    """Make the runs that are not there yet, and report the scores once all are."""
    from states import find

    begun = time.perf_counter()
    try:
        names = each_of(options.without)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    effort = {"source": source_name(options), "budget": options.budget, "limit": options.limit, "without": ""}
    wanted = [{**case, **effort} for case in cases(options)]
    if not wanted:
        raise SystemExit("no runs are asked for; see --structures, --half and --perturbations")
    if options.table:
        rows = [rounded(row) for row in compared(read_runs(options.runs, key_of), wanted, names)]
        print(table_of([row for row in rows if row["half"] == rows[-1]["half"]]) if rows else "no runs of a rule yet")
        return
    missing = sorted({str(run["structure"]) for run in wanted} & _REAL)
    missing = [name for name in missing if find(name) == name]
    if missing:
        raise SystemExit(f"no {', '.join(missing)}: set FALSEWORK_DATA to the folder of assemblies/ and structures/")
    with kept(options.runs) as path:
        known = read_runs(path, key_of)
        new = any(key_of(run) not in known for run in wanted)
        first = {**wanted[0], "structure": "arch:blocks=5", "robots": 2, "perturbation": 1}
        for criterion in options.criterion if new else ():  # compiles, and fails at once where nothing can work
            tried = apart({**first, "criterion": criterion}, options, own_cores()[0])
            if tried["ended"] != "found":
                raise SystemExit(f"the arch of five blocks is not planned: {tried.get('error', tried['ended'])}")
        left = make_all(wanted, known, path, options, begun)
        left = left or make_all(without_rules(known, wanted, names), known, path, options, begun)
    if left:
        raise SystemExit(f"{left} runs were not begun; give --runs and the same command again to make them")
    write_to(options.out)
    if not names:
        report_all([known[key_of(run)] for run in wanted], options)
        return
    common = {"budget": options.budget, "limit": options.limit, "source": wanted[0]["source"]}
    rows = list(compared(known, wanted, names))
    for row in (row for row in rows if row["acts"] or row["half"] == rows[-1]["half"]):
        report("rules sweep", **row, **common, seeds=range(options.perturbations))


if __name__ == "__main__":
    chosen = tyro.cli(Options, description=__doc__)
    if chosen.child:
        print(json.dumps(search(json.loads(chosen.child))))
    else:
        main(chosen)
