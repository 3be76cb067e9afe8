"""The criterion `contact`: closed forms, sliding states in equilibrium, published models, and certificates."""

from __future__ import annotations

import dataclasses
from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from settling import settle

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict, load_structure, verify_certificates
from falsework.assembly import complete_state, empty_state, library
from falsework.errors import InputError
from falsework.geometry import TriangleMesh
from falsework.stability import Proof, Verdicts
from falsework.stability.certificate import residual_of_displacement
from falsework.stability.contact.build_verifier import BuildVerifier
from falsework.stability.contact.replay import Replayer
from falsework.stability.second_order.springs import springs_of_displacement
from falsework.stability.settings import EQUILIBRIUM

RATIOS = (0.4, 0.7, 1.0)
"""Tangential over normal stiffness: Mindlin's lie between 0.67 and 1."""


def verdict_of(assembly: Assembly, state: Any = None, settings: StabilitySettings = StabilitySettings()) -> Verdict:
    """Verdict of one state, by default the complete structure, whose certificate the checker accepts."""
    states = np.asarray(complete_state(assembly.boundary) if state is None else state, np.uint8)[None]
    verdicts = StabilityOracle(assembly, settings).verdicts(states, require_certificate=True)
    assert not verdicts.undecided.any()
    assert verify_certificates(assembly, states, verdicts, settings.claim).all()
    return Verdict(int(verdicts.verdict[0]))


@pytest.fixture(scope="module")
def public_structure() -> Callable[[str], Assembly]:
    """Load one of the public models; skips the test where the data is not there."""
    from tests.conftest import data_folder  # type: ignore[import-not-found]

    def find(name: str) -> Assembly:
        folder = data_folder()
        if folder is None or not (folder / "structures" / name).is_dir():
            pytest.skip(f"no public structure {name}: set FALSEWORK_DATA to the folder that holds structures/")
        return load_structure(folder / "structures" / name)

    return find


@pytest.mark.parametrize("cone", ["octagon", "quadratic"])
@pytest.mark.parametrize("friction", [0.0, 0.1, 0.55, 1.2])
@pytest.mark.parametrize("azimuth", [0.0, 0.7])
def test_a_block_slips_past_the_angle_of_friction(scenes: Any, cone: Any, friction: float, azimuth: float) -> None:
    """Where statics is determinate both criteria agree: it rests if and only if `tan(slope) <= mu`."""
    angle = np.arctan(friction)
    settings = StabilitySettings(cone=cone)
    if friction > 0:
        assert verdict_of(scenes.slope(angle - 2e-3, friction=friction, azimuth=azimuth), None, settings) == 1
    assert verdict_of(scenes.slope(angle + 2e-3, friction=friction, azimuth=azimuth), None, settings) == -1


@pytest.mark.parametrize("blocks", [1, 2, 5])
def test_a_stack_leans_as_far_as_the_harmonic_series(blocks: int) -> None:
    assert verdict_of(library.build(f"stack:blocks={blocks},overhang=0.99")) == Verdict.STABLE
    assert verdict_of(library.build(f"stack:blocks={blocks},overhang=1.01")) == Verdict.UNSTABLE


def test_an_arch_stands_above_the_critical_thickness() -> None:
    """Milankovitch 1907: a semicircular arch of fine voussoirs needs a thickness of 0.1075 of its radius."""
    assert verdict_of(library.build("arch:blocks=25,thickness=0.13")) == Verdict.STABLE
    assert verdict_of(library.build("arch:blocks=25,thickness=0.09")) == Verdict.UNSTABLE


def test_nothing_makes_two_walls_press_a_block(scenes: Any) -> None:
    """The walls may press as hard as they like, so forces in equilibrium exist; without prestress they do not."""
    clamp = scenes.clamp(friction=0.55)
    assert verdict_of(clamp, settings=EQUILIBRIUM) == Verdict.STABLE
    for ratio in (0.1, *RATIOS, 3.0):
        assert verdict_of(clamp, settings=StabilitySettings(stiffness_ratio=ratio)) == Verdict.SLIDES


