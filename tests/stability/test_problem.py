"""The equations that all solvers share, and the block elimination, against dense linear algebra."""

from __future__ import annotations

import dataclasses
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, StabilitySettings, load_structure
from falsework.assembly import HELD, INSTALLED, REMOVED, complete_state, library
from falsework.errors import AssemblyError, InputError
from falsework.stability import ExactSolver, NumericalSettings
from falsework.stability.certificate import residual_of_forces
from falsework.stability.cpu.elimination import eliminate
from falsework.stability.cpu.kernel import factor_admm
from falsework.stability.cpu.layout import add_wrenches, build_structure, make_scratch, restrict
from falsework.stability.cpu.panels import factor_panels, solve_panels
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.exact_solver import wrench_matrix
from falsework.stability.problem import Problem, build_problem
from falsework.stability.settings import EQUILIBRIUM

STRUCTURES = ("arch:blocks=7", "wall:bricks=3,courses=3", "dome")


def scaled_map(problem: Problem, state: NDArray[np.uint8]) -> NDArray[np.float64]:
    """Whitened wrenches on the free parts per scaled variable, from the wrenches of unit forces."""
    free, active = state == 1, problem.active(state[None])[0]
    wrenches = wrench_matrix(problem, free, active).toarray() * np.repeat(problem.force_scale[active], 3)
    for k, part in enumerate(np.flatnonzero(free)):
        wrenches[6 * k : 6 * k + 6] = problem.whitening[part] @ wrenches[6 * k : 6 * k + 6]
    return wrenches


@pytest.fixture(params=STRUCTURES)
def assembly(request: pytest.FixtureRequest) -> Assembly:
    return library.build(request.param)


def test_forces_act_in_pairs(assembly: Assembly) -> None:
    """Newton: about one common point, the wrenches on both parts of a contact cancel."""
    problem = build_problem(assembly)
    wrench = problem.geometry.wrench.toarray().reshape(problem.parts, 6, problem.points, 3)
    total = wrench.sum(axis=0)
    for center, each in zip(assembly.mass.center, wrench, strict=True):
        total[3:] += np.cross(center, each[:3].transpose(1, 2, 0)).transpose(2, 0, 1)
    np.testing.assert_allclose(total, 0, atol=1e-12)
    on_b = wrench[problem.geometry.part_b, :3, np.arange(problem.points), 0]
    np.testing.assert_allclose(on_b, assembly.contacts.normals[assembly.contacts.contact_of_point])


def test_power_is_the_same_on_both_sides(assembly: Assembly) -> None:
    """Virtual work: forces times relative velocities of contact points are wrenches times velocities of parts."""
    problem = build_problem(assembly)
    random = np.random.default_rng(0)
    velocity = random.standard_normal((problem.parts, 6))
    forces = random.standard_normal((problem.points, 3))
    on_parts = (problem.geometry.wrench @ forces.ravel()).reshape(-1, 6)
    contacts, center = assembly.contacts, assembly.mass.center
    relative = np.zeros((problem.points, 3))
    for part, sign in ((problem.geometry.part_a, -1), (problem.geometry.part_b, 1)):
        arm = contacts.points - center[part]
        relative += sign * (velocity[part, :3] + np.cross(velocity[part, 3:], arm))
    local = np.einsum("cij,cj->ci", contacts.frames[contacts.contact_of_point], relative)
    assert (forces * local).sum() == pytest.approx((velocity * on_parts).sum())


def test_masses_factor(assembly: Assembly) -> None:
    problem, mass = build_problem(assembly), assembly.mass
    for part in range(problem.parts):
        matrix = np.zeros((6, 6))
        matrix[:3, :3], matrix[3:, 3:] = mass.mass[part] * np.eye(3), mass.inertia[part]
        np.testing.assert_allclose(problem.momentum[part] @ problem.momentum[part].T, matrix, atol=1e-9)
        np.testing.assert_allclose(problem.whitening[part] @ problem.momentum[part], np.eye(6), atol=1e-9)
        np.testing.assert_allclose(problem.acceleration[part], problem.whitening[part].T)
    np.testing.assert_allclose(problem.gravity_wrench[:, 2], -9.81 * mass.mass)
    assert problem.weight == pytest.approx(9.81 * mass.mass[~assembly.boundary].sum())


