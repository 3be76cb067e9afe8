"""The checker accepts the certificates of the solvers, and rejects all that have been tampered with."""

from __future__ import annotations

from dataclasses import replace
from itertools import pairwise
from typing import Any

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict, find_plans, verify_certificates
from falsework.assembly import complete_state, library
from falsework.errors import InputError
from falsework.stability import ExactSolver, Verdicts
from falsework.stability.certificate import (
    StabilityCriterion,
    residual_bound_of_velocity,
    residual_of_forces,
)
from falsework.stability.criterion import Cone
from falsework.stability.problem import build_problem
from falsework.stability.second_order.springs import into_cone, springs_of_displacement
from falsework.stability.settings import EQUILIBRIUM
from falsework.stability.strength import strength_of

CONES = ("octagon", "quadratic")


@pytest.fixture(scope="module", params=CONES)
def case(request: pytest.FixtureRequest, scenes: Any) -> tuple[Assembly, NDArray, Verdicts, StabilityCriterion]:
    """States of an arch with both verdicts, and their certificates."""
    assembly = library.build("arch:blocks=7,thickness=0.25")
    states = np.unique(scenes.few_changes(assembly, 40, seed=1), axis=0)
    states = states[(states == 1).any(axis=1)]
    settings = StabilitySettings(criterion="equilibrium", cone=request.param)
    verdicts = StabilityOracle(assembly, settings).verdicts(states, require_certificate=True)
    assert verdicts.stable.sum() > 3
    assert verdicts.unstable.sum() > 3
    return assembly, states, verdicts, settings.claim


def with_forces(verdicts: Verdicts, forces: NDArray) -> Verdicts:
    return replace(verdicts, forces=forces)


def with_velocity(verdicts: Verdicts, velocity: NDArray) -> Verdicts:
    return replace(verdicts, velocity=velocity)


def test_every_certificate_is_accepted(case: tuple) -> None:
    assembly, states, verdicts, claim = case
    assert verify_certificates(assembly, states, verdicts, claim).all()


def test_exact_certificates_are_accepted(case: tuple) -> None:
    assembly, states, verdicts, claim = case
    exact = ExactSolver(assembly, StabilitySettings(criterion="equilibrium", cone=claim.cone)).check(states)
    np.testing.assert_array_equal(exact.verdict, verdicts.verdict)
    assert verify_certificates(assembly, states, exact, claim).all()


def test_a_flipped_verdict_is_rejected(case: tuple) -> None:
    assembly, states, verdicts, claim = case
    assert not verify_certificates(assembly, states, replace(verdicts, verdict=-verdicts.verdict), claim).any()


def test_an_undecided_verdict_is_rejected(case: tuple) -> None:
    assembly, states, verdicts, claim = case
    assert not verify_certificates(assembly, states, replace(verdicts, verdict=0 * verdicts.verdict), claim).any()


@pytest.mark.parametrize("factor", [0.99, 1.01, 0.0, -1.0, np.nan, np.inf])
def test_scaled_forces_are_rejected(case: tuple, factor: float) -> None:
    assembly, states, verdicts, claim = case
    with np.errstate(invalid="ignore"):
        tampered = with_forces(verdicts, factor * verdicts.forces)
        assert not verify_certificates(assembly, states, tampered, claim)[verdicts.stable].any()


def test_perturbed_forces_are_rejected(case: tuple) -> None:
    assembly, states, verdicts, claim = case
    noise = np.random.default_rng(0).normal(1.0, 0.02, verdicts.forces.shape)
    assert not verify_certificates(assembly, states, with_forces(verdicts, noise * verdicts.forces), claim)[
        verdicts.stable
    ].any()


def test_a_single_force_that_is_not_a_number_is_rejected(case: tuple) -> None:
    assembly, states, verdicts, claim = case
    problem = StabilityOracle(assembly, StabilitySettings(criterion="equilibrium")).problem
    for row in np.flatnonzero(verdicts.stable):
        forces = verdicts.forces.copy()
        forces[row, np.flatnonzero(problem.active(states)[row])[0], 1] = np.nan
        assert not verify_certificates(assembly, states, with_forces(verdicts, forces), claim)[row]