def wedge(taper: float, friction: float) -> Assembly:
    """A block between two fixed ones whose sides lean by `taper` to the vertical; above 0 it is wider at the top."""
    faces = [(0, 1, 3), (0, 3, 2), (4, 6, 7), (4, 7, 5), (0, 4, 5), (0, 5, 1)]
    faces += [(2, 3, 7), (2, 7, 6), (0, 2, 6), (0, 6, 4), (1, 5, 7), (1, 7, 3)]
    shift = np.tan(taper)

    def prism(name: str, low: tuple[float, float], high: tuple[float, float]) -> TriangleMesh:
        corners = [(x, y, z) for a, b in (low, high) for y in (0.0, 1.0) for z, x in ((0.0, a), (1.0, b))]
        return TriangleMesh.from_arrays(name, np.array(corners), faces)

    middle = prism("wedge", (-0.5, -0.5 - shift), (0.5, 0.5 + shift))
    left = prism("left", (-2.0, -2.0), (-0.5, -0.5 - shift))
    right = prism("right", (0.5, 0.5 + shift), (2.0, 2.0))
    return Assembly.from_meshes([middle, left, right], boundary=[1, 2], friction=friction)


@pytest.mark.parametrize("friction", [0.2, 0.6])
@pytest.mark.parametrize("degrees", [3.0, 8.0])
def test_a_wedge_stands_if_and_only_if_it_is_wider_at_the_top(friction: float, degrees: float) -> None:
    """A wedge that is wider below is in equilibrium up to the angle of friction, and nothing presses it."""
    taper = np.deg2rad(degrees)
    assert verdict_of(wedge(taper, friction)) == Verdict.STABLE
    assert verdict_of(wedge(-taper, friction), settings=EQUILIBRIUM) == Verdict.STABLE
    assert verdict_of(wedge(-taper, friction)) == Verdict.SLIDES


def test_holding_a_part_can_take_force_away_from_its_neighbour() -> None:
    """Among random states some stand, and slide once another part is held, so holds are asked under `contact`."""
    found = False
    rng = np.random.default_rng(0)
    for name in ("arch:blocks=7", "dome"):
        assembly = library.build(name)
        oracle = StabilityOracle(assembly)
        states = np.where(assembly.boundary, 2, rng.choice([0, 1, 2], (300, assembly.part_count), p=[0.3, 0.5, 0.2]))
        states = states.astype(np.uint8)
        stable = states[oracle.verdicts(states).stable]
        for state in stable:
            free = np.flatnonzero(state == 1)
            held = np.repeat(state[None], len(free), axis=0)
            held[np.arange(len(free)), free] = 2
            if len(held) and oracle.verdicts(held).slides.any():
                found = True
    assert found


@pytest.mark.parametrize("scale", [1e-3, 1e3])
def test_verdicts_do_not_depend_on_size_density_or_gravity(scale: float) -> None:
    base = library.build("dome")
    meshes = [TriangleMesh.from_arrays(mesh.name, mesh.vertices * scale, mesh.faces) for mesh in base.meshes]
    scaled = Assembly.from_meshes(meshes, boundary=base.boundary, density=base.density * 7.0, friction=base.friction)
    rng = np.random.default_rng(1)
    states = np.where(base.boundary, 2, rng.choice([0, 1, 2], (80, base.part_count), p=[0.25, 0.6, 0.15]))
    expected = StabilityOracle(base).verdicts(states.astype(np.uint8))
    found = StabilityOracle(scaled, StabilitySettings(gravity=1.6)).verdicts(states.astype(np.uint8))
    np.testing.assert_array_equal(found.verdict, expected.verdict)
    assert set(expected.verdict.tolist()) >= {-1, 1}


@pytest.mark.parametrize("ratio", RATIOS)
def test_a_stable_state_is_in_equilibrium_and_an_unstable_one_does_not_stand(ratio: float) -> None:
    """The criterion is stricter than equilibrium under the same cone, and never contradicts its proofs."""
    assembly = library.build("dome")
    rng = np.random.default_rng(2)
    states = np.where(assembly.boundary, 2, rng.choice([0, 1, 2], (150, assembly.part_count), p=[0.25, 0.6, 0.15]))
    states = states.astype(np.uint8)
    contact = StabilityOracle(assembly, StabilitySettings(stiffness_ratio=ratio)).verdicts(states)
    statics = StabilityOracle(assembly, dataclasses.replace(EQUILIBRIUM, cone="quadratic")).verdicts(states)
    assert statics.stable[contact.stable | contact.slides].all()
    np.testing.assert_array_equal(contact.unstable, statics.unstable)