def test_scaling_makes_the_largest_singular_value_one(assembly: Assembly) -> None:
    problem = build_problem(assembly)
    state = np.where(assembly.boundary, 2, 1).astype(np.uint8)
    wrenches = scaled_map(problem, state)
    assert np.linalg.norm(wrenches, 2) == pytest.approx(1, rel=0.02)
    columns = np.sqrt((wrenches**2).reshape(len(wrenches), -1, 3).sum((0, 2)))
    np.testing.assert_allclose(columns, columns[0])


@pytest.mark.usefixtures("interpreted")
def test_pairs_factor_the_map(scenes: Any, assembly: Assembly) -> None:
    """Forces through the 6-vector of each pair of parts give the wrenches of the dense map."""
    problem = build_problem(assembly)
    structure = build_structure(problem)
    random = np.random.default_rng(1)
    for state in scenes.random_states(assembly, 6, seed=7):
        work = make_scratch(structure)
        pairs, count = restrict(structure, state, work)
        if count == 0:
            continue
        active = int(work.start[pairs])
        forces = random.standard_normal((active, 3))
        out = np.zeros_like(work.rhs)
        add_wrenches(structure, work, pairs, forces, out)
        expected = scaled_map(problem, state) @ forces.ravel()
        free = np.flatnonzero(state == 1)
        np.testing.assert_allclose(out[structure.elimination.position[free]].ravel(), expected, atol=1e-12)


@pytest.mark.usefixtures("interpreted")
def test_elimination_agrees_with_dense_algebra(scenes: Any, assembly: Assembly) -> None:
    problem = build_problem(assembly)
    structure = build_structure(problem)
    random = np.random.default_rng(2)
    rho = 1e-3
    for state in scenes.random_states(assembly, 12, seed=8):
        work = make_scratch(structure)
        pairs, count = restrict(structure, state, work)
        if count == 0:
            continue
        assert factor_admm.dispatcher(structure, work, pairs, rho)
        wrenches = scaled_map(problem, state)
        dense = rho * np.eye(len(wrenches)) + wrenches @ wrenches.T
        right = random.standard_normal(len(wrenches))
        slots = structure.elimination.position[np.flatnonzero(state == 1)]
        x = np.zeros_like(work.rhs)
        x[slots] = right.reshape(-1, 6)
        solve_panels.dispatcher(work.panels, x, False)
        np.testing.assert_allclose(dense @ x[slots].ravel(), right, atol=1e-8)


@pytest.mark.usefixtures("interpreted")
def test_elimination_says_when_a_matrix_is_not_positive() -> None:
    structure = build_structure(build_problem(library.build("arch:blocks=7")))
    work = make_scratch(structure)
    pairs, _ = restrict(structure, np.array([1] * 7 + [2, 2], np.uint8), work)
    assert not factor_admm.dispatcher(structure, work, pairs, -2.0)
    work.panels.upper[:] = np.nan
    assert not factor_panels.dispatcher(structure.elimination.supernode, work.panels, True)


def test_one_order_serves_every_state(assembly: Assembly) -> None:
    """The pattern holds every pair of free parts, its rows ascend, and no part comes twice."""
    problem = build_problem(assembly)
    pattern = eliminate(problem)
    assert sorted(pattern.order.tolist()) == np.flatnonzero(~assembly.boundary).tolist()
    np.testing.assert_array_equal(pattern.order[pattern.position[pattern.order]], pattern.order)
    assert (pattern.position[assembly.boundary] == -1).all()
    owners = np.repeat(np.arange(len(pattern.start) - 1), np.diff(pattern.start))
    np.testing.assert_array_equal(owners, pattern.supernode)
    for a, b in np.sort(pattern.position[problem.pair_parts], axis=1).tolist():
        owner = pattern.supernode[a] if a >= 0 else -1
        rows = pattern.row[pattern.row_start[owner] : pattern.row_start[owner + 1]] if a >= 0 else np.array([])
        assert a < 0 or b < pattern.start[owner + 1] or b in rows
    for s, end in enumerate(pattern.start[1:]):
        rows = pattern.row[pattern.row_start[s] : pattern.row_start[s + 1]]
        assert (np.diff(rows) > 0).all()
        assert (rows >= end).all()


