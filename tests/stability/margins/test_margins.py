"""Margins against closed forms; each bound is proven on both sides by the certificate checker."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

import falsework as fw
from falsework import StabilityOracle, StabilitySettings, load_structure, verify_certificates
from falsework.assembly import Joints, Loads, complete_state
from falsework.errors import InputError
from falsework.stability import StateMargins
from falsework.stability.contact.history import History
from falsework.stability.margins.contact_prober import ContactProber
from falsework.stability.margins.state_margins import Bound

CRITERIA = (StabilitySettings(), StabilitySettings(criterion="equilibrium", cone="quadratic"))
WITHIN = 0.011
"""Brackets span 1 % at most."""


def margins(assembly: Any, settings: StabilitySettings, *kinds: Any, state: Any = None) -> StateMargins:
    """Margins of one state, by default the complete structure, with both ends of every bound checked."""
    state = complete_state(assembly.boundary) if state is None else np.array(state, np.uint8)
    (found,) = StabilityOracle(assembly, settings).margins(state, kinds or None)
    for bound in (found.friction, found.tilt, found.horizontal, found.load_factor, found.push):
        if bound is not None:
            prove(assembly, settings, state, bound)
    return found


def prove(assembly: Any, settings: StabilitySettings, state: Any, bound: Bound) -> None:
    """Both proofs hold for the structure under the conditions of the bound, which lie within 1 % of each other."""
    inside = bound.inside_condition.applied_to(assembly)
    assert bound.inside_proof.stable[0]
    assert verify_certificates(inside, state[None], bound.inside_proof, settings.claim)[0]
    if bound.outside is not None and bound.value is not None:
        assert bound.outside_condition is not None
        assert bound.outside_proof is not None
        assert not bound.outside_proof.stable[0]
        assert verify_certificates(
            bound.outside_condition.applied_to(assembly), state[None], bound.outside_proof, settings.claim
        )[0]
        assert abs(bound.outside - bound.value) <= WITHIN * abs(bound.value)
    assert bound.proven


def near(bound: Bound | None, expected: float) -> bool:
    assert bound is not None
    assert bound.value is not None
    return abs(bound.value - expected) <= WITHIN * abs(expected) + 1e-4


@pytest.mark.parametrize("settings", CRITERIA, ids=lambda settings: settings.criterion)
@pytest.mark.parametrize("slope", [0.1, 0.3])
def test_a_block_on_a_slope(scenes: Any, settings: StabilitySettings, slope: float) -> None:
    """It needs friction tan a, and bears a tilt of atan mu less the slope and a push downhill of the friction left."""
    block = scenes.slope(slope, friction=0.5)
    found = margins(block, settings)
    weight = 9.81 * block.mass.mass[0]
    assert near(found.friction, np.tan(slope))
    assert near(found.tilt, np.arctan(0.5) - slope)
    assert near(found.push, weight * (0.5 * np.cos(slope) - np.sin(slope)))
    assert found.load_factor is not None
    assert found.load_factor.value is None  # friction grows with the weight
    angle = np.arctan(0.5) - slope
    # A horizontal acceleration and the weight together are a weight on a tilted ground, but for its size.
    assert near(found.horizontal, np.tan(angle))


@pytest.mark.parametrize("settings", CRITERIA, ids=lambda settings: settings.criterion)
def test_friction_of_joints_decreases_in_proportion(scenes: Any, settings: StabilitySettings) -> None:
    """A block on a slope whose joint has half of the structure's friction needs twice tan a of the structure."""
    block = scenes.slope(0.2, friction=1.0)
    glued = block.replace(joints=Joints.from_arrays(block.contacts, friction=0.5))
    found = margins(glued, settings, "friction", "tilt")
    assert near(found.friction, 2 * np.tan(0.2))
    assert near(found.tilt, np.arctan(0.5) - 0.2)
    alone = scenes.slope(0.2, friction=0.0)
    alone = alone.replace(joints=Joints.from_arrays(alone.contacts, friction=0.5))
    assert margins(alone, settings, "friction").friction is None  # no coefficient to compare with


@pytest.mark.parametrize("settings", CRITERIA, ids=lambda settings: settings.criterion)
def test_two_blocks(scenes: Any, settings: StabilitySettings) -> None:
    """Two unit cubes tip as one: at a tilt of atan(1/2), and pushed at 3/2 m by two thirds of a cube's weight."""
    tower = scenes.tower(2, friction=0.9)
    found = margins(tower, settings)
    assert found.friction is not None
    assert found.friction.value == 0.0
    assert near(found.tilt, np.arctan(0.5))
    assert near(found.horizontal, 0.5)
    assert near(found.push, 2 / 3 * 9.81 * tower.mass.mass[0])
    assert found.push is not None
    assert found.push.part == 1


