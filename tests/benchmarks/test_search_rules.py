"""Rules of the search: each is noted where it takes effect, never once switched off, and compared pair by pair."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any
from zlib import crc32

import pytest
from luck import Options, apart, cases, compared, key_of, main, table_of
from search_rules import ALL, EACH, LEFT_OUT, RULES, acts_in, each_of, parts_of, probe_all, switch_off

from falsework import StabilityOracle, StabilitySettings, Task, load_structure
from falsework.assembly import States
from falsework.search import BeamSearch, BeamSettings, Oracle, SupportGuide
from falsework.search.beam import beam, failed_moves, nogoods
from falsework.search.problem import guide
from falsework.stability import Verdicts
from falsework.stability.cpu import solver
from falsework.stability.settings import EQUILIBRIUM

PATCHED = (
    *(beam, nogoods, solver),
    *(nogoods.Nogoods, guide.SupportGuide, failed_moves.FailedMoves, solver.CpuSolver),
)
"""Modules and classes that patches and probes change."""


@pytest.fixture(autouse=True)
def restored() -> Iterator[None]:
    """Undo patches and probes after each test."""
    before = [dict(vars(kind)) for kind in PATCHED]
    yield
    for kind, names in zip(PATCHED, before, strict=True):
        for name, value in names.items():
            if vars(kind)[name] is not value:
                setattr(kind, name, value)


class Chance(Oracle):
    """Oracle that finds a share of all states stable, by chance but always the same ones."""

    def __init__(self, share: float) -> None:
        self._most = share * 2**32

    def verdicts(self, states: States, *, near: States | None = None, require_certificate: bool = False) -> Verdicts:
        """See `Oracle`."""
        verdicts = Verdicts.all_undecided(len(states))
        verdicts.verdict[:] = [1 if crc32(state.tobytes()) < self._most else -1 for state in states]
        return verdicts


def dying_beam(name: str = "dome:rings=2,blocks=6") -> BeamSearch:
    """Return a beam that dies again and again."""
    assembly = load_structure(name)
    task = Task.from_rules(assembly.boundary, 3, contacts=assembly.contacts.parts)
    return BeamSearch(task, Chance(0.3), BeamSettings.from_width(), guide=SupportGuide(assembly))


def die() -> None:
    """Have a beam die, and jump back, some times: without rules it would never give up."""
    levels = iter(range(100))
    assert not dying_beam().run(4, stop=lambda: next(levels, None) is None).found


def begin(what: str, name: str) -> None:
    """Ask for a guide of a structure under `contact`."""
    assembly = load_structure(name)
    task = Task.from_rules(assembly.boundary, 2, contacts=assembly.contacts.parts)
    getattr(SupportGuide(assembly), what)(task.judged_by(StabilityOracle(assembly, StabilitySettings())))


def fall_again() -> None:
    """Have a beam with few states ahead die where parts are known to fall."""
    assembly, levels = load_structure("dome:rings=2,blocks=6"), iter(range(100))
    task = Task.from_rules(assembly.boundary, 3, contacts=assembly.contacts.parts)
    settings = BeamSettings.from_width(lookahead=2)
    BeamSearch(task, Chance(0.3), settings, guide=SupportGuide(assembly)).run(stop=lambda: next(levels, None) is None)


USES: dict[str, Callable[[], Any]] = {
    "edges": lambda: begin("edges_first", "vault:parts=120"),
    "beside-held": lambda: begin("held_neighbours", "dome:rings=2,blocks=6"),
    "hopeful": fall_again,
    "supports": lambda: solver.CpuSolver(StabilityOracle(load_structure("arch:blocks=5"), EQUILIBRIUM).problem),
}
"""Searches in which rules take effect; all others do in a beam that dies."""


@pytest.mark.parametrize("name", RULES)
def test_a_rule_takes_effect_until_it_is_switched_off(name: str) -> None:
    use = USES.get(name, die)
    acts = probe_all()
    use()
    assert name in acts
    switch_off(name)
    acts = probe_all()
    use()
    assert name not in acts


def test_all_rules_are_switched_off_at_once() -> None:
    switch_off(ALL)
    acts = probe_all()
    for use in {die, *USES.values()}:
        use()
    assert not acts


def test_probes_change_no_search() -> None:
    def ways() -> list[bytes]:
        found = dying_beam()
        result = found.run(4)
        return [found.states().tobytes(), result.deepest.tobytes(), bytes(str(result.counters), "ascii")]

    before = ways()
    assert probe_all() == set()
    assert ways() == before


def test_names_of_rules() -> None:
    assert parts_of("") == ()
    assert parts_of(ALL) == tuple(RULES)
    assert parts_of("refuted+jumps") == ("refuted", "jumps")
    assert each_of(["jumps", EACH, "refuted+jumps", ALL]) == [
        "jumps",
        *(name for name in RULES if name != "jumps"),
        "refuted+jumps",
        ALL,
    ]
    with pytest.raises(ValueError, match="no rule is called luck; there are edges, beside-held"):
        each_of(["luck"])
    assert acts_in("refuted+jumps", {"acts": ["jumps"]})
    assert not acts_in("refuted", {"acts": ["jumps"]})
    assert acts_in("refuted", {})


def run_of(name: str, number: int, cost: int, without: str = "", **more: Any) -> dict[str, Any]:
    """Return a made-up run that is solved, unless `more` says otherwise; with all rules, `refuted` takes effect."""
    run = {"structure": name, "half": "tuned", "robots": 2, "criterion": "contact", "perturbation": number}
    run |= {"source": "here", "budget": 50.0, "limit": 20.0, "without": without, "acts": [] if without else ["refuted"]}
    run |= {"ended": "found", "solved": True, "reserve": 1.1, "cost": cost, "verdicts": cost - 10, "replayed": 10}
    return run | {"processor_seconds": 1.0} | more


def test_a_rule_is_compared_with_the_same_searches() -> None:
    bases = [run_of("a", number, cost) for number, cost in enumerate((100, 110, 120))]
    bases += [
        run_of("b", 0, 210),
        run_of("b", 1, 210, solved=False, reserve=None, ended="budget"),
        run_of("c", 0, 50, acts=[]),
    ]
    others = [run_of("a", number, cost, "refuted") for number, cost in enumerate((200, 230, 300))]
    others[2] |= {"solved": False, "reserve": 1.0}
    others += [run_of("b", 0, 110, "refuted", processor_seconds=3.0), run_of("b", 1, 200, "refuted")]
    known = {key_of(run): run for run in (*bases, *others)}
    rows = list(compared(known, bases, ["refuted", "jumps"]))
    assert [(row["without"], row["half"], row["criterion"]) for row in rows] == [
        ("refuted", "tuned", "contact"),
        ("jumps", "tuned", "contact"),
    ]
    row, none = rows
    assert (row["runs"], row["acts"], row["cases"], row["both"]) == (6, 5, 2, 3)
    assert row["solved"] == {"with": 0.8, "without": 0.8}
    assert row["without_reserve"] == {"with": 0.0, "without": 0.2}
    assert (row["only_with"], row["only_without"]) == (1, 1)
    assert row["verdicts"] == {"median": pytest.approx((205 / 95 + 0.5) / 2), "least": 0.5, "most": 205 / 95}
    assert row["replayed"]["most"] == 1.0
    assert row["processor_seconds"]["most"] == 3.0
    assert row["all_processor_seconds"] == {"with": 5.0, "without": 7.0}
    assert row["lost"] == "a, 2 robots, contact: 3 to 2 of 3"
    assert row["gained"] == "b, 2 robots, contact: 1 to 2 of 2"
    assert (none["runs"], none["acts"], none["solved"], none["cost"]) == (6, 0, None, None)
    lines = table_of(rows).splitlines()
    assert lines[2].startswith("| refuted | contact | 5 of 6 | 80 | 80 | 1 | 1 | 0 | 20 |")
    assert lines[3].startswith("| jumps | contact | 0 of 6 | | | 0 | 0 |")
    del known[key_of(others[0])]
    assert next(compared(known, bases, ["refuted"]))["acts"] == 4  # what is not there yet is left out


def test_long_cases_are_left_out_of_sweeps_only() -> None:
    every = {(run["structure"], run["robots"], run["criterion"]) for run in cases(Options(perturbations=1))}
    swept = {
        (run["structure"], run["robots"], run["criterion"])
        for run in cases(Options(perturbations=1, without=("refuted",)))
    }
    assert every - swept == LEFT_OUT
    assert swept < every


def test_a_process_switches_a_rule_off() -> None:
    case = {"structure": "dome:rings=2,blocks=6", "robots": 2, "criterion": "contact", "perturbation": 1}
    case |= {"budget": 100.0, "limit": 30.0}
    base = apart({**case, "without": ""}, Options(without=("beside-held",)), 0)
    assert "beside-held" in base["acts"]
    run = apart({**case, "without": "beside-held"}, Options(without=("beside-held",)), 0)
    assert run["ended"] == "found", run
    assert "beside-held" not in run["acts"]
    assert run["without"] == "beside-held"


@pytest.mark.slow
def test_a_sweep_goes_on_and_makes_no_run_where_a_rule_takes_no_effect(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    runs = tmp_path / "runs.jsonl"
    asked = Options(
        runs=runs,
        structures=("arch:blocks=5",),
        robots=(2,),
        criterion=("contact",),
        perturbations=1,
        without=("beside-held", "refuted"),
    )
    main(asked)
    made = [json.loads(line) for line in runs.read_text(encoding="utf-8").splitlines()]
    assert [run["without"] for run in made] == ["", "beside-held"]
    assert [json.loads(line)["acts"] for line in capsys.readouterr().out.splitlines()] == [1, 0]
    main(replace(asked, table=True))
    assert len(runs.read_text(encoding="utf-8").splitlines()) == 2
    assert capsys.readouterr().out.splitlines()[2].startswith("| beside-held | contact | 1 of 1 | 100 | 100 |")
