"""`falsework plan --robots auto` and `--deadline`."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest

from falsework import StabilityOracle, load_structure
from falsework.search import BeamSearch
from falsework.search.plans.plan_check import validate_plan
from falsework.search.plans.plan_file import load_plan
from falsework.search.problem.state_graph import load_state_graph

Run = Callable[..., Any]


def test_fewest_robots_of_an_arch(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    finished = falsework("plan", "arch:blocks=7", "--robots", "auto", "--out", out, "--json")
    assert finished.code == 0, finished.error
    record = finished.answer["fewest"]
    assert (record["robots"], record["least"], record["proven"]) == (2, 2, True)
    assert record["barrier"]["robots"] == 1
    assert finished.answer["files"] == [str(out)]
    plan = load_plan(out)
    assert plan.robots == 2
    assert validate_plan(plan, load_structure("arch:blocks=7")).good
    people = falsework("plan", "arch:blocks=7", "--robots", "auto", "--out", out)
    assert people.code == 0
    assert people.out.startswith("2 robots: a plan was found; proven to be the fewest")
    assert "with 1: no plan exists" in people.out


def test_plan_with_the_fewest_robots(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    finished = falsework("plan", "arch:blocks=5", "--robots", "auto", "--out", out)
    assert finished.code == 0, finished.error
    assert load_plan(out).robots == 2
    assert f"{out}: 10 steps with 2 robots, every state proven stable as built" in finished.out


@pytest.mark.parametrize("command", [("plan", "--robots", "auto"), ("plan",)])
@pytest.mark.parametrize("deadline", ["0", "-3"])
def test_no_time(falsework: Run, command: tuple[str, ...], deadline: str, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    finished = falsework(*command, "arch:blocks=5", "--deadline", deadline, "--out", out)
    assert finished.code == 2
    assert finished.error.count("\n") == 1
    assert "leaves no time" in finished.error


@pytest.mark.parametrize("options", [("--alternatives", 2), ("--resume",)])
def test_auto_takes_neither_alternatives_nor_resume(falsework: Run, options: tuple[Any, ...], tmp_path: Path) -> None:
    finished = falsework("plan", "arch:blocks=5", "--robots", "auto", *options, "--out", tmp_path / "plan.json")
    assert finished.code == 2
    assert "--robots auto takes no --" in finished.error


def test_no_number_of_robots(falsework: Run, tmp_path: Path) -> None:
    """The last parts of the shelf interlock, so that no robot gets them out."""
    out = tmp_path / "plan.json"
    words = ("plan", "shelf", "--robots", "auto", "--removable-only-if-clear", "--out", out, "--json")
    finished = falsework(*words)
    assert finished.code == 1
    record = finished.answer["fewest"]
    assert record["robots"] is None
    assert record["impossible"].endswith("cannot leave without a collision")
    assert (finished.answer["outcome"], finished.answer["verdicts"]) == ("impossible", 0)
    assert finished.error.count("\n") == 1
    assert "no number of robots suffices" in finished.error


@pytest.mark.parametrize(
    ("friction", "deadline", "code", "told"),
    [
        (0.45, 30, 0, "2 robots: a plan was found; proven to be the fewest"),
        (0.32, 4, 1, "no plan was found; at least 2 robots"),
    ],
)
def test_a_structure_that_slides_from_rest_is_not_said_to_be_impossible(
    falsework: Run, tmp_path: Path, friction: float, deadline: int, code: int, told: str
) -> None:
    """That it slides with all loads at once is no proof that it cannot be built."""
    structure, out = ("vault:parts=30", "--friction", friction), tmp_path / "plan.json"
    finished = falsework("plan", *structure, "--robots", "auto", "--deadline", deadline, "--out", out)
    assert finished.code == code
    assert told in finished.out + finished.error
    assert "suffices" not in finished.error


@pytest.mark.parametrize("words", [("graph",), ("train",), ("plan", "--search-from", "end")])
def test_commands_that_judge_from_rest_say_who_asks_how_it_is_built(
    falsework: Run, tmp_path: Path, words: tuple[str, ...]
) -> None:
    if words == ("train",):
        pytest.importorskip("torch")
    finished = falsework(words[0], "vault:parts=30", "--friction", 0.45, *words[1:], "--out", tmp_path / "out.npz")
    assert finished.code == 1
    assert "the complete structure slides from rest, all that counts here" in finished.error
    assert "falsework plan --search-from beginning tells" in finished.error
    assert not (tmp_path / "out.npz").exists()


@pytest.mark.parametrize("options", [("--reserve", 1), ("--criterion", "equilibrium")])
def test_without_a_reserve_one_oracle_answers_all(
    falsework: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, options: tuple[str | int, ...]
) -> None:
    """The search knows what was found of the ends before it began."""
    begin, made = StabilityOracle.__init__, list[StabilityOracle]()

    def noted(oracle: StabilityOracle, *given: Any) -> None:
        made.append(oracle)
        begin(oracle, *given)

    monkeypatch.setattr(StabilityOracle, "__init__", noted)
    assert falsework("plan", "arch:blocks=5", *options, "--out", tmp_path / "plan.json").code == 0
    assert len(made) == 1


def test_the_deadline_leaves_a_search_to_resume(falsework: Run, tmp_path: Path) -> None:
    out = tmp_path / "plan.json"
    finished = falsework("plan", "vault", "--deadline", "0.05", "--out", out, "--json")
    assert finished.code == 1
    record = finished.answer
    assert (record["files"], record["outcome"]) == ([], "not_found")
    assert record["interrupted"] is True
    assert 0 <= record["reached"] < record["steps"]
    assert "the deadline ended the search" in finished.error
    assert "--resume" in finished.error
    assert finished.error.count("\n") == 1
    assert [path.name for path in tmp_path.iterdir()] == ["plan.json.search"]


def test_the_deadline_of_a_graph_saves_what_was_found(
    falsework: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    out = tmp_path / "graph.npz"
    finished = falsework("graph", "vault", "--deadline", "0.05", "--device", "cpu", "--out", out, "--json")
    assert finished.code == 1
    record = finished.answer
    assert record["interrupted"] is True
    assert record["outcome"] == "incomplete"
    assert len(load_state_graph(out)) == record["states"]
    assert "the deadline ended the search at step" in finished.error
    assert falsework("graph", "vault", "--deadline", "0", "--out", out).code == 2
    monkeypatch.setenv("WORLD_SIZE", "2")
    refused = falsework("graph", "vault", "--deadline", "5", "--out", out)
    assert refused.code == 2
    assert "leave --deadline out" in refused.error


def test_an_interruption_prints_the_best_so_far(
    falsework: Run, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def interrupted(search: BeamSearch) -> bool:
        raise KeyboardInterrupt

    monkeypatch.setattr(BeamSearch, "step", interrupted)
    finished = falsework("plan", "arch:blocks=5", "--robots", "auto", "--out", tmp_path / "plan.json", "--json")
    assert finished.code == 130
    assert finished.answer["outcome"] == "interrupted"
    assert finished.answer["fewest"]["least"] == 2
    assert "at least 2 robots are needed" in finished.error
    assert "interrupted" in finished.error