def test_an_overhang_bears_so_much_more_weight(scenes: Any) -> None:
    """A block that reaches 0.4 m past the edge of a cube of 1 m and 2.5 times its weight can get heavier until it tips.

    Its own middle stays over the cube, so its weight alone has no bound, but with a load at its end it has one.
    """
    cube, slab = scenes.box([0, 0, 0], [1, 1, 1], "cube"), scenes.box([0.4, 0, 1], [1.4, 1, 1.2], "slab")
    ground = scenes.box([-1, -1, -1], [2, 2, 0], "ground")
    plain = scenes.make([cube, slab, ground], [2], friction=0.6)
    weight = 9.81 * plain.mass.mass[1]
    wrench = np.zeros((3, 6))
    wrench[1, 2], wrench[1, 4] = -0.05 * weight, 0.05 * weight * 0.4  # 0.4 m from the middle, outwards
    loaded = plain.replace(loads=Loads.from_arrays(3, wrench=wrench))
    for settings in CRITERIA:
        assert margins(plain, settings, "load_factor").load_factor.value is None  # type: ignore[union-attr]
        (found,) = StabilityOracle(loaded, settings).margins([[1, 1, 2]], ("load_factor",))
        assert found.stands
    # The middle of the slab lies 0.1 m inside the edge: a load at 0.3 m outside it may be a third of the weight.
    for share, stands in ((0.33, True), (0.34, False)):
        wrench = np.zeros((3, 6))
        wrench[1, 2], wrench[1, 4] = -share * weight, share * weight * 0.4
        heavy = plain.replace(loads=Loads.from_arrays(3, wrench=wrench))
        assert StabilityOracle(heavy).margins([[1, 1, 2]], ("friction",))[0].stands == stands


def test_an_arch_of_least_thickness_has_no_margin() -> None:
    """Milankovitch: a semicircular arch stands from a thickness of 0.1075 radii on; there any load breaks it."""
    thin = load_structure("arch:blocks=31,thickness=0.12", friction=2.0)
    thick = load_structure("arch:blocks=31,thickness=0.25", friction=2.0)
    settings = StabilitySettings(criterion="equilibrium", cone="quadratic")
    found = [margins(arch, settings, "horizontal").horizontal for arch in (thin, thick)]
    shares = [bound.value for bound in found if bound is not None and bound.value is not None]
    assert 0 < shares[0] < 0.05 < shares[1]


@pytest.mark.parametrize("settings", CRITERIA, ids=lambda settings: settings.criterion)
def test_a_state_that_does_not_stand(scenes: Any, settings: StabilitySettings) -> None:
    """It has no margins, but the friction that it would need."""
    found = margins(scenes.slope(0.5, friction=0.4), settings)
    assert not found.stands
    assert near(found.friction, np.tan(0.5))
    record = found.to_dict(("block", "slab"))
    assert record["tilt_deg"] == record["push_n"] == record["horizontal_g"] == 0.0


@pytest.mark.parametrize("friction", [0.4, 0.6], ids=["falls", "stands"])
def test_margins_that_were_not_requested_are_absent(scenes: Any, friction: float) -> None:
    """Null is left to mean that there is no bound."""
    slope = scenes.slope(0.5, friction=friction)
    tilt, factor = (margins(slope, CRITERIA[0], kind).to_dict(("block", "slab")) for kind in ("tilt", "load_factor"))
    about = {"stands", "proven", "monotone"}
    assert set(tilt) == about | {"tilt_deg"}
    assert set(factor) == about | {"load_factor", "total_load_factor", "load_part"}
    assert (factor["load_factor"] is None) == (friction == 0.6)


def test_a_robot_bears_what_its_part_weighs_and_what_leans_on_it(scenes: Any) -> None:
    tower = scenes.tower(2)
    weight = 9.81 * tower.mass.mass[0]
    (alone,) = margins(tower, CRITERIA[0], "held", state=[2, 0, 2]).held
    (under,) = margins(tower, CRITERIA[0], "held", state=[2, 1, 2]).held
    np.testing.assert_allclose(alone.force, [0, 0, weight], atol=1e-9 * weight)
    np.testing.assert_allclose(under.force, [0, 0, 2 * weight], atol=1e-3 * weight)
    assert under.moment_nm < 1e-3 * weight


