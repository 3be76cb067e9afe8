"""House of slotted plates and self-locking shelf: volumes, joints, and what can leave which way."""

from __future__ import annotations

import math

import numpy as np
import pytest

from falsework import Assembly, Outcome, StabilityOracle, Task
from falsework.assembly import complete_state
from falsework.assembly.library import build, house, shelf
from falsework.errors import InputError
from falsework.search import ExhaustiveSearch


def parts_of(assembly: Assembly, kind: str) -> list[int]:
    return [part for part, name in enumerate(assembly.names) if name.startswith(f"{kind}-")]


def test_volume_of_a_house() -> None:
    length, width, height, thickness, pitch = 1.0, 0.8, 0.3, 0.05, 20.0
    assembly = house(2, length, width, height, thickness, pitch)
    out, across, slope = length / 2 + 0.075, width / 2 + 0.075, math.tan(math.radians(pitch))
    volume = assembly.mass.volume
    half_slot = thickness * thickness * height / 2
    wall, side = 2 * out * height * thickness, 2 * across * height * thickness
    # A slot of a gable reaches from the middle of the wall up to the roof above it.
    rise = slope * (out - length / 2)
    gable = wall + slope * out**2 * thickness - 2 * (half_slot + thickness * thickness * rise)
    expected = {
        "wall": [wall - 2 * half_slot] * 2 + [gable] * 2,
        "side": [side - 2 * half_slot] * 4,
        "floor": [2 * out * 2 * across * thickness],
        "roof": [out * 2 * across * thickness] * 2,
    }
    for kind, volumes in expected.items():
        np.testing.assert_allclose(volume[parts_of(assembly, kind)], volumes, rtol=1e-12, err_msg=kind)


def test_slots_open_upwards() -> None:
    """With the roof off, side walls leave upwards and nowhere else; front and back only after both of them."""
    assembly = house(storeys=1)
    state = complete_state(assembly.boundary)
    clear = assembly.clearance
    roofs, sides, walls = (parts_of(assembly, kind) for kind in ("roof", "side", "wall"))
    assert [*clear.can_leave(state[None])[0, [*roofs, *sides, *walls]]] == [True] * 2 + [False] * 4
    state[roofs] = 0
    assert clear.can_leave(state[None])[0, sides].all()
    assert not clear.can_leave(state[None])[0, walls].any()
    for side in sides:
        way = clear.exit_direction(state, side)
        assert way is not None
        np.testing.assert_allclose(way, (0, 0, 1), atol=0.06)
    state[sides[0]] = 0
    assert not clear.can_leave(state[None])[0, walls].any()
    state[sides[1]] = 0
    assert clear.can_leave(state[None])[0, walls].all()


@pytest.mark.parametrize("spec", ["house:storeys=1", "house"])
def test_a_house_comes_apart_along_clear_ways(spec: str) -> None:
    assembly = build(spec)
    task = Task.from_rules(assembly.boundary, 2, clearance=assembly.clearance, identity=assembly.identity)
    census = ExhaustiveSearch(task, StabilityOracle(assembly)).run()
    assert census.complete
    assert census.result.outcome is Outcome.FOUND
    assert 0 < census.solvable_states < census.states  # clear ways leave fewer orders, and dead ends


def test_volume_of_a_shelf() -> None:
    """Tongue and groove, tenons and slots fill each other: parts and loose boards add up to what is outlined."""
    shelves, width, depth, gap, thickness = 2, 0.6, 0.36, 0.2, 0.03
    assembly = shelf(shelves, width, depth, gap, thickness)
    total = (shelves + 1) * gap + (shelves + 1) * thickness
    uprights = 2 * 2 * thickness * depth * total
    inside = (shelves + 1) * width * depth * thickness
    assert assembly.mass.volume[~assembly.boundary].sum() == pytest.approx(uprights + inside, rel=1e-12)


@pytest.mark.parametrize("shelves", [0, 1, 3])
def test_the_last_parts_of_a_shelf_lock_each_other(shelves: int) -> None:
    """One part at a time there is no plan with clear ways, by exhaustion, and there is one if ways do not matter."""
    assembly = shelf(shelves)
    oracle = StabilityOracle(assembly)
    for robots in (1, 2, 4):
        task = Task.from_rules(assembly.boundary, robots, clearance=assembly.clearance, identity=assembly.identity)
        census = ExhaustiveSearch(task, oracle).run()
        assert census.complete
        assert census.result.outcome is Outcome.PROVED_IMPOSSIBLE
        assert census.solvable_states == 0
        present = (census.graph.states > 0).sum(axis=1)
        locked = census.graph.states[present.argmin()]
        left = set(np.flatnonzero(locked).tolist()) - set(np.flatnonzero(assembly.boundary).tolist())
        assert left == {*parts_of(assembly, "upright"), *parts_of(assembly, "top")}
    free = Task.from_rules(assembly.boundary, 2, identity=assembly.identity)
    assert ExhaustiveSearch(free, oracle).run().result.outcome is Outcome.FOUND


def test_locked_together_and_free_as_a_pair() -> None:
    """Contacts stop each of the four from every first move, and both halves of the top from none straight up."""
    assembly = shelf(shelves=0)
    contacts = assembly.contacts
    top = set(parts_of(assembly, "top"))

    def normals_into(group: set[int]) -> np.ndarray:
        """Directions in which something outside the group is in its way."""
        rows = []
        for (a, b), normal in zip(contacts.parts.tolist(), contacts.normals, strict=True):
            if (a in group) != (b in group):
                rows.append(normal if a in group else -normal)
        return np.array(rows)

    for part in (*top, *parts_of(assembly, "upright")):
        against = normals_into({part})
        for axis in np.vstack([np.eye(3), -np.eye(3)]):
            assert (against @ axis).max() > 0.99, (assembly.names[part], axis)
    assert (normals_into(top) @ (0, 0, 1)).max() <= 1e-9


@pytest.mark.parametrize(
    ("spec", "message"),
    [
        ("house:storeys=0", "house: storeys is 0; give a whole number from 1 to 20"),
        ("house:pitch=40", "house: pitch is 40; give a number from 1 to 25 degrees"),
        ("house:width=0.1,thickness=0.05", "house: walls of 0.05 m leave no room inside; make them thinner"),
        ("shelf:gap=0", "shelf: gap is 0; give a number from 0.01 to 10 m"),
    ],
)
def test_bad_parameters(spec: str, message: str) -> None:
    with pytest.raises(InputError) as caught:
        build(spec)
    assert message in str(caught.value)
