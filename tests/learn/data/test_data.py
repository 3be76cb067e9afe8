"""Data sets: nothing to test on is in what is learned from, and files are what they say."""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

torch = pytest.importorskip("torch", reason="torch is not installed: pip install 'falsework[learn]'")

from falsework import StabilityOracle, StabilitySettings, StateGraph, load_structure, train  # noqa: E402
from falsework.cli.main import main  # noqa: E402
from falsework.errors import InputError  # noqa: E402
from falsework.learn import TrainSettings  # noqa: E402
from falsework.learn.data.dataset import (  # noqa: E402
    FORMAT,
    Dataset,
    DataSettings,
    build_dataset,
    load_dataset,
    save_dataset,
    training_task,
)
from falsework.search.device.oracle import HostOracle  # noqa: E402
from falsework.utils.archive import read_archive, write_archive  # noqa: E402


@pytest.fixture(scope="module")
def arch() -> Any:
    return load_structure("arch:blocks=8")


@pytest.fixture(scope="module")
def data(arch: Any) -> Dataset:
    return build_dataset(arch, training_task(arch, 2), DataSettings(6, 12, (24, 24)), device="cpu")


def test_sets_share_nothing_and_all_their_states_come_apart(arch: Any, data: Dataset) -> None:
    sets = (data.train, data.test, data.validation, data.more)
    everything = np.concatenate(sets)
    assert min(len(states) for states in sets) > 10
    assert len(np.unique(everything, axis=0)) == len(everything)
    assert StabilityOracle(arch).verdicts(everything).stable.all()
    graph = StateGraph.from_states(data.task, everything)
    assert graph.solvable.all()
    assert sum(sum(counts) for counts in data.levels().values()) == len(everything)


def test_the_test_set_is_what_a_wider_search_finds_beyond(arch: Any, data: Dataset) -> None:
    alone = build_dataset(arch, data.task, DataSettings(12, 1, seed=1), device="cpu").train
    beyond = {bytes(row) for row in alone} - {bytes(row) for row in data.train}
    assert beyond == {bytes(row) for row in data.test}


def test_equal_widths_run_side_by_side(arch: Any, data: Dataset) -> None:
    assert list(data.seconds)[-2:] == ["width 12, seed 2", "2 of width 24, seed 3"]
    apart = build_dataset(arch, data.task, DataSettings(6, 12, (24, 25, 24)), device="cpu")
    assert list(apart.seconds)[-3:] == ["width 24, seed 3", "width 25, seed 4", "width 24, seed 5"]


def test_same_seed_same_data(arch: Any, data: Dataset) -> None:
    again = build_dataset(arch, data.task, data.settings, device="cpu")
    other = build_dataset(arch, data.task, DataSettings(6, 12, seed=7), device="cpu")
    assert np.array_equal(again.train, data.train)
    assert np.array_equal(again.more, data.more)
    assert not np.array_equal(other.train, data.train)


def test_a_file_names_its_criterion(arch: Any, data: Dataset, tmp_path: Path) -> None:
    """One from before there was a choice is of equilibrium."""
    assert data.criterion == "contact"
    path = tmp_path / "data.npz"
    save_dataset(data, path)
    header, arrays = read_archive(path, FORMAT)
    assert header.pop("criterion") == "contact"
    write_archive(path, header.pop("format"), header, arrays)
    assert load_dataset(path, arch).criterion == "equilibrium"
    settings = TrainSettings(steps=1, criterion="equilibrium")
    with pytest.raises(InputError, match="criterion contact, and the run is of equilibrium"):
        train(arch, settings, folder=None, device="cpu", logs=(), dataset=data)


def test_saved_and_loaded(arch: Any, data: Dataset, tmp_path: Path) -> None:
    save_dataset(data, tmp_path / "data.npz")
    again = load_dataset(tmp_path / "data.npz", arch)
    for name in ("train", "test", "validation", "more"):
        assert np.array_equal(getattr(again, name), getattr(data, name))
    assert again.task.to_dict() == data.task.to_dict()
    with pytest.raises(InputError, match="of arch:blocks=8, not of arch:blocks=9"):
        load_dataset(tmp_path / "data.npz", load_structure("arch:blocks=9"))
    with pytest.raises(InputError, match="there is no file"):
        load_dataset(tmp_path / "none.npz", arch)
    (tmp_path / "bad.npz").write_bytes((tmp_path / "data.npz").read_bytes()[:200])
    with pytest.raises(InputError, match="damaged"):
        load_dataset(tmp_path / "bad.npz", arch)