def test_margins_of_a_plan_are_those_under_its_gravity(scenes: Any) -> None:
    tower, pushes = scenes.tower(2), []
    for gravity in (9.81, 1.62):
        plan = fw.find_plans(tower, robots=1, stability=StabilitySettings(gravity=gravity)).plans[0]
        pushes.append(fw.margins(tower, plan, ["push"])[-1].push)
    assert pushes[1].value == pytest.approx(1.62 / 9.81 * pushes[0].value, rel=1e-2)


def test_a_held_block_carries_a_moment(scenes: Any) -> None:
    """A cube on the end of a held beam turns it by its weight times its arm."""
    beam, cube = scenes.box([0, 0, 0], [3, 1, 0.5], "beam"), scenes.box([2, 0, 0.5], [3, 1, 1.5], "cube")
    assembly = scenes.make([beam, cube, scenes.box([0, 0, -1], [1, 1, 0], "ground")], [2])
    (held,) = margins(assembly, CRITERIA[0], "held", state=[2, 1, 2]).held
    np.testing.assert_allclose(held.moment_nm, 9.81 * assembly.mass.mass[1] * 1.0, rtol=1e-3)


def test_the_polygon_of_a_slope(scenes: Any) -> None:
    """Downhill a block bears least, uphill most, and across it what the circle of friction leaves."""
    (found,) = StabilityOracle(scenes.slope(0.2, friction=0.5)).margins([[1, 2]], ("polygon", "tilt"))
    assert found.polygon is not None
    assert found.tilt is not None
    limit = np.arctan(0.5)
    downhill = limit - 0.2
    assert np.degrees(found.polygon.min()) == pytest.approx(np.degrees(downhill), rel=WITHIN)
    assert np.degrees(found.polygon.max()) == pytest.approx(np.degrees(limit + 0.2), rel=WITHIN)
    assert found.polygon.min() == pytest.approx(found.tilt.value, rel=WITHIN)


def test_supports_sink_as_far_as_parts_can_follow(scenes: Any) -> None:
    """A beam on three piers: an outer pier may sink until the beam lies on the other two, a middle one at once."""
    piers = [scenes.box([x, 0, -1], [x + 1, 1, 0], f"pier-{x}") for x in (0, 2, 4)]
    beam = scenes.make([scenes.box([0, 0, 0], [5, 1, 0.5], "beam"), *piers], [1, 2, 3])
    (found,) = StabilityOracle(beam).margins([[1, 2, 2, 2]], ("settlement",))
    depths = dict(found.settlement)
    assert set(depths) == {1, 2, 3}
    assert depths[2] is None


def test_states_of_a_batch_have_margins_of_their_own(scenes: Any) -> None:
    tower = scenes.tower(2, friction=0.9)
    both = StabilityOracle(tower).margins([[1, 1, 2], [1, 0, 2], [2, 2, 2]], ("tilt",))
    assert near(both[0].tilt, np.arctan(0.5))
    assert near(both[1].tilt, np.arctan(0.9))
    assert both[2].tilt is not None
    assert both[2].tilt.value is None


def test_wrong_kinds(scenes: Any) -> None:
    with pytest.raises(InputError, match="unknown margin 'wind'; choose among friction"):
        StabilityOracle(scenes.tower(1)).margins([[1, 2]], ("wind",))
    with pytest.raises(InputError, match="equilibrium has no displacements"):
        StabilityOracle(scenes.tower(1), CRITERIA[1]).margins([[1, 2]], ("settlement",))


@pytest.mark.parametrize("settings", CRITERIA, ids=lambda settings: settings.criterion)
def test_without_a_bound_the_largest_value_is_proven(scenes: Any, settings: StabilitySettings) -> None:
    """A block on the ground bears a hundred times its own weight."""
    blocks = [scenes.box([x, 0, 0], [x + 1, 1, 1], f"block-{x}") for x in range(3)]
    row = scenes.make([*blocks, scenes.box([-1, -1, -1], [4, 2, 0], "ground")], [3], friction=0.6)
    found = margins(row, settings, "load_factor", state=[2, 1, 2, 2])
    assert found.load_factor is not None
    assert found.load_factor.value is None
    assert found.load_factor.part is None
    extra = found.load_factor.inside_condition.extra
    assert extra[1, 2] == pytest.approx(-99.0 * 9.81 * row.mass.mass[1])


def test_large_loads_need_no_exact_solver(monkeypatch: pytest.MonkeyPatch) -> None:
    """Pushes of ten weights of an arch on a voussoir between held ones: forces in balance, or a velocity, at once."""
    arch = load_structure("arch:blocks=9")
    state = complete_state(arch.boundary)
    state[[2, 4, 6]] = 2
    settings = StabilitySettings(criterion="equilibrium")
    oracle = StabilityOracle(arch, settings)
    asked: list[Any] = []
    exact = type(oracle.prober).exact
    monkeypatch.setattr(type(oracle.prober), "exact", lambda *given: (asked.append(given[2]), exact(*given))[1])
    (found,) = oracle.margins(state, ("push",))
    assert found.push is not None
    prove(arch, settings, state, found.push)
    assert len(asked) <= 2