@pytest.mark.parametrize(
    ("name", "expected"),
    [
        ("cra-A", Verdict.SLIDES),
        ("cra-H", Verdict.SLIDES),
        ("cra-bridge", Verdict.STABLE),
        ("cra-shelf-stable", Verdict.STABLE),
        ("cra-shelf", Verdict.SLIDES),
        ("cra-shelf-s1", Verdict.SLIDES),
        ("cra-shelf-s2", Verdict.SLIDES),
        ("cra-shelf-s3", Verdict.SLIDES),
        ("cra-snake", Verdict.STABLE),
        ("cra-cubes", Verdict.STABLE),
        ("cra-concave-long", Verdict.STABLE),
        ("cra-concave-short", Verdict.STABLE),
        ("cra-cube-curve-short", Verdict.STABLE),
        ("cra-cube-curve-tall", Verdict.STABLE),
        ("cra-type-a", Verdict.STABLE),
        ("cra-type-b", Verdict.STABLE),
        ("cra-type-c", Verdict.STABLE),
        ("cra-type-d", Verdict.STABLE),
    ],
)
def test_models_of_coupled_rigid_block_analysis(
    public_structure: Callable[[str], Assembly], name: str, expected: Verdict
) -> None:
    """Models of Kao et al. 2022: all are in equilibrium; A and H are their examples of what slides all the same."""
    assembly = public_structure(name)
    assert verdict_of(assembly, settings=EQUILIBRIUM) == Verdict.STABLE
    assert verdict_of(assembly) == expected


def test_the_proofs_are_named_by_their_kind(scenes: Any) -> None:
    arch, clamp = library.build("arch:blocks=7"), scenes.clamp(friction=0.55)
    standing = StabilityOracle(arch).verdicts(complete_state(arch.boundary), require_certificate=True)
    assert standing.proof[0] == Proof.DISPLACEMENT
    sliding = StabilityOracle(clamp).verdicts(complete_state(clamp.boundary), require_certificate=True)
    assert sliding.proof[0] == Proof.FORCES


@pytest.fixture(scope="module")
def proven() -> tuple[Assembly, np.ndarray, Verdicts, StabilitySettings]:
    """A standing arch with its displacement."""
    arch, settings = library.build("arch:blocks=9"), StabilitySettings()
    states = complete_state(arch.boundary)[None]
    return arch, states, StabilityOracle(arch, settings).verdicts(states, require_certificate=True), settings


@pytest.mark.parametrize("factor", [0.0, 0.9, 1.1, -1.0, 1e3, np.nan, np.inf])
def test_other_displacements_are_rejected(proven: Any, factor: float) -> None:
    arch, states, verdicts, settings = proven
    with np.errstate(invalid="ignore"):
        forged = dataclasses.replace(verdicts, displacement=verdicts.displacement * factor)
    assert verify_certificates(arch, states, verdicts, settings.claim).all()
    assert not verify_certificates(arch, states, forged, settings.claim).any()


@pytest.mark.parametrize(("turn", "good"), [(0.0, True), (1e-6, True), (0.3, False)])
def test_a_part_that_turns_in_place_moves(scenes: Any, turn: float, good: bool) -> None:
    """On a smooth floor no force resists it: only the limit of movement refuses the certificates."""
    boxes = [scenes.box([-0.5, -0.5, 0], [0.5, 0.5, 1]), scenes.box([-1, -1, -1], [1, 1, 0])]
    block, settings = scenes.make(boxes, [1], friction=0.0), StabilitySettings()
    states = np.array([[0, 2], [1, 2]], np.uint8)
    verdicts = StabilityOracle(block, settings).verdicts(states[1:], require_certificate=True)
    displacement = verdicts.displacement + turn * np.eye(6)[5]
    forged = dataclasses.replace(verdicts, displacement=displacement)
    assert verify_certificates(block, states[1:], forged, settings.claim).tolist() == [good]
    verifier = BuildVerifier(block, settings.claim)
    first, last = Replayer(block, settings).certificates(states, [(), ()])
    assert not verifier.step(states[0], first).reason
    displacement = last.displacement.copy()
    displacement[-1, 0, 5] += turn
    proof = verifier.step(states[1], last._replace(displacement=displacement))
    assert bool(proof.reason) != good
    assert proof.moved >= turn * np.sqrt(0.75)