@pytest.mark.parametrize(
    ("entry", "value"),
    [
        ("train_width", "wide"),
        ("test_width", None),
        ("robots", 2.0),
        ("fixed", [[1]]),
        ("fixed", 3),
        ("removable_only_if_clear", "no"),
        ("name", ["arch"]),
        ("criterion", []),
        ("identity", 7),
    ],
)
def test_wrong_headers(arch: Any, data: Dataset, tmp_path: Path, entry: str, value: Any) -> None:
    path = tmp_path / "data.npz"
    save_dataset(data, path)
    header, arrays = read_archive(path, FORMAT)
    form = header.pop("format")
    write_archive(path, form, header | {entry: value}, arrays)
    with pytest.raises(InputError, match=rf"data\.npz is damaged.* {entry}") as caught:
        load_dataset(path, arch)
    assert "\n" not in str(caught.value)
    for name in arrays:
        write_archive(path, form, header, {**arrays, name: np.array("text")})
        if name != "boundary":
            with pytest.raises(InputError, match=rf"data\.npz is damaged \({name}"):
                load_dataset(path, arch)


@pytest.mark.parametrize("wrong", [{"train_width": 0}, {"widths": (64, 0)}, {"seed": -1}])
def test_settings_that_make_no_sense_are_refused(wrong: dict[str, Any]) -> None:
    with pytest.raises(InputError, match=r"give at least 1|not negative"):
        DataSettings(**wrong)


def test_the_command_counts_states_by_level(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], read_answer: Callable[[str], dict[str, Any]]
) -> None:
    out = tmp_path / "data.npz"
    words = ["graph", "arch:blocks=6", "--sets", "4,8", "--device", "cpu"]
    assert main([*words, "--out", str(out), "--json"]) == 0
    record = read_answer(capsys.readouterr().out)
    assert record["sets"]["train"] == sum(record["levels"]["train"]) > 10
    assert record["sets"]["test"] == sum(record["levels"]["test"])
    assert len(record["levels"]["train"]) == 13  # six blocks, two steps each, both ends counted
    assert record["levels"]["train"][0] == record["levels"]["train"][-1] == 1
    assert load_dataset(out, load_structure("arch:blocks=6")).test.shape == (record["sets"]["test"], 8)


def test_the_deadline_saves_what_was_found(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], read_answer: Callable[[str], dict[str, Any]]
) -> None:
    out = str(tmp_path / "data.npz")
    words = ["graph", "arch:blocks=6", "--device", "cpu", "--out", out, "--sets", "64,128,4,4"]
    assert main([*words, "--deadline", "1e-6", "--json"]) == 1
    captured = capsys.readouterr()
    assert "the deadline ended the search; what was found so far is saved" in captured.err
    record = read_answer(captured.out)
    assert record["outcome"] == "incomplete"
    assert record["sets"]["train"] >= 1
    assert len(load_dataset(out, load_structure("arch:blocks=6")).train) == record["sets"]["train"]
    assert main([*words, "--deadline", "0"]) == 2
    assert "leaves no time" in capsys.readouterr().err


def test_the_command_refuses_what_it_cannot_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = str(tmp_path / "data.npz")
    assert main(["graph", "arch:blocks=6", "--sets", "64,128", "--out", str(tmp_path / "nowhere" / "data.npz")]) == 2
    assert "make it first" in capsys.readouterr().err
    assert main(["graph", "arch:blocks=6", "--sets", "64,128", "--robots", "0", "--out", out]) == 2
    assert "give at least 1" in capsys.readouterr().err
    # One robot cannot build an arch: the search from the empty structure never reaches the complete one.
    assert main(["graph", "arch:blocks=6", "--sets", "64,128", "--robots", "1", "--out", out, "--device", "cpu"]) == 1
    assert "not every search reached the complete structure" in capsys.readouterr().err
    if not torch.cuda.is_available():
        assert main(["graph", "arch:blocks=6", "--sets", "64,128", "--device", "cuda", "--out", out]) == 2
        assert "CUDA devices were found" in capsys.readouterr().err


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("--sets", "64"), "--sets 64: give the widths of two searches or more, such as 64,128"),
        (("--sets", "64,wide"), "--sets 64,wide: give the widths"),
        (("--sets", "64,128", "--width", "32", "--missing", "2"), "leave out --missing and --width, or --sets"),
    ],
)
def test_sets_come_from_whole_searches(
    options: tuple[str, ...], message: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["graph", "arch:blocks=6", *options, "--out", str(tmp_path / "data.npz")]) == 2
    assert message in capsys.readouterr().err


def test_a_real_structure_has_as_many_states_as_in_the_paper(shared_assembly: Callable[[str], Path]) -> None:
    """Table 3 of the paper: 1,077 and 1,159."""
    assembly = load_structure(str(shared_assembly("bottle-12")))
    oracle = HostOracle(StabilityOracle(assembly, StabilitySettings(criterion="equilibrium")))
    data = build_dataset(assembly, training_task(assembly, 2), oracle=oracle, device="cpu")
    assert data.criterion == "equilibrium"
    assert 950 < len(data.train) < 1250
    assert 950 < len(data.test) < 1350