def test_iterations_that_end_undecided_are_continued(monkeypatch: pytest.MonkeyPatch) -> None:
    arch = load_structure("arch:blocks=7")
    state, prober = complete_state(arch.boundary), StabilityOracle(arch).prober
    assert isinstance(prober, ContactProber)
    assert prober.ask(state, prober.own()).stands
    monkeypatch.setattr(prober, "contact_options", prober.contact_options._replace(steps=2))
    continued = prober.ask(state, prober.own())
    assert continued.stands
    assert prober.certify(state, continued).stable[0]
    assert prober.refine(state, continued) is continued
    monkeypatch.setattr(prober, "further_options", prober.further_options._replace(warm_steps=0))
    undecided = prober.ask(state, prober.own())
    assert not undecided.stands
    assert not undecided.moves_away
    assert undecided.reached is not None


@pytest.mark.parametrize("settings", CRITERIA, ids=lambda settings: settings.criterion)
def test_a_deadline_leaves_what_has_been_proven(settings: StabilitySettings) -> None:
    dome = load_structure("dome")
    oracle, state = StabilityOracle(dome, settings), complete_state(dome.boundary)
    (found,) = oracle.margins(state, ("friction", "tilt", "push"), deadline=1e-9)
    assert found.stands
    assert set(found.unfinished) == {"friction", "tilt", "push"}
    for bound in (found.friction, found.tilt, found.push):
        assert bound is not None
        assert not bound.finished
        assert not bound.proven
        assert bound.inside_proof.stable[0]
    assert found.friction.value == dome.friction  # type: ignore[union-attr]
    assert found.tilt.value == found.push.value == 0.0  # type: ignore[union-attr]
    record = found.to_dict(dome.names)
    assert record["unfinished"] == list(found.unfinished)
    assert not record["proven"]
    assert record["fails_at"] == {}


def test_a_deadline_that_is_kept_cuts_nothing(scenes: Any) -> None:
    (found,) = StabilityOracle(scenes.tower(2, friction=0.9)).margins([[1, 1, 2]], deadline=600.0)
    assert found.unfinished == ()
    assert near(found.tilt, np.arctan(0.5))


@pytest.mark.parametrize("state", [[0, 2], [2, 2]])
def test_a_state_without_parts_to_load_keeps_its_deadline(scenes: Any, state: list[int]) -> None:
    (found,) = StabilityOracle(scenes.tower(1)).margins([state], deadline=60.0)
    assert found.stands
    assert found.unfinished == ()


def test_a_deadline_of_nothing(scenes: Any) -> None:
    with pytest.raises(InputError, match="a deadline of 0 s leaves no time"):
        StabilityOracle(scenes.tower(1)).margins([[1, 2]], deadline=0.0)


@pytest.mark.parametrize("pressed", [1.5, 4.0])
def test_what_was_pressed_together_is_held_by_friction(scenes: Any, pressed: float) -> None:
    """A block between two walls slides if it is loaded at once; pressed by them before, it needs friction W / 2 N."""
    boxes = [scenes.box([low, 0, 0], [low + 1, 1, 1], f"box {low}") for low in (0, 1, 2)]
    clamp = scenes.make(boxes, [0, 2], friction=0.6)
    oracle, state = StabilityOracle(clamp), np.array([[2, 1, 2]], np.uint8)
    weight, contacts = 9.81 * clamp.mass.mass[1], clamp.contacts
    points = len(contacts.points)
    upwards = np.where(contacts.parts[contacts.contact_of_point, 1] == 1, 1.0, -1.0)[:, None] * [
        0.0,
        0.0,
        weight / points,
    ]
    forces = np.einsum("pij,pj->pi", contacts.point_frames, upwards)
    forces[:, 0] = 2 * pressed * weight / points
    history = History(
        np.zeros((3, 6)),
        forces / oracle.prober.problem.force_scale[:, None],
        np.zeros(points, bool),
        np.ones(points, np.int32),
    )
    assert not oracle.margins(state, ("friction",))[0].stands
    (found,) = oracle.margins(state, histories=[history])
    assert found.stands
    assert near(found.friction, 1 / (2 * pressed))
    assert near(found.load_factor, 2 * 0.6 * pressed)
    assert near(found.total_load_factor, 2 * 0.6 * pressed)
    for bound in (found.friction, found.load_factor, found.push):
        assert bound is not None
        assert bound.proven
