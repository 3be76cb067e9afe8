"""Parts that fill a gap, cannot be let go of there, and are placed before those around them instead."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from falsework.assembly import load_structure
from falsework.search import Direction, Task
from falsework.search.beam.adaptive import AdaptiveBeam, AdaptiveSettings
from falsework.search.beam.frontier import Level
from falsework.search.find import task_of
from falsework.search.problem.guide import SupportGuide
from falsework.stability import Stability

_GAP, _BESIDE, _APART = 1, 2, 3


def _in_vain(states: Any, actions: Any, direction: Direction) -> Any:
    """Prefers the part beside the gap, then the one in it."""
    return np.tile([0.0, 2.0, 3.0, 1.0], 2)[None].repeat(len(states), axis=0)


@pytest.fixture
def beam(rules: Any) -> AdaptiveBeam:
    """A beam with one robot that cannot let go of a part once another is beside it, until a third is there."""
    oracle = rules.blocks(4)
    alone = oracle.stands

    def stands(state: tuple[int, ...]) -> bool:
        return alone(state) and not (state[_GAP] == 1 and state[_BESIDE] and not state[_APART])

    oracle.stands = stands
    task = Task.create(rules.ground(4), 1, contacts=np.array([(0, _GAP), (0, _BESIDE), (_GAP, _BESIDE)]))
    return AdaptiveBeam(task, oracle, AdaptiveSettings(gaps=True), guide=_in_vain)


def _die(beam: AdaptiveBeam) -> None:
    """Lay the part beside the gap, then hold the one in it."""
    search = beam.search
    for part, value in ((_BESIDE, 2), (_BESIDE, 1), (_GAP, 2)):
        assert search.step()
        level = search.levels[-1]
        row = int(np.flatnonzero(level.states[:, part] == value)[0])
        one = slice(row, row + 1)
        columns = level.states[one], level.parent[one], level.action[one], level.score[one], level.grounded[one]
        search.levels[-1] = Level(*columns)


def test_a_gap_is_filled_last_and_binds_a_robot(beam: AdaptiveBeam) -> None:
    assert beam.search.gaps() == {}
    _die(beam)
    assert beam.search.gaps() == {_GAP: 0}


def test_a_part_beside_a_held_one_fills_no_gap(rules: Any) -> None:
    """Two robots hold both parts: the chain may still close."""
    task = Task.create(rules.ground(4), 2, contacts=np.array([(1, 2), (2, 3)]))
    search = AdaptiveBeam(task, rules.arch(4), AdaptiveSettings(), guide=_in_vain).search
    assert search.step()
    assert search.step()
    assert search.levels[-1].states[0].tolist() == [2, 2, 2, 0]
    assert search.gaps() == {}


def test_taking_apart_knows_no_gaps(rules: Any) -> None:
    task = Task.create(rules.ground(3), 1, contacts=np.array([(1, 2)]))
    search = AdaptiveBeam(task, rules.blocks(3), AdaptiveSettings(Direction.DISASSEMBLY)).search
    search.step()
    assert search.gaps() == {}


def test_comes_back_and_places_nothing_around_the_gap_before_it_is_filled(beam: AdaptiveBeam) -> None:
    _die(beam)
    assert beam._widen(1)
    assert len(beam.search.levels) == 1
    assert beam.search.settings.early == (_GAP,)
    assert beam.search.step()
    first = beam.search.levels[-1].states
    assert not (first[:, _BESIDE] != 0).any()
    assert (first[:, _GAP] == 2).any()
    assert (first[:, _APART] == 2).any()
    assert not beam.search.exhaustive
    assert beam.run(1).found


def test_comes_back_once_for_each_gap(beam: AdaptiveBeam) -> None:
    _die(beam)
    assert beam._close_gaps()
    beam.search.rewind(0, beam.settings.beam())
    _die(beam)
    assert beam.search.gaps() == {_GAP: 0}
    assert not beam._close_gaps()


def test_a_saved_beam_remembers_its_gaps(beam: AdaptiveBeam) -> None:
    _die(beam)
    beam._widen(1)
    task = beam.search.task
    again = AdaptiveBeam.unpack(*beam.pack(), task, beam.search._judge.oracle, guide=_in_vain)
    assert again._gaps == [_GAP]
    assert again.search.settings == beam.search.settings


def test_closes_the_edges_of_a_flat_vault() -> None:
    """Its edge arches begin beside their springers at first, and the parts left out there slide in the end."""
    vault = load_structure("vault:parts=100,rise=0.6")
    task = task_of(vault, 3)
    guide = SupportGuide(vault).edges_first(task)
    assert AdaptiveBeam(task, Stability(vault), AdaptiveSettings(gaps=True), guide=guide).run(1, deaths=16).found
