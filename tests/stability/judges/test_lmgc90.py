"""LMGC90 as an independent judge: closed forms, agreement with discrete elements, and reasons for unjudged states."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from pathlib import Path
from typing import Any

import lmgc90
import numpy as np
import pytest
from lmgc90 import judge_by_lmgc90
from settling import settle

from falsework import load_structure
from falsework.assembly import complete_state, library
from falsework.errors import DependencyError, StateError
from falsework.geometry import TriangleMesh
from falsework.stability.judges.discrete_elements import DiscreteElementSettings

FALL = 0.5 * 9.81 * 0.3**2
"""Distance of a free fall in the time that LMGC90 computes, metres."""


@pytest.fixture
def installed() -> None:
    """Skips where LMGC90 is not installed."""
    pytest.importorskip("compas", reason="compas is not installed")
    pytest.importorskip("compas_lmgc90", reason="compas_lmgc90 is not installed: pip install --no-deps compas_lmgc90")


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("friction", [0.2, 0.7])
def test_a_block_slips_past_the_angle_of_friction(scenes: Any, friction: float) -> None:
    """Coulomb; past the angle it slides as far as its acceleration says."""
    angle = np.arctan(friction)
    (below,) = judge_by_lmgc90(scenes.slope(angle - 0.03, friction=friction), [1, 2])
    assert (below.answer, below.reason) == ("stands", "")
    (above,) = judge_by_lmgc90(scenes.slope(angle + 0.03, friction=friction), [1, 2])
    assert (above.answer, above.part) == ("falls", 0)
    slope = angle + 0.03
    assert above.moved == pytest.approx(FALL * (np.sin(slope) - friction * np.cos(slope)), rel=0.05)


@pytest.mark.usefixtures("installed")
def test_held_parts_carry_and_free_ones_fall(scenes: Any) -> None:
    """A block without support falls freely; on a held block, which stays where it is, it stands."""
    tower = scenes.tower(3)
    falling, standing, alone = judge_by_lmgc90(tower, [[0, 0, 1, 2], [0, 2, 1, 2], [0, 2, 0, 2]])
    assert (falling.answer, falling.part) == ("falls", 2)
    assert falling.moved == pytest.approx(FALL, rel=0.02)
    assert (standing.answer, standing.part) == ("stands", 2)
    assert (alone.answer, alone.moved, alone.part) == ("stands", 0.0, -1)


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("name", ["arch:blocks=9", "stack:blocks=3", "stack:blocks=3,overhang=1.1", "wall"])
def test_it_agrees_with_discrete_elements(name: str) -> None:
    """Two methods that share nothing, not even the contacts."""
    assembly = library.build(name)
    state = complete_state(assembly.boundary)
    (answer,) = judge_by_lmgc90(assembly, state)
    assert (
        answer.answer
        == {1: "stands", -1: "falls"}[int(settle(assembly, state, DiscreteElementSettings(stiffness=0.05)).stands[0])]
    )


@pytest.mark.usefixtures("installed")
def test_nothing_makes_two_walls_press_a_block(scenes: Any) -> None:
    """Forces in balance exist, and the block falls freely all the same."""
    (answer,) = judge_by_lmgc90(scenes.clamp(friction=0.55), [1, 2, 2])
    assert (answer.answer, answer.part) == ("falls", 0)
    assert answer.moved == pytest.approx(FALL, rel=0.02)


@pytest.mark.usefixtures("installed")
@pytest.mark.parametrize("name", ["cra-A", "cra-H"])
def test_published_counterexamples_slide(public_structure: Callable[[str], Path], name: str) -> None:
    """Models A and H of Kao et al. (2022) are in equilibrium on paper and fall freely."""
    assembly = load_structure(public_structure(name))
    (answer,) = judge_by_lmgc90(assembly, complete_state(assembly.boundary))
    assert (answer.answer, answer.part) == ("falls", 1)
    assert answer.moved == pytest.approx(FALL, rel=0.05)


@pytest.mark.usefixtures("installed")
def test_an_open_part_is_not_judged(scenes: Any) -> None:
    """The reason names the part; where the part is absent, the state is judged."""
    tower = scenes.tower(2)
    mesh = tower.meshes[1]
    opened = TriangleMesh.from_arrays(mesh.name, mesh.vertices, mesh.faces[:-1])
    broken = dataclasses.replace(tower, meshes=(tower.meshes[0], opened, tower.meshes[2]))
    both, one = judge_by_lmgc90(broken, [[1, 1, 2], [1, 0, 2]])
    assert (both.answer, both.part) == ("not judged", -1)
    assert both.reason == "part block-1 is not a closed polyhedron; repair its mesh"
    assert np.isnan(both.moved)
    assert one.answer == "stands"


@pytest.mark.usefixtures("installed")
def test_its_own_errors_are_reported(scenes: Any) -> None:
    """LMGC90 stops its process on plates with notches; this one goes on, and names the plate."""
    house = library.build("house")
    (answer,) = judge_by_lmgc90(house, complete_state(house.boundary))
    assert answer.answer == "not judged"
    assert answer.reason.startswith(f"LMGC90 stopped at part {house.names[0]}: Error")
    assert judge_by_lmgc90(scenes.tower(1), [1, 2])[0].answer == "stands"


@pytest.mark.usefixtures("installed")
def test_a_fall_with_a_missed_contact_is_not_judged(scenes: Any) -> None:
    """Blocks a centimetre apart that the assembly takes as touching, as its contacts come from closer ones."""
    tower = scenes.tower(2)
    lifted = TriangleMesh.from_arrays("block-1", tower.meshes[1].vertices + [0, 0, 0.01], tower.meshes[1].faces)
    apart = dataclasses.replace(tower, meshes=(tower.meshes[0], lifted, tower.meshes[2]))
    (answer,) = judge_by_lmgc90(apart, [1, 1, 2])
    assert (answer.answer, answer.part) == ("not judged", 1)
    assert answer.reason == "parts move, but LMGC90 missed the contact of parts block-0 and block-1"


def test_without_lmgc90_the_message_says_how_to_install_it(scenes: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(lmgc90, "find_spec", lambda name: None)
    with pytest.raises(DependencyError, match="pip install --no-deps compas_lmgc90"):
        judge_by_lmgc90(scenes.tower(1), [1, 2])


def test_states_are_checked(scenes: Any) -> None:
    with pytest.raises(StateError, match="boundary part 1 as 1"):
        judge_by_lmgc90(scenes.tower(1), [1, 1])
