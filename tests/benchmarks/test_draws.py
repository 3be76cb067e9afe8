"""Draws of searches: what is learned from and what is tested on share no state, and distances are Hamming distances."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

import draws  # noqa: E402
import learning  # noqa: E402

from falsework import StabilityOracle, StabilitySettings, load_structure  # noqa: E402
from falsework.learn.data.symmetry import symmetries  # noqa: E402
from falsework.learn.data.symmetry_augmentation import symmetric_images  # noqa: E402
from falsework.search.device.oracle import tensor_oracle  # noqa: E402


def rows(states: Any) -> set[bytes]:
    return {state.tobytes() for state in states}


@pytest.fixture
def searches(tmp_path: Path) -> Any:
    """Narrow searches of a symmetric arch."""
    device = torch.device("cpu")
    assembly = load_structure("arch:blocks=9")
    oracle = tensor_oracle(StabilityOracle(assembly, StabilitySettings(criterion="equilibrium")), device)
    return draws.Searches(assembly, 2, False, oracle, device, tmp_path, train_width=4, test_width=8)


def test_nothing_is_learned_from_test_states(searches: Any) -> None:
    draw = searches.draw(1, draws.test_seeds(1), (8, 8))
    tested, data = np.concatenate(list(draw.tests.values())), draw.dataset
    assert list(draw.tests) == [10, 1, 11, 21, 31]
    assert draw.pairing == 10
    assert rows(tested) == rows(data.test)
    assert not rows(tested) & rows(data.train)
    assert not rows(data.validation) & (rows(data.train) | rows(data.test))
    assert not rows(data.more) & (rows(data.train) | rows(data.test) | rows(data.validation))
    assert len(data.more)
    known = draws.learned_from(searches.assembly, draw)
    held_out = np.concatenate([data.test, data.validation])
    images = rows(symmetric_images(held_out, symmetries(searches.assembly)))
    assert len(images) > len(held_out)
    assert rows(known) == (rows(data.train) | rows(data.more)) - images


def test_searches_are_kept(searches: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    for width, seed in searches.all_seeds((0,)):
        searches.states(width, seed)
    kept = searches.draw(0, draws.test_seeds(0))

    def search(*_: Any, **__: Any) -> Any:
        raise AssertionError("searched again")

    monkeypatch.setattr(draws, "search_states", search)
    again = searches.draw(0, draws.test_seeds(0))
    assert rows(again.dataset.train) == rows(kept.dataset.train)
    assert all(rows(again.tests[seed]) == rows(states) for seed, states in kept.tests.items())


def test_distances_are_those_to_the_nearest() -> None:
    generator = np.random.default_rng(0)
    states, others = (generator.integers(0, 3, (count, 11), dtype=np.uint8) for count in (20, 30))
    found = draws.distances(states, others, torch.device("cpu"), rows=7)
    assert found.tolist() == (states[:, None] != others[None]).sum(axis=2).min(axis=1).tolist()
    success = generator.random(20) < 0.5
    table = draws.by_distance(found, success)
    assert sum(count for count, _ in table.values()) == 20
    for far, (count, share) in table.items():
        assert share == pytest.approx(success[found == int(far)].mean(), abs=1e-4)
        assert count == (found == int(far)).sum()


def test_finished_runs_are_recognised(tmp_path: Path) -> None:
    out = tmp_path / "records.jsonl"
    about = {"structure": "bottle-12", "robots": 2, "seeds": [0], "tests": [1]}
    assert not learning.finished(None, about)
    assert not learning.finished(out, about)
    out.write_text(json.dumps({**about, "success": 1.0}) + "\n")
    assert learning.finished(out, about)
    assert not learning.finished(out, {**about, "tests": [11]})