def test_forces_where_nothing_touches_count_for_nothing(case: tuple) -> None:
    """Forces on contacts that do not act in a state are ignored, so they can neither help nor spoil."""
    assembly, states, verdicts, claim = case
    idle = ~StabilityOracle(assembly, StabilitySettings(criterion="equilibrium")).problem.active(states)
    tampered = with_forces(verdicts, np.where(idle[:, :, None], 1e3, verdicts.forces))
    assert verify_certificates(assembly, states, tampered, claim).all()
    only_idle = with_forces(verdicts, np.where(idle[:, :, None], 1e3, 0.0 * verdicts.forces))
    assert not verify_certificates(assembly, states, only_idle, claim)[verdicts.stable].any()


@pytest.fixture(scope="module")
def along_a_plan() -> tuple[Assembly, NDArray, NDArray]:
    """Successive states of a plan, and forces that mostly are those of the state before."""
    vault = library.build("vault")
    oracle = StabilityOracle(vault, EQUILIBRIUM)
    plan = find_plans(vault, robots=2, oracle=oracle).plans[0]
    states, assembly = plan.states[60:], vault
    found = [oracle.verdicts(states[0], require_certificate=True)]
    for before, state in pairwise(states):
        found.append(oracle.verdicts(state, near=before, require_certificate=True))
    return assembly, states, np.concatenate([each.forces for each in found if each.forces is not None])


def test_states_along_a_plan_are_checked_as_each_alone(along_a_plan: tuple) -> None:
    assembly, states, forces = along_a_plan
    same = (forces[1:] == forces[:-1]).all(axis=2)
    assert same.mean() > 0.5
    together = residual_of_forces(assembly, states, forces, EQUILIBRIUM.claim)
    alone = [residual_of_forces(assembly, states[k : k + 1], forces[k : k + 1])[0] for k in range(len(states))]
    np.testing.assert_array_equal(together, alone)
    assert (together <= EQUILIBRIUM.claim.tolerance).all()


@pytest.mark.parametrize("until_the_end", [False, True])
@pytest.mark.parametrize("change", ["more", "less", "none", "pulls", "slides", "nan", "inf"])
def test_a_force_changed_anywhere_along_a_plan_is_rejected(
    along_a_plan: tuple, change: str, until_the_end: bool
) -> None:
    """Also one that stays as it is in all states that follow."""
    assembly, states, forces = along_a_plan
    active = build_problem(assembly).active(states) & (forces[:, :, 0] > 0.02 * np.median(forces[:, :, 0].max(axis=1)))
    random = np.random.default_rng(0)
    places = np.argwhere(active)
    before = residual_of_forces(assembly, states, forces, EQUILIBRIUM.claim)
    for row, point in places[random.permutation(len(places))[:4]]:
        rows = slice(row, None if until_the_end else row + 1)
        tampered = forces.copy()
        force = forces[row, point]
        tampered[rows, point] = {
            "more": 1.5 * force,
            "less": 0.5 * force,
            "none": 0.0 * force,
            "pulls": -force,
            "slides": force + [0.0, 2.0 * force[0], 0.0],
            "nan": np.nan,
            "inf": np.inf,
        }[change]
        with np.errstate(invalid="ignore"):
            residual = residual_of_forces(assembly, states, tampered, EQUILIBRIUM.claim)
        assert residual[row] > EQUILIBRIUM.claim.tolerance
        untouched = np.ones(len(states), dtype=bool)
        untouched[rows] = False
        np.testing.assert_array_equal(residual[untouched], before[untouched])


def test_a_part_that_is_gone_or_let_go_of_along_a_plan_is_rejected(along_a_plan: tuple) -> None:
    """Forces of contacts whose part is not there count for nothing, and a part that nobody holds has its weight."""
    assembly, states, forces = along_a_plan
    random, claim = np.random.default_rng(0), EQUILIBRIUM.claim
    bears = np.zeros(states.shape, dtype=bool)
    owner = assembly.contacts.parts[assembly.contacts.contact_of_point]
    for side in (0, 1):
        rows, points = np.nonzero(forces[:, :, 0] > 0.05 * forces[:, :, 0].max())
        bears[rows, owner[points, side]] = True
    gone = np.argwhere(bears & (states == 1))
    held = np.argwhere((states == 2) & ~assembly.boundary)
    for value, places in ((0, gone), (1, held)):
        for row, part in places[random.permutation(len(places))[:20]]:
            tampered = states.copy()
            tampered[row, part] = value
            residual = residual_of_forces(assembly, tampered, forces, claim)
            alone = residual_of_forces(assembly, tampered[row : row + 1], forces[row : row + 1], claim)
            assert residual[row] == alone[0] > claim.tolerance


