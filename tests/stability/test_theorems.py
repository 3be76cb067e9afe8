"""Structures whose stability is known without any solver."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict
from falsework.assembly import complete_state, empty_state, library
from falsework.stability import Proof, Verdicts

CONES = ("octagon", "quadratic")


def verdict_of(assembly: Assembly, state: Any = None, **settings: Any) -> Verdict:
    """Verdict of one state, by default the complete structure; the oracle has checked its certificate."""
    if state is None:
        state = complete_state(assembly.boundary)
    verdicts = StabilityOracle(assembly, StabilitySettings(criterion="equilibrium", **settings)).verdicts(
        state, require_certificate=True
    )
    assert not verdicts.undecided.any()
    return Verdict(int(verdicts.verdict[0]))


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("friction", [0.1, 0.55, 1.2])
@pytest.mark.parametrize("azimuth", [0.0, 0.7])
def test_a_block_slips_past_the_angle_of_friction(scenes: Any, cone: str, friction: float, azimuth: float) -> None:
    """Coulomb: it rests if and only if `tan(slope) <= mu`. The slip is along a corner of the octagon here."""
    angle = np.arctan(friction)
    assert verdict_of(scenes.slope(angle - 2e-3, friction=friction, azimuth=azimuth), cone=cone) == Verdict.STABLE
    assert verdict_of(scenes.slope(angle + 2e-3, friction=friction, azimuth=azimuth), cone=cone) == Verdict.UNSTABLE


@pytest.mark.parametrize("degrees", [0, 10, 22.5, 40, 60, 201])
def test_octagonal_friction_depends_on_direction(scenes: Any, degrees: float) -> None:
    """Between corners the octagon reaches `mu cos(22.5) / cos(angle from the middle of the side)`."""
    friction = 0.5
    from_middle = np.deg2rad((degrees % 45) - 22.5)
    reach = friction * np.cos(np.pi / 8) / np.cos(from_middle)
    assert friction * np.cos(np.pi / 8) - 1e-12 <= reach <= friction + 1e-12
    for offset, expected in ((-2e-3, Verdict.STABLE), (2e-3, Verdict.UNSTABLE)):
        level = scenes.slope(np.arctan(reach) + offset, friction=friction)
        assembly = scenes.turn_tangents(level, np.deg2rad(degrees))
        assert verdict_of(assembly, cone="octagon") == expected


@pytest.mark.parametrize("degrees", [0, 22.5, 71])
def test_quadratic_friction_does_not_depend_on_direction(scenes: Any, degrees: float) -> None:
    friction = 0.5
    for offset, expected in ((-2e-3, Verdict.STABLE), (2e-3, Verdict.UNSTABLE)):
        level = scenes.slope(np.arctan(friction) + offset, friction=friction)
        assembly = scenes.turn_tangents(level, np.deg2rad(degrees))
        assert verdict_of(assembly, cone="quadratic") == expected


@pytest.mark.parametrize("cone", CONES)
def test_a_block_tips_over_its_edge(scenes: Any, cone: str) -> None:
    """A block twice as high as wide on a rough slope tips past `tan(slope) = 1/2`."""
    for slope, expected in ((0.495, Verdict.STABLE), (0.505, Verdict.UNSTABLE)):
        turn = scenes.about_y(np.arctan(slope))
        block = scenes.box([0, 0, 0], [1, 1, 2], "block", turn)
        assembly = scenes.make([block, scenes.box([-1, -1, -1], [2, 2, 0], "slab", turn)], [1], friction=2.0)
        assert verdict_of(assembly, cone=cone) == expected


@pytest.mark.parametrize("blocks", [1, 2, 3, 5, 8])
@pytest.mark.parametrize("cone", CONES)
def test_overhanging_blocks_reach_the_harmonic_sum(blocks: int, cone: str) -> None:
    inside = library.build(f"stack:blocks={blocks},overhang=0.998")
    outside = library.build(f"stack:blocks={blocks},overhang=1.002")
    assert verdict_of(inside, cone=cone) == Verdict.STABLE
    assert verdict_of(outside, cone=cone) == Verdict.UNSTABLE


def test_a_semicircular_arch_needs_a_thickness_of_a_tenth_of_its_radius() -> None:
    """Milankovitch: with fine voussoirs and enough friction the limit is 0.1075 of the mean radius."""
    for thickness, expected in ((0.107, Verdict.UNSTABLE), (0.108, Verdict.STABLE)):
        arch = library.build(f"arch:blocks=60,thickness={thickness}").replace(friction=0.8)
        assert verdict_of(arch) == expected


def test_a_thick_arch_slips_without_friction() -> None:
    """Radial joints of a semicircle cannot carry it by pressure alone near the springings."""
    arch = library.build("arch:blocks=15,thickness=0.3")
    assert verdict_of(arch.replace(friction=0.6)) == Verdict.STABLE
    assert verdict_of(arch.replace(friction=0.05)) == Verdict.UNSTABLE


def test_an_arch_without_its_keystone_falls_unless_its_neighbours_are_held() -> None:
    arch = library.build("arch:blocks=9,thickness=0.3")
    state = complete_state(arch.boundary)
    state[4] = 0
    assert verdict_of(arch, state) == Verdict.UNSTABLE
    state[[3, 5]] = 2
    assert verdict_of(arch, state) == Verdict.STABLE


@pytest.mark.parametrize("cone", CONES)
def test_nothing_rests_on_a_slope_without_friction(scenes: Any, cone: str) -> None:
    assert verdict_of(scenes.slope(0.0, friction=0.0), cone=cone) == Verdict.STABLE
    assert verdict_of(scenes.slope(1e-3, friction=0.0), cone=cone) == Verdict.UNSTABLE


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize(("tilt", "expected"), [(-45, Verdict.STABLE), (-80, Verdict.STABLE), (10, Verdict.UNSTABLE)])
def test_a_trough_holds_a_block_without_friction(scenes: Any, cone: str, tilt: float, expected: Verdict) -> None:
    """A cube in the corner of two walls rests by pressure alone as long as both walls look upwards."""
    turn = scenes.about_y(np.deg2rad(tilt))
    walls = [scenes.box([-1, -1, -1], [2, 2, 0], "floor", turn), scenes.box([-1, -1, 0], [0, 2, 2], "side", turn)]
    trough = scenes.make([scenes.box([0, 0, 0], [1, 1, 1], "cube", turn), *walls], [1, 2], friction=0.0)
    assert verdict_of(trough, cone=cone) == expected


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("friction", [0.0, 0.55])
def test_contacts_push_and_never_pull(scenes: Any, cone: str, friction: float) -> None:
    """A block under a ceiling falls, whatever the friction."""
    ceiling = scenes.box([-1, -1, 1], [2, 2, 2], "ceiling")
    assembly = scenes.make([scenes.box([0, 0, 0], [1, 1, 1]), ceiling], [1], friction=friction)
    assert verdict_of(assembly, cone=cone) == Verdict.UNSTABLE


@pytest.mark.parametrize("cone", CONES)
def test_walls_can_clamp_what_nothing_supports(scenes: Any, cone: str) -> None:
    """Rigid walls press as hard as needed: any friction holds the cube, within the bound on forces."""
    assert verdict_of(scenes.clamp(friction=0.01), cone=cone) == Verdict.STABLE
    assert verdict_of(scenes.clamp(friction=0.0), cone=cone) == Verdict.UNSTABLE
    # Carrying the weight W by friction takes normal forces of W / mu: 100 W is more than the bound of 50 W.
    assert verdict_of(scenes.clamp(friction=0.01), cone=cone, force_bound=50.0) == Verdict.UNSTABLE
    assert verdict_of(scenes.clamp(friction=0.01), cone=cone, force_bound=102.0) == Verdict.STABLE


def test_a_held_part_is_never_asked_to_balance(scenes: Any) -> None:
    """Held blocks stand anywhere, carry others, and only what is not held can fall."""
    tower = scenes.tower(3)
    stability = StabilityOracle(tower, StabilitySettings(criterion="equilibrium"))
    for state, expected in (
        ([0, 2, 0, 2], Verdict.STABLE),  # held in the air
        ([0, 2, 1, 2], Verdict.STABLE),  # a held block carries another
        ([0, 1, 2, 2], Verdict.UNSTABLE),  # nothing below, and what is above cannot pull
        ([0, 1, 0, 2], Verdict.UNSTABLE),
        ([2, 2, 2, 2], Verdict.STABLE),
    ):
        assert stability.verdicts(state, require_certificate=True).verdict[0] == expected, state


def test_the_empty_structure_stands() -> None:
    arch = library.build("arch")
    verdicts = StabilityOracle(arch, StabilitySettings(criterion="equilibrium")).verdicts(
        empty_state(arch.boundary), require_certificate=True
    )
    assert verdicts.verdict[0] == Verdict.STABLE
    assert verdicts.residual[0] == 0


def test_a_part_that_floats_falls_straight_down(scenes: Any) -> None:
    """Its certificate is the fall itself: down, without turning, and nothing else moves."""
    tower = scenes.tower(3)
    verdicts = StabilityOracle(tower, StabilitySettings(criterion="equilibrium")).verdicts(
        [1, 0, 1, 2], require_certificate=True
    )
    assert verdicts.verdict[0] == Verdict.UNSTABLE
    assert verdicts.proof[0] == Proof.VELOCITY
    assert verdicts.velocity is not None
    velocity = verdicts.velocity[0]
    fall = velocity[2] / np.abs(velocity[2]).max()
    np.testing.assert_allclose(fall, [0, 0, -1, 0, 0, 0], atol=1e-6)
    assert np.abs(velocity[[1, 3]]).max() == 0
    assert np.abs(velocity[0]).max() < 1e-3 * np.abs(velocity[2]).max()


def test_a_part_without_any_contact_falls(scenes: Any) -> None:
    tower = scenes.tower(1)
    contacts = tower.contacts
    nothing = dataclasses.replace(
        contacts,
        parts=contacts.parts[:0],
        frames=contacts.frames[:0],
        points=contacts.points[:0],
        start=contacts.start[:1],
        areas=contacts.areas[:0],
    )
    alone = dataclasses.replace(tower, contacts=nothing)
    for settings in (
        StabilitySettings(criterion="equilibrium"),
        StabilitySettings(criterion="equilibrium", solver="exact"),
    ):
        verdicts = StabilityOracle(alone, settings).verdicts([[1, 2], [2, 2], [0, 2]], require_certificate=True)
        assert verdicts.verdict.tolist() == [Verdict.UNSTABLE, Verdict.STABLE, Verdict.STABLE]


def test_boundary_parts_alone_stand(scenes: Any) -> None:
    """A structure of boundary parts that touch nothing has no contact point at all."""
    boxes = [scenes.box([0, 0, 0], [1, 1, 1]), scenes.box([3, 0, 0], [4, 1, 1], "other")]
    verdicts = StabilityOracle(scenes.make(boxes, [0, 1])).verdicts([2, 2], require_certificate=True)
    assert verdicts.stable.all()


def held_forces(assembly: Assembly, state: np.ndarray, verdicts: Verdicts) -> np.ndarray:
    """Total force that fixed and held parts exert on the free ones, N, world axes."""
    assert verdicts.forces is not None
    contacts = assembly.contacts
    owner = contacts.contact_of_point
    world = np.einsum("ci,cij->cj", verdicts.forces[0], contacts.frames[owner])
    a, b = state[contacts.parts[owner]].T
    return world[(a == 2) & (b == 1)].sum(axis=0) - world[(a == 1) & (b == 2)].sum(axis=0)


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("structure", ["arch", "wall:bricks=3,courses=3", "stack"])
def test_supports_carry_the_weight(structure: str, cone: str) -> None:
    """Newton's third law: forces between free parts cancel, so the supports carry what is free, and nothing else."""
    assembly = library.build(structure)
    stability = StabilityOracle(assembly, StabilitySettings(criterion="equilibrium", cone=cone))  # type: ignore[arg-type]
    states = [complete_state(assembly.boundary)]
    states.append(states[0].copy())
    states[1][0] = 2
    for state in states:
        verdicts = stability.verdicts(state, require_certificate=True)
        assert verdicts.stable[0]
        mass = assembly.mass.mass[state == 1].sum()
        np.testing.assert_allclose(held_forces(assembly, state, verdicts), [0, 0, 9.81 * mass], atol=1.1e-3 * mass)


