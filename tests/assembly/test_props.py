"""Props: where they stand, what they carry, and that they change nothing while they are not there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, load_structure
from falsework.assembly import prop_places, with_props
from falsework.assembly.assembly_model import Prop
from falsework.assembly.props import keep_props
from falsework.errors import AssemblyError
from falsework.geometry import TriangleMesh
from falsework.stability.settings import EQUILIBRIUM
from falsework.stability.verdict import Criterion


def box(name: str, low: tuple[float, float, float], high: tuple[float, float, float]) -> TriangleMesh:
    corners = np.array([[x, y, z] for x in (0, 1) for y in (0, 1) for z in (0, 1)])
    faces = [
        (0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1),
        (2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3),
    ]  # fmt: skip
    return TriangleMesh.from_arrays(name, np.where(corners, high, low), faces)


@pytest.fixture
def overhang() -> Assembly:
    """A wall on the ground, and a plank on it that reaches out 3 m of its 4."""
    wall = box("wall", (0, 0, 0), (1, 1, 2))
    plank = box("plank", (0, 0, 2), (4, 1, 2.2))
    return Assembly.from_meshes([wall, plank], boundary=[], ground=True, name="overhang")


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
def test_a_prop_carries_an_overhang(overhang: Assembly, criterion: Criterion) -> None:
    """Without it the plank tips; with it half of its weight goes down the prop, from which the wall is as far."""
    propped = with_props(overhang, [Prop(1, (3.5, 0.5, 2.0), 0.0)])
    assert propped.names[-1] == "prop-plank"
    assert propped.immovable.tolist() == [False, False, True, True]
    oracle = StabilityOracle(propped, replace(EQUILIBRIUM, criterion=criterion, cone=None))
    verdicts = oracle.verdicts([[1, 1, 2, 0], [1, 1, 2, 2], [1, 0, 2, 0]], require_certificate=True)
    assert verdicts.verdict.tolist() == [-1, 1, 1]
    bare = StabilityOracle(overhang, oracle.settings).verdicts([[1, 1, 2], [1, 0, 2]], require_certificate=True)
    assert bare.verdict.tolist() == [-1, 1]


def test_no_robot_bears_what_a_prop_does(overhang: Assembly) -> None:
    propped = with_props(overhang, [Prop(1, (3.5, 0.5, 2.0), 0.0)])
    one, other = StabilityOracle(propped).margins([[1, 1, 2, 2], [2, 1, 2, 2]], ("held",))
    assert one.stands
    assert one.held == ()
    assert [load.part for load in other.held] == [0]


def test_a_prop_pushes_and_does_not_pull(overhang: Assembly) -> None:
    """Under the light end of a plank whose heavy end hangs over, it does nothing."""
    wall = box("wall", (3, 0, 0), (4, 1, 2))
    plank = box("plank", (2.4, 0, 2), (9, 1, 2.2))
    tips = Assembly.from_meshes([wall, plank], boundary=[], ground=True, name="tips")
    propped = with_props(tips, [Prop(1, (2.7, 0.5, 2.0), 0.0)])
    assert StabilityOracle(propped).verdicts([1, 1, 2, 2], require_certificate=True).unstable[0]


def test_places(overhang: Assembly) -> None:
    """One under each part with a floor below: the plank has one near its middle, the wall stands on the ground."""
    (place,) = prop_places(overhang)
    assert place.part == 1
    assert place.at == pytest.approx((2.0, 0.5, 2.0))
    assert place.floor == pytest.approx(0.0)
    propped = with_props(overhang, [place])
    assert propped.mass.volume[-1] == pytest.approx(2.0 * propped.contacts.areas.min(), rel=1e-6)
    assert propped.identity != overhang.identity
    assert keep_props(propped, []).identity == overhang.identity


def test_some_of_the_props() -> None:
    dome = load_structure("dome")
    places = prop_places(dome)
    everywhere = with_props(dome, places)
    assert keep_props(everywhere, [1, 3]).identity == with_props(dome, [places[1], places[3]]).identity
    assert len(everywhere.contacts) == len(dome.contacts) + len(places)
    assert (np.diff(everywhere.contacts.parts @ [10_000, 1]) >= 0).all()


@pytest.mark.parametrize(
    ("prop", "message"),
    [
        (Prop(9, (3.5, 0.5, 2.0), 0.0), "a prop stands under part 9, but parts are numbered 0 to 2"),
        (Prop(2, (3.5, 0.5, 0.0), 0.0), "a prop stands under part ground, which is fixed"),
        (Prop(1, (8.0, 0.5, 2.0), 0.0), "the prop under part plank is not below it"),
        (Prop(1, (0.5, 0.5, 2.0), 0.0), "the prop under part plank has no floor under it"),
        (Prop(1, (3.5, 0.5, 1.0), 0.0), "the prop under part plank ends off its lower side"),
        (Prop(0, (0.5, 0.5, 0.0), 0.0), "the prop under part wall has no"),
    ],
)
def test_bad_props(overhang: Assembly, prop: Prop, message: str) -> None:
    with pytest.raises(AssemblyError, match=message) as error:
        with_props(overhang, [prop])
    assert "\n" not in str(error.value)


def test_no_floor() -> None:
    with pytest.raises(
        AssemblyError, match=r"no part has a place for a prop: a prop stands upright on a fixed part.*--ground"
    ):
        prop_places(load_structure("vault"))


def test_a_steep_lower_side_has_no_place() -> None:
    """Of an arch the stones near the springers lean too much; with more friction it is no different."""
    arch = load_structure("arch:blocks=9").with_ground()
    with_place = {prop.part for prop in prop_places(arch)}
    assert 0 < len(with_place) < 9
    assert with_place == {prop.part for prop in prop_places(arch.replace(friction=0.9))}
