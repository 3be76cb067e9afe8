"""The state graph: all edges, exact counts, and files that can be trusted."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from falsework import StateGraph, Task
from falsework.errors import InputError
from falsework.search import BeamSearch, BeamSettings, ExhaustiveSearch
from falsework.search.problem.state_graph import FORMAT, load_state_graph, save_state_graph
from falsework.utils.archive import read_archive, write_archive


@pytest.fixture
def graph(rules: Any) -> StateGraph:
    oracle, _ = rules.random(4, 8)
    search = BeamSearch(Task.from_rules(rules.ground(8), 2, identity="abc"), oracle, BeamSettings(width=12))
    search.run()
    return StateGraph.from_states(search.task, search.states(), name="eight")


@pytest.mark.parametrize("seed", range(20))
def test_holds_every_edge_between_its_states_and_no_other(rules: Any, seed: int) -> None:
    oracle, clearance = rules.random(seed, 7)
    task = Task.from_rules(rules.ground(7), 1 + seed % 3, clearance=clearance if seed % 2 else None)
    enumeration = rules.enumeration(task, oracle)
    everything = sorted(enumeration.reachable())
    rng = np.random.default_rng(seed)
    chosen = [everything[row] for row in rng.permutation(len(everything))[: max(2, len(everything) // 2)]]
    graph = StateGraph.from_states(task, np.array(chosen + chosen[:3], dtype=np.uint8))
    assert sorted(map(tuple, graph.states.tolist())) == sorted(set(chosen))
    states = [tuple(state) for state in graph.states.tolist()]
    edges = {
        (states[a], int(action), states[b])
        for a, action, b in zip(graph.source, graph.action, graph.target, strict=True)
    }
    expected = {
        (state, action, after) for state in chosen for action, after in enumeration.moves(state) if after in set(chosen)
    }
    assert edges == expected
    assert len(graph.source) == len(edges)
    mask = graph.valid_actions()
    assert mask.sum() == len(edges)
    assert (np.diff(graph.level) >= 0).all()


@pytest.mark.parametrize("seed", range(20))
def test_counts_and_reachability(rules: Any, seed: int) -> None:
    oracle, _ = rules.random(seed, 6)
    task = Task.from_rules(rules.ground(6), 2)
    graph = ExhaustiveSearch(task, oracle).run().graph
    counts = graph.routes_to_target()
    for row, state in enumerate(graph.states):
        rest = Task.from_rules(rules.ground(6), 2, start=state)
        assert counts[row] == rules.enumeration(rest, oracle).count()
    assert np.array_equal(graph.solvable, counts > 0)
    assert graph.reachable.all()


def test_random_routes_are_routes(graph: StateGraph) -> None:
    if not graph.count_routes():
        pytest.fail("the graph of this test must hold a plan")
    rng = np.random.default_rng(0)
    for _ in range(20):
        route = graph.sample_route(rng)
        assert route is not None
        assert (graph.index.find(route.states) >= 0).all()
        assert np.array_equal(route.states[0], graph.task.start)
        assert np.array_equal(route.states[-1], graph.task.target)


def test_unseen_states(graph: StateGraph) -> None:
    half = graph.states[::2]
    unseen = graph.unseen(half)
    assert np.array_equal(unseen, np.arange(len(graph)) % 2 == 1)


def test_comes_back_from_disk(graph: StateGraph, tmp_path: Path) -> None:
    path = tmp_path / "graph.npz"
    save_state_graph(graph, path)
    loaded = load_state_graph(path)
    for name in ("states", "source", "action", "target"):
        assert np.array_equal(getattr(loaded, name), getattr(graph, name))
    assert loaded.task.to_dict() == graph.task.to_dict()
    assert (loaded.name, loaded.removable_only_if_clear) == ("eight", False)
    assert loaded.count_routes() == graph.count_routes()
    assert [entry.name for entry in tmp_path.iterdir()] == ["graph.npz"]
    with np.load(path, allow_pickle=False) as data:  # nothing in it needs pickle
        assert all(data[name].dtype != object for name in data.files)


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_a_file_names_its_criterion(graph: StateGraph, tmp_path: Path, criterion: str) -> None:
    """One from before there was a choice is of equilibrium."""
    task = replace(graph.task, holds_keep_stable=criterion == "equilibrium")
    path = tmp_path / "graph.npz"
    save_state_graph(StateGraph.from_states(task, graph.states), path)
    loaded = load_state_graph(path)
    assert loaded.criterion == criterion
    assert loaded.task.holds_keep_stable == task.holds_keep_stable
    header, arrays = read_archive(path, FORMAT)
    assert header.pop("criterion") == criterion
    write_archive(path, header.pop("format"), header, arrays)
    assert load_state_graph(path).criterion == "equilibrium"


def damaged(name: str, change: Any) -> Any:
    return pytest.param(name, change, id=name)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda h, a: h.update(format="falsework.graph/2"), "has format 'falsework.graph/2'"),
        (lambda h, a: h.update(extra=1), "unexpected or absent header entries extra"),
        (lambda h, a: h.pop("robots"), "robots"),
        (lambda h, a: a.update(more=np.zeros(1)), "unexpected or absent entries more"),
        (lambda h, a: a.pop("action"), "action"),
        (lambda h, a: a.update(states=a["states"][:, :-1]), "states are not 0, 1, 2 for 8 parts"),
        (lambda h, a: a.update(states=a["states"][::-1]), "out of order"),
        (lambda h, a: a["target"].__setitem__(0, 10**6), "edges point outside"),
        (lambda h, a: a["source"].__setitem__(0, -1), "edges point outside"),
        (lambda h, a: a.update(action=a["action"][:-1]), "different lengths"),
        (lambda h, a: a["action"].__setitem__(0, (a["action"][0] + 1) % 8), "an edge"),
        (lambda h, a: a["target"].__setitem__(0, 0), "an edge is not a legal action"),
        (lambda h, a: h.update(robots=1), "break the rules"),
        (lambda h, a: h.update(robots="two"), "damaged"),
        (lambda h, a: h.update(fixed=[99]), "does not exist"),
        (lambda h, a: h.update(criterion="good"), "its criterion is 'good'"),
        (lambda h, a: h.update(missing="abc"), "its header entry missing is 'abc'"),
        (lambda h, a: h.update(name=[1]), "its header entry name is"),
        (lambda h, a: h.update(postponed=[3]), "postponed parts have another form"),
        (lambda h, a: a.update(boundary=a["boundary"][None]), "boundary or postponed parts have another form"),
        (lambda h, a: a.update(boundary=a["boundary"].astype("U5")), "boundary or postponed parts have another form"),
        (lambda h, a: a.update(start_state=np.array("abc")), "states must be numbers"),
        (lambda h, a: a.update(source=np.array(3, np.int32)), "edges are not a list of numbers"),
        (lambda h, a: a.update(source=a["source"][None]), "edges are not a list of numbers"),
        (lambda h, a: a.update(target=a["target"].astype(complex)), "different lengths"),
    ],
)
def test_rejects_what_it_does_not_know(graph: StateGraph, tmp_path: Path, change: Any, message: str) -> None:
    path = tmp_path / "graph.npz"
    save_state_graph(graph, path)
    header, arrays = read_archive(path, FORMAT)
    change(header, arrays)
    form = header.pop("format")
    write_archive(path, form, header, arrays)
    with pytest.raises(InputError, match=message) as caught:
        load_state_graph(path)
    assert "\n" not in str(caught.value)


def test_rejects_pickles_and_fragments(graph: StateGraph, tmp_path: Path) -> None:
    path = tmp_path / "graph.npz"
    save_state_graph(graph, path)
    data = path.read_bytes()
    for keep in range(0, len(data), max(len(data) // 20, 1)):
        path.write_bytes(data[:keep])
        with pytest.raises(InputError, match="damaged or not"):
            load_state_graph(path)
    np.savez(path, header=np.array([{"a": 1}], dtype=object))
    with pytest.raises(InputError, match="damaged or not"):
        load_state_graph(path)
    with pytest.raises(InputError, match="there is no file"):
        load_state_graph(tmp_path / "other.npz")
    with pytest.raises(InputError, match="cannot write"):
        save_state_graph(graph, tmp_path / "no" / "graph.npz")
