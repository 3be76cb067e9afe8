"""Structures that rest on edges and corners: statics by hand, and the exact solver as a reference."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, Verdict
from falsework.assembly import ContactWarning
from falsework.geometry import TriangleMesh
from falsework.stability import ExactSolver
from falsework.stability.settings import EQUILIBRIUM

ROOF = [(0, 1, 2), (3, 5, 4), (0, 3, 4), (0, 4, 1), (1, 4, 5), (1, 5, 2), (2, 5, 3), (2, 3, 0)]


def ridge(x: float, top: float = 1.0, name: str = "ridge", upwards: float = 1.0) -> TriangleMesh:
    """Roof along y from 0 to 1 with its ridge at x, `top`; hanging with the ridge below if `upwards` is -1."""
    low, y0, y1 = top - upwards, (0.0, 1.0)[upwards < 0], (1.0, 0.0)[upwards < 0]
    ends = [(x - 0.5, low), (x + 0.5, low), (x, top)]
    return TriangleMesh.from_arrays(name, [(p, y, z) for y in (y0, y1) for p, z in ends], ROOF)


def spike(x: float, y: float, height: float = 0.5, name: str = "spike") -> TriangleMesh:
    """Pyramid on z = 0 with its tip at `height`."""
    base = [(x - 0.1, y - 0.1, 0), (x + 0.1, y - 0.1, 0), (x + 0.1, y + 0.1, 0), (x - 0.1, y + 0.1, 0)]
    faces = [(2, 1, 0), (3, 2, 0), (0, 1, 4), (1, 2, 4), (2, 3, 4), (3, 0, 4)]
    return TriangleMesh.from_arrays(name, [*base, (x, y, height)], faces)


def verdict(parts: list[TriangleMesh], boundary: list[int], **options: Any) -> Verdict:
    """Verdict of the complete structure, on which the exact solver agrees."""
    with pytest.warns(ContactWarning):
        assembly = Assembly.from_meshes(parts, boundary=boundary, **options)
    state = np.where(assembly.boundary, 2, 1)
    found = StabilityOracle(assembly, EQUILIBRIUM).verdicts(state, require_certificate=True)
    exact = ExactSolver(assembly).check(state)
    assert int(found.verdict[0]) == int(exact.verdict[0]) != Verdict.UNDECIDED
    return Verdict(int(found.verdict[0]))


@pytest.mark.parametrize(("end", "stands"), [(3.2, True), (5.5, True), (5.9, False)])
def test_a_beam_on_a_block_and_a_ridge(scenes: Any, end: float, stands: bool) -> None:
    """It tips over the ridge once its middle is past it: from 0.15 to 5.85 the middle is at 3."""
    left = scenes.box((0, 0, 0), (0.2, 1, 1))
    beam = scenes.box((0.15, 0.4, 1), (end, 0.6, 1.1), "beam")
    expected = Verdict.STABLE if stands else Verdict.UNSTABLE
    assert verdict([left, ridge(3.0), beam], [0, 1]) == expected


def test_a_beam_on_one_ridge_balances_over_its_middle_alone(scenes: Any) -> None:
    for shift, expected in ((0.0, Verdict.STABLE), (0.01, Verdict.UNSTABLE)):
        beam = scenes.box((2 + shift, 0.2, 1), (4 + shift, 0.8, 1.1), "beam")
        assert verdict([ridge(3.0), beam], [0]) == expected


@pytest.mark.parametrize(("friction", "stands"), [(0.55, True), (0.1, False)])
def test_a_box_on_its_edge_between_two_supports(scenes: Any, friction: float, stands: bool) -> None:
    """A cube on its edge, 20 degrees off balance, leans on walls: edge on the floor, edge on the wall.

    With the wall at height h and the weight at arm d, the wall pushes `W d / h`; the floor must rub as much, and the
    wall may help by `mu` of its push: the cube slips if `mu` is small.
    """
    turn = scenes.about_y(np.radians(25.0))
    cube = scenes.box((-1, 0, 0), (0, 1, 1), "cube", turn)
    lowest = cube.vertices[:, 2].min()
    cube = TriangleMesh.from_arrays("cube", cube.vertices - (0, 0, lowest), cube.faces)
    left, right = cube.vertices[:, 0].min(), cube.vertices[:, 0].max()
    floor = scenes.box((left - 1, -1, -1), (right + 1, 2, 0), "floor")
    walls = [
        scenes.box((left - 1, -1, 0), (left, 2, 3), "left"),
        scenes.box((right, -1, 0), (right + 1, 2, 3), "right"),
    ]
    expected = Verdict.STABLE if stands else Verdict.UNSTABLE
    assert verdict([floor, *walls, cube], [0, 1, 2], friction=friction) == expected
    assert verdict([floor, cube], [0], friction=friction) == Verdict.UNSTABLE, "without walls it falls over"


def test_a_plate_falls_off_one_tip_and_stands_on_three(scenes: Any) -> None:
    plate = scenes.box((-1, -1, 0.5), (1, 1, 0.6), "plate")
    tips = [spike(-0.5, -0.5, name="a"), spike(0.6, -0.4, name="b"), spike(0.0, 0.7, name="c")]
    assert verdict([tips[0], plate], [0]) == Verdict.UNSTABLE
    assert verdict([*tips[:2], plate], [0, 1]) == Verdict.UNSTABLE
    assert verdict([*tips, plate], [0, 1, 2]) == Verdict.STABLE


def test_a_top_on_its_tip_is_unstable_off_balance(scenes: Any) -> None:
    points = spike(0, 0).vertices * (1, -1, -1) + (0, 0, 0.5)
    points[:4, 0] += 0.05
    top = TriangleMesh.from_arrays("top", points, spike(0, 0).faces)
    assert verdict([scenes.box((-1, -1, -1), (1, 1, 0)), top], [0]) == Verdict.UNSTABLE


def test_a_beam_with_a_keel_on_two_ridges(scenes: Any) -> None:
    """The keel crosses both ridges at a point each, and rolls about the line through both if its middle is aside."""
    keel = ridge(0.0, 1.0, "keel", upwards=-1.0)
    # Along x from 0 to 4, on ridges along y at x = 1 and 3.
    points = keel.vertices[:, [1, 0, 2]] * (4, -1, 1) + (0, 0.5, 0)
    keel = TriangleMesh.from_arrays("keel", points, keel.faces)
    assert keel.volume > 0
    ridges = [ridge(1.0, name="near"), ridge(3.0, name="far")]
    with pytest.warns(ContactWarning) as seen:
        assembly = Assembly.from_meshes([*ridges, keel], boundary=[0, 1])
    assert str(seen[0].message) == "parts near and keel touch at a point only: verdicts may depend on it"
    assert assembly.contacts.points == pytest.approx(np.array([(1, 0.5, 1), (3, 0.5, 1)]))
    assert verdict([*ridges, keel], [0, 1]) == Verdict.STABLE, "its middle is over the line through both"
    lean = keel.vertices + np.where(keel.vertices[:, 2:] > 1.5, (0, 0.02, 0), 0)
    aside = TriangleMesh.from_arrays("keel", lean, keel.faces)
    assert verdict([*ridges, aside], [0, 1]) == Verdict.UNSTABLE, "with its top aside it rolls"


def test_every_pair_that_touches_narrowly_is_warned_of(scenes: Any) -> None:
    tips = [spike(x, y, name=f"tip-{x}{y}") for x in (-0.5, 0.5) for y in (-0.5, 0.0, 0.5)]
    plate = scenes.box((-1, -1, 0.5), (1, 1, 0.6), "plate")
    with pytest.warns(ContactWarning) as seen:
        assembly = Assembly.from_meshes([*tips, plate], boundary=range(6))
    assert len(assembly.warnings) == 6
    assert [str(one.message) for one in seen][:3] == list(assembly.warnings[:3])
    assert (
        str(seen[3].message) == "3 more pairs of parts touch along lines, on strips or at points only, or carry nothing"
    )
    assert len(seen) == 4
    fixed = assembly.replace(boundary=range(7))
    assert fixed.warnings == (), "nothing hangs on contacts between boundary parts"


@pytest.mark.parametrize("width", [2e-5, 1e-4, 3e-4])
@pytest.mark.parametrize("aside", [0.0, 0.3])
def test_a_beam_rests_on_strips_along_the_rims_of_its_supports(scenes: Any, width: float, aside: float) -> None:
    supports = [scenes.box((-1.5, -0.5, -0.5), (-0.5, 0.5, 0)), scenes.box((0.5, -0.5, -0.5), (1.5, 0.5, 0))]
    at = aside * width
    beam = scenes.box((at - 0.5 - width, -0.25, 0), (at + 0.5 + width, 0.25, 0.2))
    assert verdict([*supports, beam], [0, 1]) == Verdict.STABLE
    assert verdict([supports[0], beam], [0]) == Verdict.UNSTABLE