@pytest.mark.parametrize(("cone", "iterations"), [("octagon", 0), ("octagon", 5), ("quadratic", 5)])
def test_the_interior_point_method_needs_little_to_start_from(scenes: Any, cone: str, iterations: int) -> None:
    """It settles every state within its steps even where ADMM has hardly begun."""
    assembly = library.build("arch:blocks=7,thickness=0.2")
    states = np.unique(scenes.few_changes(assembly, 60, seed=6), axis=0)
    numerics = NumericalSettings(iterations=iterations, check_every=1000, threads=1)
    settings = StabilitySettings(criterion="equilibrium", cone=cone, numerics=numerics)  # type: ignore[arg-type]
    verdicts = CpuSolver(build_problem(assembly, cone=cone), settings).check(states)  # type: ignore[arg-type]
    moving = (states == 1).any(axis=1)
    assert (verdicts.iterations[moving] > iterations).all()
    np.testing.assert_array_equal(verdicts.verdict, ExactSolver(assembly, settings).check(states).verdict)


@pytest.mark.parametrize("gravity", [0.0, -9.81, np.nan, np.inf])
def test_gravity_must_be_positive(gravity: float) -> None:
    with pytest.raises(InputError, match="gravity"):
        StabilitySettings(gravity=gravity)


def test_cones_are_named() -> None:
    with pytest.raises(InputError, match="octagon or quadratic"):
        StabilitySettings(cone="hexagon")  # type: ignore[arg-type]


def test_an_inertia_that_is_not_positive_is_named(scenes: Any) -> None:
    tower = scenes.tower(2)
    inertia = tower.mass.inertia.copy()
    inertia[1, 0, 0] = -1.0
    broken = dataclasses.replace(tower, mass=dataclasses.replace(tower.mass, inertia=inertia))
    with pytest.raises(AssemblyError, match="part 1"):
        build_problem(broken)


def test_verdicts_on_joined_parts_are_verdicts_on_states() -> None:
    """Of states that differ in a part from stable ones; held parts divide the others into pieces."""
    assembly = load_structure("vault:parts=40")
    problem, rng = build_problem(assembly), np.random.default_rng(0)
    origins = np.repeat(complete_state(assembly.boundary)[None], 60, axis=0)
    loose = np.flatnonzero(~assembly.boundary)
    for origin in origins:
        origin[rng.choice(loose, len(loose) // 2, replace=False)] = HELD
        origin[rng.choice(loose, 3, replace=False)] = REMOVED
    exact = ExactSolver(assembly, EQUILIBRIUM, problem)
    origins = origins[exact.check(origins).stable]
    states = origins.copy()
    for state in states:
        state[rng.choice(np.flatnonzero((state == HELD) & ~assembly.boundary))] = INSTALLED
        state[rng.choice(np.flatnonzero((state != REMOVED) & ~assembly.boundary))] = REMOVED
    joined = problem.hold_apart(states, origins)
    apart = joined != states
    assert (states[apart] == INSTALLED).all()
    assert (joined[apart] == HELD).all()
    assert apart.any(axis=1).sum() > len(states) // 3
    expected = exact.check(states).verdict
    assert {-1, 1} <= set(expected.tolist())
    np.testing.assert_array_equal(exact.check(joined).verdict, expected)
    np.testing.assert_array_equal(problem.hold_apart(states, states), states)


def test_what_the_exact_solver_finds_on_joined_parts_starts_the_next_states() -> None:
    """Forces elsewhere are those of the state near by, so that what is remembered balances the whole."""
    assembly = load_structure("vault:parts=40")
    settings = replace(EQUILIBRIUM, numerics=NumericalSettings(iterations=1, check_every=1, interior_steps=0))
    oracle = StabilityOracle(assembly, settings)
    complete = complete_state(assembly.boundary)
    loose = np.flatnonzero(~assembly.boundary)
    origin = complete.copy()
    origin[loose[::2]] = HELD
    state = origin.copy()
    state[loose[0]] = INSTALLED
    assert oracle.verdicts(origin).stable.all()
    assert oracle.verdicts(state, near=origin).stable.all()
    assert oracle.counters.exact > 0
    forces = oracle.guesses.get(state)
    assert forces is not None
    claim = oracle.settings.claim
    assert residual_of_forces(assembly, state[None], forces[None], claim)[0] <= claim.tolerance