def test_what_only_grows_along_a_plan_is_added_up(along_a_plan: tuple) -> None:
    """The sum of all forces is bounded in each state, not that of the changes."""
    assembly, states, forces = along_a_plan
    pressed = np.where(build_problem(assembly).active(states), forces[:, :, 0], 0.0).sum(axis=1)
    weight = EQUILIBRIUM.gravity * assembly.mass.mass[~assembly.boundary].sum()
    claim = replace(EQUILIBRIUM.claim, force_bound=float(np.median(pressed) / weight))
    refused = np.isinf(residual_of_forces(assembly, states, forces, claim))
    assert 0 < refused.sum() < len(states)
    np.testing.assert_array_equal(refused, pressed > np.median(pressed) * (1 + 1e-9))


def test_forces_of_another_state_are_rejected(scenes: Any) -> None:
    """What carries a tower of three does not balance the tower without its base, nor with another block free."""
    tower = scenes.tower(3)
    verdicts = StabilityOracle(tower, StabilitySettings(criterion="equilibrium")).verdicts(
        [1, 1, 1, 2], require_certificate=True
    )
    assert verdicts.stable[0]
    for state, expected in (([1, 1, 1, 2], True), ([0, 1, 1, 2], False), ([1, 1, 0, 2], False), ([2, 1, 1, 2], True)):
        # With the base held, its forces stay those of a state in which it needs none.
        assert verify_certificates(tower, np.array([state], np.uint8), verdicts)[0] == expected, state


@pytest.mark.parametrize("factor", [1e-9, 1e9])
def test_the_length_of_a_velocity_does_not_matter(case: tuple, factor: float) -> None:
    assembly, states, verdicts, claim = case
    assert verify_certificates(assembly, states, with_velocity(verdicts, factor * verdicts.velocity), claim).all()


@pytest.mark.parametrize("factor", [0.0, -1.0, np.nan, np.inf])
def test_a_velocity_that_is_none_is_rejected(case: tuple, factor: float) -> None:
    assembly, states, verdicts, claim = case
    with np.errstate(invalid="ignore"):
        tampered = with_velocity(verdicts, factor * verdicts.velocity)
        assert not verify_certificates(assembly, states, tampered, claim)[verdicts.unstable].any()


def test_random_velocities_are_rejected(case: tuple) -> None:
    assembly, states, verdicts, claim = case
    velocity = np.random.default_rng(0).standard_normal(verdicts.velocity.shape)
    assert not verify_certificates(assembly, states, with_velocity(verdicts, velocity), claim)[verdicts.unstable].any()


def test_a_velocity_of_a_part_that_is_held_proves_nothing(scenes: Any) -> None:
    tower = scenes.tower(2)
    verdicts = StabilityOracle(tower, StabilitySettings(criterion="equilibrium")).verdicts(
        [0, 1, 2], require_certificate=True
    )
    assert verdicts.unstable[0]
    assert verify_certificates(tower, np.array([[0, 1, 2]], np.uint8), verdicts)[0]
    assert not verify_certificates(tower, np.array([[0, 2, 2]], np.uint8), verdicts)[0]
    assert not verify_certificates(tower, np.array([[1, 1, 2]], np.uint8), verdicts)[0]


def four_corners(scenes: Any, **options: Any) -> tuple[Assembly, NDArray]:
    """A cube on the ground and forces on its four corners that carry it."""
    tower = scenes.tower(1, **options)
    assert len(tower.contacts.points) == 4
    forces = np.zeros((1, 4, 3))
    forces[0, :, 0] = 9.81 * tower.mass.mass[0] / 4
    return tower, forces


def test_many_forces_carry_a_cube(scenes: Any) -> None:
    """Adding a pattern that balances itself proves as well, until a corner would have to pull."""
    tower, forces = four_corners(scenes)
    state = complete_state(tower.boundary)[None]
    share = forces[0, 0, 0]
    for amount, expected in ((0.0, True), (0.9 * share, True), (1.1 * share, False)):
        pattern = forces.copy()
        pattern[0, :, 0] += amount * np.array([1, -1, 1, -1])  # corners in order around the hull
        residual = residual_of_forces(tower, state, pattern)[0]
        assert (residual <= 1e-9) == expected
        assert np.isfinite(residual) == expected