@pytest.mark.parametrize("cone", CONES)
@pytest.mark.parametrize("structure", ["arch:blocks=7", "wall:bricks=3,courses=3", "corbel"])
def test_monotone_rules(scenes: Any, structure: str, cone: str) -> None:
    """On the same parts, holding one more keeps a stable state stable; letting one go keeps an unstable one so."""
    assembly = library.build(structure)
    settings = StabilitySettings(criterion="equilibrium", cone=cone)  # type: ignore[arg-type]
    states = scenes.few_changes(assembly, 40, seed=3)
    verdicts = StabilityOracle(assembly, settings).verdicts(states, require_certificate=True)
    assert verdicts.stable.any()
    assert verdicts.unstable.any()
    random = np.random.default_rng(0)
    changed = states.copy()
    for state, stable in zip(changed, verdicts.stable, strict=True):
        parts = np.flatnonzero((state == (1 if stable else 2)) & ~assembly.boundary)
        if len(parts):
            state[random.choice(parts)] = 2 if stable else 1
    np.testing.assert_array_equal(
        StabilityOracle(assembly, settings).verdicts(changed, require_certificate=True).verdict, verdicts.verdict
    )


@pytest.mark.parametrize("length", [1e-2, 37.0])
@pytest.mark.parametrize("density", [1e-2, 1e5])
def test_verdicts_do_not_depend_on_units(scenes: Any, length: float, density: float) -> None:
    """Equilibrium has no length and no mass in it, and neither must the verdicts."""
    base = library.build("arch:blocks=7,thickness=0.25")
    meshes = [dataclasses.replace(mesh, vertices=length * mesh.vertices) for mesh in base.meshes]
    scaled = Assembly.from_meshes(meshes, boundary=base.boundary, density=density)
    states = scenes.few_changes(base, 40, seed=1)
    expected = StabilityOracle(base, StabilitySettings(criterion="equilibrium")).verdicts(
        states, require_certificate=True
    )
    assert expected.stable.any()
    assert expected.unstable.any()
    np.testing.assert_array_equal(
        StabilityOracle(scaled, StabilitySettings(criterion="equilibrium"))
        .verdicts(states, require_certificate=True)
        .verdict,
        expected.verdict,
    )


