"""Benchmark of luck: perturbations change nothing that matters, and scores are what their names say."""

from __future__ import annotations

import json
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from luck import HELD_OUT, TUNED, Meter, Options, Perturbation, apart, cases, key_of, summary
from runs import read_runs

from falsework import Assembly, StabilityOracle, StabilitySettings, load_structure


def test_number_0_is_the_structure_as_it_is_and_others_are_always_the_same() -> None:
    plain, one, same, other = (Perturbation.draw(number, 20) for number in (0, 1, 1, 2))
    assert (plain.seed, plain.angle) == (0, 0.0)
    assert plain.order.tolist() == list(range(20))
    assert (plain.weights == 1.0).all()
    assert (one.seed, one.angle) == (same.seed, same.angle)
    assert (one.order == same.order).all()
    assert (one.weights == same.weights).all()
    assert one.seed != other.seed
    assert (one.order != other.order).any()
    assert 0.0 < np.abs(one.weights - 1.0).max() <= 1.01e-12
    assert sorted(one.order.tolist()) == list(range(20))


@pytest.fixture(scope="module")
def plain() -> Assembly:
    return load_structure("dome:rings=2,blocks=6")


def test_a_perturbed_structure_has_the_same_parts_and_contacts(plain: Assembly) -> None:
    perturbation = Perturbation.draw(3, plain.part_count)
    found, order = perturbation.of(plain), perturbation.order
    assert found.names == tuple(plain.names[part] for part in order)
    assert (found.boundary == plain.boundary[order]).all()
    np.testing.assert_allclose(found.mass.mass, plain.mass.mass[order], rtol=1e-11)
    assert (found.density != plain.density[order]).any()
    np.testing.assert_allclose(found.mass.center[:, 2], plain.mass.center[order, 2], atol=1e-12)
    radius = [np.hypot(*one.mass.center[:, :2].T) for one in (found, plain)]
    np.testing.assert_allclose(radius[0], radius[1][order], atol=1e-12)
    assert np.abs(found.mass.center - plain.mass.center[order]).max() > 0.1  # it is turned
    pairs = {tuple(sorted(order[pair].tolist())) for pair in found.contacts.parts}
    assert pairs == {tuple(sorted(pair)) for pair in plain.contacts.parts.tolist()}
    assert len(found.contacts.points) == len(plain.contacts.points)


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_states_of_a_perturbed_structure_have_the_same_verdicts(plain: Assembly, criterion: Any) -> None:
    rng = np.random.default_rng(0)
    states = rng.choice(np.array([0, 1, 1, 1, 2], dtype=np.uint8), size=(60, plain.part_count))
    states[:, plain.boundary] = 2
    perturbation = Perturbation.draw(1, plain.part_count)
    settings = StabilitySettings(criterion=criterion)
    verdicts = StabilityOracle(plain, settings).verdicts(states).stable
    assert 0 < verdicts.sum() < len(verdicts)
    perturbed = StabilityOracle(perturbation.of(plain), settings)
    assert (perturbed.verdicts(states[:, perturbation.order]).stable == verdicts).all()


def test_half_of_the_structures_are_held_out() -> None:
    assert len(TUNED) == len(HELD_OUT) == 10
    assert not TUNED.keys() & HELD_OUT.keys()
    runs = cases(Options(half="held-out", perturbations=2, criterion=("contact",)))
    assert {run["structure"] for run in runs} == HELD_OUT.keys()
    assert len(runs) == 2 * sum(map(len, HELD_OUT.values()))
    other = cases(Options(structures=("vault-62", "arch"), robots=(4,), perturbations=1))
    assert [(run["structure"], run["half"], run["robots"]) for run in other] == [
        ("vault-62", "tuned", 4),
        ("vault-62", "tuned", 4),
        ("arch", "other", 4),
        ("arch", "other", 4),
    ]