@pytest.mark.parametrize("cone", CONES)
def test_forces_outside_the_cone_are_rejected(scenes: Any, cone: Cone) -> None:
    """Two corners that push at each other along an edge balance themselves, within the limit of friction."""
    tower, forces = four_corners(scenes, friction=0.5)
    state = complete_state(tower.boundary)[None]
    points, frame = tower.contacts.points, tower.contacts.frames[0]
    edge = frame[1:] @ (points[1] - points[0])
    edge /= np.linalg.norm(edge)
    assert np.isclose(np.abs(edge).max(), 1), "the edges of the cube are the tangents, corners of the octagon"
    for share, expected in ((0.999, True), (1.001, False)):
        pattern = forces.copy()
        pattern[0, 0, 1:] = share * 0.5 * forces[0, 0, 0] * edge
        pattern[0, 1, 1:] = -pattern[0, 0, 1:]
        assert np.isfinite(residual_of_forces(tower, state, pattern, StabilityCriterion(cone=cone))[0]) == expected


def test_the_octagon_is_the_narrower_cone(scenes: Any) -> None:
    """Friction along the middle of a side: inside the quadratic cone, outside the octagon."""
    tower, forces = four_corners(scenes, friction=0.5)
    turned = scenes.turn_tangents(tower, np.deg2rad(22.5))
    state = complete_state(tower.boundary)[None]
    points, frame = turned.contacts.points, turned.contacts.frames[0]
    edge = frame[1:] @ (points[1] - points[0])
    pattern = forces.copy()
    pattern[0, 0, 1:] = 0.97 * 0.5 * forces[0, 0, 0] * edge / np.linalg.norm(edge)
    pattern[0, 1, 1:] = -pattern[0, 0, 1:]
    assert residual_of_forces(turned, state, pattern, StabilityCriterion(cone="quadratic"))[0] < 1e-9
    assert residual_of_forces(turned, state, pattern, StabilityCriterion(cone="octagon"))[0] == np.inf


def test_forces_above_the_bound_are_rejected(scenes: Any) -> None:
    """Walls may press harder on a clamped cube without disturbing it, up to the bound on all normal forces."""
    clamp = scenes.clamp(friction=1.0)
    verdicts = StabilityOracle(clamp, StabilitySettings(criterion="equilibrium")).verdicts(
        [1, 2, 2], require_certificate=True
    )
    assert verdicts.stable[0]
    assert verdicts.forces is not None
    weight = 9.81 * clamp.mass.mass[0]
    for bound, expected in ((0.9, False), (1.1, True)):
        pressed = verdicts.forces.copy()
        for wall in (1, 2):
            on_wall = (clamp.contacts.parts[clamp.contacts.contact_of_point] == wall).any(axis=1)
            pressed[0, on_wall, 0] += 500 * weight / on_wall.sum()
        residual = residual_of_forces(
            clamp, np.array([[1, 2, 2]], np.uint8), pressed, StabilityCriterion(force_bound=1e3 / bound)
        )
        assert np.isfinite(residual[0]) != expected


def test_certificates_must_be_there_and_fit(scenes: Any) -> None:
    tower = scenes.tower(1)
    stability = StabilityOracle(tower, StabilitySettings(criterion="equilibrium"))
    state = np.array([[1, 2]], np.uint8)
    with pytest.raises(InputError, match="no certificates"):
        verify_certificates(tower, state, stability.verdicts(state))
    verdicts = stability.verdicts(state, require_certificate=True)
    assert verdicts.forces is not None
    with pytest.raises(InputError, match=r"forces have shape \(1, 4, 1\); expected \(1, 4, 3\)"):
        verify_certificates(tower, state, with_forces(verdicts, verdicts.forces[:, :, :1]))
    with pytest.raises(InputError, match=r"states have shape \(2,\); expected \(batch, parts\)"):
        verify_certificates(tower, state[0], verdicts)
    with pytest.raises(InputError, match="states have shape"):
        verify_certificates(tower, np.array([[1, 2], [1, 2]], np.uint8), verdicts)