@pytest.mark.parametrize("angle", [0.3, 2.0, 4.5])
def test_verdicts_do_not_depend_on_the_compass(scenes: Any, angle: float) -> None:
    """Turning a structure about the vertical changes nothing where friction has no preferred direction."""
    base = library.build("wall:bricks=3,courses=3")
    meshes = [dataclasses.replace(mesh, vertices=mesh.vertices @ scenes.about_z(angle).T) for mesh in base.meshes]
    turned = Assembly.from_meshes(meshes, boundary=base.boundary)
    states = scenes.few_changes(base, 40, seed=2)
    settings = StabilitySettings(criterion="equilibrium", cone="quadratic")
    expected = StabilityOracle(base, settings).verdicts(states, require_certificate=True)
    assert expected.stable.any()
    assert expected.unstable.any()
    np.testing.assert_array_equal(
        StabilityOracle(turned, settings).verdicts(states, require_certificate=True).verdict, expected.verdict
    )


def test_gravity_scales_forces_and_changes_no_verdict(scenes: Any) -> None:
    assembly = library.build("arch:blocks=7")
    states = scenes.few_changes(assembly, 30, seed=4)
    earth, moon = (
        StabilityOracle(assembly, StabilitySettings(criterion="equilibrium", gravity=g)).verdicts(
            states, require_certificate=True
        )
        for g in (9.81, 1.62)
    )
    np.testing.assert_array_equal(earth.verdict, moon.verdict)


@pytest.mark.parametrize("structure", ["arch:blocks=7", "wall:bricks=3,courses=3"])
def test_the_cones_lie_in_each_other(scenes: Any, structure: str) -> None:
    """The octagon lies inside the quadratic cone, and reaches a quadratic cone of friction `mu cos(22.5)`."""
    assembly = library.build(structure).replace(friction=0.35)
    states = scenes.few_changes(assembly, 40, seed=5)
    octagon = StabilityOracle(assembly, StabilitySettings(criterion="equilibrium")).verdicts(
        states, require_certificate=True
    )
    wide = StabilityOracle(assembly, StabilitySettings(criterion="equilibrium", cone="quadratic")).verdicts(
        states, require_certificate=True
    )
    narrow = StabilityOracle(
        assembly.replace(friction=0.35 * np.cos(np.pi / 8)),
        StabilitySettings(criterion="equilibrium", cone="quadratic"),
    ).verdicts(states, require_certificate=True)
    assert not (octagon.stable & wide.unstable).any()
    assert not (narrow.stable & octagon.unstable).any()