def run_of(name: str, number: int, cost: int, ended: str = "found", **more: Any) -> dict[str, Any]:
    """Return a made-up run; it counts as solved if a plan was found, unless `more` says otherwise."""
    run = {"structure": name, "robots": 2, "criterion": "contact", "perturbation": number, "parts": 10, "cost": cost}
    run |= {"ended": ended, "solved": ended == "found", "verdicts": cost - 1, "replayed": 1, "processor_seconds": 36.0}
    return run | {"source": "here", "budget": 100.0, "limit": 30.0} | more


def test_scores_of_made_up_runs() -> None:
    steady = [run_of("a", number, 100) for number in range(5)]
    lucky = [run_of("b", number, cost) for number, cost in enumerate((100, 200, 300, 400))]
    lucky += [run_of("b", 4, 1000, "budget")]
    weak = [run_of("c", 0, 50, solved=False), *(run_of("c", number, 700, "limit") for number in range(1, 5))]
    one = summary(lucky)
    assert (one["runs"], one["cases"], one["solved"], one["mixed"]) == (5, 1, 0.8, 1.0)
    assert one["cost"] == {"median": 250.0, "ninety": pytest.approx(370.0)}
    assert one["spread"]["median"] == pytest.approx(370.0 / 130.0)
    found = summary([*steady, *lucky, *weak], each_part=True)
    assert (found["runs"], found["cases"], found["solved"]) == (15, 3, 0.6)
    assert found["without_reserve"] == pytest.approx(1 / 15)
    assert found["cost"] == {"median": 10.0, "ninety": pytest.approx(32.0)}
    assert found["spread"]["least"] == 1.0
    assert found["mixed"] == pytest.approx(1 / 3)
    assert found["limited"] == pytest.approx(4 / 15)
    assert found["ended"] == {"budget": 1, "found": 10, "limit": 4}
    assert found["processor_hours"] == pytest.approx(0.15)
    none = summary(weak)
    assert none["solved"] == 0.0
    assert none["cost"] is none["spread"] is None


def test_runs_are_read_again_up_to_one_that_was_cut_short(tmp_path: Path) -> None:
    path, runs = tmp_path / "runs.jsonl", [run_of("a", number, 100) for number in range(3)]
    assert read_runs(path, key_of) == read_runs(None, key_of) == {}
    lines = "\n".join(map(json.dumps, runs))
    path.write_text(lines[:-9], encoding="utf-8")
    assert read_runs(path, key_of) == {key_of(run): run for run in runs[:2]}


def test_a_meter_counts_outer_calls_only_and_ends_the_search() -> None:
    class Judge:
        def plausible(self, states: list[int]) -> list[int]:
            return self.verdicts(states)

        def verdicts(self, states: list[int]) -> list[int]:
            return states

        def replay(self, states: list[int], history: object = None) -> SimpleNamespace:
            return SimpleNamespace(stands=states)

    meter, judge = Meter(budget=10, limit=1e9), Judge()
    meter.watch_all(Judge, Judge)
    judge.plausible([1, 1, 1])
    assert (meter.verdicts, meter.replayed) == (3, 0)
    judge.replay([1, 1])
    judge.replay([1, -1, 0, 0], history=object())
    assert (meter.verdicts, meter.replayed, meter.cost) == (3, 3, 6)
    assert meter.without(judge.verdicts)([1] * 20) == [1] * 20
    assert meter.cost == 6
    judge.verdicts([1, 1, 1, 1])
    assert meter.spent()
    with pytest.raises(KeyboardInterrupt):
        judge.verdicts([1])
    assert (meter.cost, meter.ended) == (10, "budget")


@pytest.mark.parametrize(("budget", "ended"), [(100.0, "found"), (1.0, "budget")])
def test_a_search_ends_within_its_budget(budget: float, ended: str) -> None:
    case = {"structure": "arch:blocks=5", "robots": 2, "criterion": "contact", "perturbation": 1}
    run = apart({**case, "budget": budget, "limit": 30.0}, Options(), 0)
    assert run["ended"] == ended, run
    assert run["solved"] == (ended == "found")
    assert run["cost"] == run["verdicts"] + run["replayed"] > 0
    assert run["reserve"] == (1.1 if run["solved"] else None)