@settings(max_examples=60, deadline=None, derandomize=True)
@given(seed=st.integers(0, 2**32 - 1), cone=st.sampled_from(CONES), push=st.floats(-3, 3), blend=st.floats(0, 1))
def test_no_state_passes_both_checks(seed: int, cone: Cone, push: float, blend: float) -> None:
    """Weak duality: whatever the forces and the velocity, forces bound from above what velocities bound from below."""
    assembly = library.build("arch:blocks=5,thickness=0.2")
    random = np.random.default_rng(seed)
    state = random.choice(3, (1, assembly.part_count), p=[0.15, 0.7, 0.15]).astype(np.uint8)
    state[:, assembly.boundary] = 2
    exact = ExactSolver(assembly, StabilitySettings(criterion="equilibrium", cone=cone)).check(state)  # type: ignore[arg-type]
    assert exact.forces is not None
    assert exact.velocity is not None
    weight = 9.81 * assembly.mass.mass[~assembly.boundary].sum()
    forces = 10**push * weight * random.standard_normal(exact.forces.shape)
    forces = into_cone((1 - blend) * exact.forces + blend * forces, strength_of(assembly), cone)[0]
    velocity = (1 - blend) * exact.velocity + blend * random.standard_normal(exact.velocity.shape)
    claim = StabilityCriterion(cone=cone)
    above = residual_of_forces(assembly, state, forces, claim)[0]
    below = residual_bound_of_velocity(assembly, state, velocity, claim)[0]
    assert below <= above + 1e-9
    verdicts = Verdicts.all_undecided(1, points=len(assembly.contacts.points), parts=assembly.part_count)
    passed = []
    for verdict in (Verdict.STABLE, Verdict.UNSTABLE):
        claimed = replace(verdicts, verdict=np.array([verdict], np.int8), forces=forces, velocity=velocity)
        passed.append(bool(verify_certificates(assembly, state, claimed, claim)[0]))
    assert not all(passed)


@pytest.mark.parametrize("cone", CONES)
def test_rounding_that_is_forgiven_carries_nothing(scenes: Any, cone: Cone) -> None:
    """A light plate on a rough slope beside a heavy block, forces outside their cone by next to nothing.

    If every force could leave its cone by a share of the weight of the structure, the plate would profit.
    """
    slope = scenes.slope(np.arctan(0.5) + 2e-4, friction=0.5)
    heavy = scenes.box([5, 5, 5], [6, 6, 6], "heavy")
    table = scenes.box([4, 4, 4], [7, 7, 5], "table")
    assembly = Assembly.from_meshes(
        [*slope.meshes, heavy, table], boundary=[1, 3], friction=0.5, density=[1e-3, 2400.0, 2400.0, 2400.0]
    )
    claim = StabilityCriterion(cone=cone)
    settings = StabilitySettings(criterion="equilibrium", cone=cone)  # type: ignore[arg-type]
    verdicts = StabilityOracle(assembly, settings).verdicts(complete_state(assembly.boundary), require_certificate=True)
    assert verdicts.unstable[0]
    # The forces that would hold the plate, were its cone only a little wider.
    wider = assembly.replace(friction=0.5 + 1e-3)
    held = StabilityOracle(wider, settings).verdicts(complete_state(assembly.boundary), require_certificate=True)
    assert held.stable[0]
    assert not verify_certificates(assembly, complete_state(assembly.boundary)[None], held, claim)[0]


def test_no_contact_feels_parts_that_move_as_one_body() -> None:
    assembly = library.build("arch:blocks=7,thickness=0.25")
    states, turn = complete_state(assembly.boundary)[None], 1e-6 * np.array([0.3, -0.7, 0.5])
    motion = np.tile(np.concatenate([1e-6 * np.array([0.2, 0.9, -0.4]), turn]), (1, assembly.part_count, 1))
    motion[..., :3] += np.cross(turn, assembly.mass.center)
    claim = StabilityCriterion(criterion="contact", cone="quadratic")
    still = springs_of_displacement(assembly, states, motion, claim).forces
    motion[0, 3, 0] += 1e-6
    assert np.abs(still).max() < 1e-9 * np.abs(springs_of_displacement(assembly, states, motion, claim).forces).max()


def test_contacts_of_other_masses_are_checked_anew() -> None:
    """Twice the density and twice the forces leave the same residual."""
    assembly = library.build("arch:blocks=7,thickness=0.25")
    states, points = complete_state(assembly.boundary)[None], len(assembly.contacts.points)
    forces = np.zeros((1, points, 3))
    forces[0, :, 0] = np.random.default_rng(0).uniform(0.0, 100.0, points)
    twice = assembly.replace(density=2.0 * assembly.density)
    assert twice.contacts is assembly.contacts
    residual = residual_of_forces(assembly, states, forces)
    np.testing.assert_allclose(residual_of_forces(twice, states, 2.0 * forces), residual, rtol=1e-12)