def test_the_forces_of_a_displacement_balance_by_another_formula(proven: Any) -> None:
    """Sums of forces and of their moments, part by part, agree that the forces hold every part."""
    arch, states, verdicts, settings = proven
    problem = StabilityOracle(arch, settings).problem
    forces = springs_of_displacement(arch, states, verdicts.displacement, settings.claim).forces[0]
    np.testing.assert_allclose(forces, verdicts.forces[0], atol=1e-6 * problem.weight)
    net, contacts = problem.gravity_wrench.copy(), arch.contacts
    on_b = np.einsum("pij,pi->pj", contacts.point_frames, forces)
    for part, sign in ((problem.geometry.part_a, -1.0), (problem.geometry.part_b, 1.0)):
        moment = np.cross(contacts.points - arch.mass.center[part], on_b)
        np.add.at(net, part, sign * np.hstack([on_b, moment]))
    free = states[0] == 1
    assert np.abs(net[free][:, :3]).max() < 1e-3 * problem.weight
    assert residual_of_displacement(arch, states, verdicts.displacement, settings.claim)[0] <= settings.tolerance


@pytest.mark.parametrize("settings", [{"criterion": "standing"}, {"stiffness_ratio": 0.0}, {"cone": "hexagon"}])
def test_wrong_settings_are_named(settings: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        StabilitySettings(**settings)


def test_a_part_without_contacts_falls() -> None:
    """The keystone of an arch, alone between its abutments."""
    arch = library.build("arch:blocks=7")
    state = np.where(arch.boundary, 2, 0).astype(np.uint8)
    middle = np.flatnonzero(~arch.boundary)[3]
    state[middle] = 1
    assert verdict_of(arch, state) == Verdict.UNSTABLE
    state[middle] = 2
    assert verdict_of(arch, state) == Verdict.STABLE


@pytest.mark.parametrize("kind", "abcd")
def test_two_blocks_with_leaning_joints_turned_in_steps(public_structure: Callable[[str], Assembly], kind: str) -> None:
    """Types a to d of Kao et al., turned by 30 degrees at a time about each axis: discrete elements agree on all 36."""
    base = public_structure(f"cra-type-{kind}")
    answers = set()
    for axis in range(3):
        for step in range(12):
            c, s = np.cos(np.deg2rad(30 * step)), np.sin(np.deg2rad(30 * step))
            turn = np.eye(3)
            i, j = (k for k in range(3) if k != axis)
            turn[i, i], turn[i, j], turn[j, i], turn[j, j] = c, -s, s, c
            meshes = [TriangleMesh.from_arrays(mesh.name, mesh.vertices @ turn.T, mesh.faces) for mesh in base.meshes]
            turned = Assembly.from_meshes(meshes, boundary=base.boundary, friction=base.friction, density=base.density)
            verdict = verdict_of(turned)
            assert (verdict == Verdict.STABLE) == (settle(turned, complete_state(turned.boundary)).stands[0] == 1)
            answers.add(verdict)
    assert len(answers) == 2


def test_a_step_from_the_displacement_before_takes_few_iterations_and_says_the_same() -> None:
    vault = load_structure("vault:parts=250")
    state, parts = complete_state(vault.boundary), np.argsort(-vault.mass.center[:, 2])[:4]
    oracle = StabilityOracle(vault)
    oracle.verdicts(state[None], near=state[None])
    iterations = np.zeros(2, dtype=int)
    for part, value in [(part, value) for part in parts for value in (2, 0)]:
        before, state = state, np.where(np.arange(len(state)) == part, value, state).astype(np.uint8)
        beside = oracle.verdicts(state[None], near=before[None])
        rest = StabilityOracle(vault).verdicts(state[None], near=before[None])
        assert beside.verdict[0] == rest.verdict[0] == Verdict.STABLE
        iterations += beside.iterations[0], rest.iterations[0]
    assert 3 * iterations[0] < 2 * iterations[1]  # both with those that look for what falls


def test_a_state_beside_known_ones_is_checked_from_their_displacements() -> None:
    arch = load_structure("arch")
    state = complete_state(arch.boundary)
    held = state.copy()
    held[np.flatnonzero(state == 1)[0]] = 2
    oracle = StabilityOracle(arch)
    assert oracle.verdicts(state, require_certificate=True).stable.all()
    verdict = oracle.verdicts(held, near=state, require_certificate=True)
    assert verdict.stable.all()
    assert verify_certificates(arch, held[None], verdict, oracle.settings.claim).all()
    falling = empty_state(arch.boundary)
    falling[np.flatnonzero(state == 1)[1]] = 1
    assert oracle.verdicts(falling, near=state, require_certificate=True).unstable.all()
