"""Unstable equilibria: closed forms of what tips, the checker of their proofs, and plans that leave them out."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
import pytest

from falsework import (
    Assembly,
    Outcome,
    PlannerSettings,
    StabilityOracle,
    StabilitySettings,
    Verdict,
    find_plans,
    verify_certificates,
)
from falsework.assembly import Joints, complete_state, library
from falsework.geometry import TriangleMesh
from falsework.search.plans.plan_check import validate_plan
from falsework.stability import Proof, Verdicts
from falsework.stability.contact.replay import Replayer
from falsework.stability.motion import motion_of
from falsework.stability.second_order.growth import NEUTRAL, growth_of_motion
from falsework.stability.stiffness import SETTLEMENT

pytestmark = pytest.mark.filterwarnings("ignore::falsework.assembly.touching.ContactWarning")

DIAMOND = np.pi / 4
PRISM_FACES = np.array(
    [(0, 1, 2), (0, 2, 3), (4, 6, 5), (4, 7, 6)]
    + [face for k in range(4) for face in ((k, 4 + k, (k + 1) % 4), ((k + 1) % 4, 4 + k, 4 + (k + 1) % 4))]
)


def checked(assembly: Assembly, state: Any = None) -> Verdicts:
    """Verdict of one state, by default the complete structure, whose certificate the checker accepts."""
    states = np.asarray(complete_state(assembly.boundary) if state is None else state, np.uint8)[None]
    verdicts = StabilityOracle(assembly).verdicts(states, require_certificate=True)
    assert verify_certificates(assembly, states, verdicts).all()
    return verdicts


def verdict_of(assembly: Assembly, state: Any = None) -> Verdict:
    return Verdict(int(checked(assembly, state).verdict[0]))


def box(
    scenes: Any, low: Sequence[float], high: Sequence[float], *, turn: Any = None, lift: float = 0.0
) -> TriangleMesh:
    mesh = scenes.box(low, high, "box", turn)
    return TriangleMesh.from_arrays("box", mesh.vertices + [0.0, 0.0, lift], mesh.faces)


def on_ground(scenes: Any, *meshes: TriangleMesh, friction: float = 0.6) -> Assembly:
    return scenes.make([box(scenes, [-5, -5, -1], [5, 5, 0]), *meshes], [0], friction=friction)


def on_edge(scenes: Any, lift: float = 0.0) -> TriangleMesh:
    """Cube of 1 m on an edge along y, its centre of mass above it."""
    turn = scenes.about_y(DIAMOND)
    return box(scenes, [-0.5, -0.5, -0.5], [0.5, 0.5, 0.5], turn=turn, lift=np.sqrt(0.5) + lift)


def corner_down(scenes: Any) -> TriangleMesh:
    """Cube with its diagonal upright."""
    turn = scenes.about_y(-np.arctan(np.sqrt(2.0))) @ scenes.about_z(-DIAMOND)
    mesh = box(scenes, [0, 0, 0], [1, 1, 1], turn=turn)
    return TriangleMesh.from_arrays("cube", mesh.vertices - [0.0, 0.0, mesh.vertices[:, 2].min()], mesh.faces)


@pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
@pytest.mark.parametrize("thick", [1e-4, 5e-4])
def test_a_thin_plate_tips_away_from_a_wall_that_it_touches(scenes: Any, thick: float, scale: float) -> None:
    """The wall is so much stiffer than the plate is heavy that it bears the foot by almost no motion."""
    corners = [([0, 0, 0], [thick, 1, 2]), ([-3, -1, -1], [3, 2, 0]), ([-1, 0, 0], [0, 1, 2])]
    boxes = [box(scenes, [scale * x for x in low], [scale * x for x in high]) for low, high in corners]
    assert verdict_of(scenes.make(boxes, [1, 2], friction=0.5)) is Verdict.TIPS


@pytest.mark.parametrize(("sets", "tips"), [([], None), ([((0, 0), (3, 0), (4, 1))], 2)])
def test_glue_that_has_not_set_keeps_nothing_from_tipping(scenes: Any, sets: Any, tips: int | None) -> None:
    corners = [([0, 0, 0], [5e-4, 1, 2]), ([-3, -1, -1], [3, 2, 0]), ([-1, 0, 0], [0, 1, 2])]
    plate = scenes.make([box(scenes, *ends) for ends in corners], [1, 2])
    glued = (plate.contacts.parts == (0, 2)).all(axis=1)
    strong = np.where(glued, 1e5, 0.0)
    plate = plate.replace(joints=Joints.from_arrays(plate.contacts, tension=strong, cohesion=strong, setting=sets))
    states, replayer = np.array([[0, 2, 2], [2, 2, 2], [1, 2, 2]], np.uint8), Replayer(plate)
    replay = replayer.replay(states)
    assert replay.good
    assert replayer.first_tipping(states, replay.histories) == tips


@pytest.mark.parametrize("friction", [0.0, 0.6])
def test_a_cube_tips_over_an_edge_and_a_corner_but_not_on_a_face(scenes: Any, friction: float) -> None:
    assert verdict_of(on_ground(scenes, box(scenes, [0, 0, 0], [1, 1, 1]), friction=friction)) is Verdict.STABLE
    assert verdict_of(on_ground(scenes, on_edge(scenes), friction=friction)) is Verdict.TIPS
    # On its corner nothing fixes the turn about the vertical axis, so that iterations may not end.
    assert verdict_of(on_ground(scenes, corner_down(scenes), friction=friction)) in (Verdict.TIPS, Verdict.SLIDES)


def test_a_cube_on_its_edge_falls_as_a_pendulum_stands_on_its_head(scenes: Any) -> None:
    """It turns about the edge: the moment `m g h` over `m (h^2 + l^2)` is the growth times `g / l`."""
    assembly = on_ground(scenes, on_edge(scenes))
    verdicts = checked(assembly)
    assert verdicts.proof[0] == Proof.MOTION
    motion = motion_of(assembly, verdicts, 0)
    assert motion is not None
    edge = motion[1, :3] + np.cross(motion[1, 3:], [0.0, 0.0, -np.sqrt(0.5)])
    np.testing.assert_allclose(edge, 0.0, atol=1e-3)  # its springs are compressed as they turn
    np.testing.assert_allclose(motion[1, [3, 5]], 0.0, atol=1e-5)
    height, gyration = np.sqrt(0.5), np.sqrt(1 / 6)
    state, claim = complete_state(assembly.boundary)[None], StabilitySettings().claim
    assert verdicts.displacement is not None
    growth = growth_of_motion(assembly, state, verdicts.displacement, motion[None], claim)
    np.testing.assert_allclose(growth, height * gyration / (height**2 + gyration**2), rtol=1e-3)


@pytest.mark.parametrize("size", [1e-3, 1.0, 1e3])
def test_a_needle_tips_beyond_the_slenderness_of_its_joint(scenes: Any, size: float) -> None:
    """Springs at the corners of its foot hold a moment of `k w^4 / 4` a radian, and weight releases `m g h / 2`.

    With `k = rho g / SETTLEMENT` they are equal at `h / w = 1 / sqrt(2 SETTLEMENT)`, about 707, whatever the size.
    """
    critical = 1.0 / np.sqrt(2.0 * SETTLEMENT)
    for slenderness, expected in ((0.99, Verdict.STABLE), (1.01, Verdict.TIPS), (14.0, Verdict.TIPS)):
        ground = scenes.box([-size, -size, -size], [2 * size, 2 * size, 0.0])
        needle = scenes.box([0, 0, 0], [size, size, slenderness * critical * size])
        assert verdict_of(scenes.make([needle, ground], [1])) is expected


@pytest.mark.parametrize("share", [0.97, 1.03])
def test_a_column_of_drums_tips_as_a_chain_of_springs(scenes: Any, share: float) -> None:
    """Rigid drums with rotations `t_k` on joints of stiffness `c = k w^4 / 4`, without their shear.

    Joints store `c (t_k - t_(k-1))^2 / 2`, and the weights above and half of its own release `h t_k^2 / 2` each. The
    eigenvalue at which both are equal scales with the square of the height over the width of a drum.
    """
    drums = 6
    links = np.eye(drums) - np.eye(drums, k=-1)
    above = drums - np.arange(drums) - 0.5
    stiffest = np.linalg.eigvalsh(np.diag(above**-0.5) @ links.T @ links @ np.diag(above**-0.5))[0]
    height = np.sqrt(stiffest / (4.0 * SETTLEMENT)) * share
    boxes = [scenes.box([0, 0, k * height], [1, 1, (k + 1) * height], f"drum-{k}") for k in range(drums)]
    column = scenes.make([*boxes, scenes.box([-1, -1, -1], [2, 2, 0], "ground")], [drums])
    assert verdict_of(column) is (Verdict.STABLE if share < 1 else Verdict.TIPS)


def test_a_plate_across_a_groove_tips_without_friction(scenes: Any) -> None:
    """Its edges slide on both slopes, like a trammel: its centre is highest where it is level."""

    def grooved(friction: float) -> Assembly:
        # Parallelograms: the slope from the origin outwards above, and its image one metre below.
        def slope(side: int) -> TriangleMesh:
            profile = np.array([[0, 0], [3 * side, 3], [3 * side, 2], [0, -1]])[::side]
            vertices = [[x, y, z] for y in (-2, 2) for x, z in profile]
            return TriangleMesh.from_arrays("slope", np.array(vertices, float), PRISM_FACES[:, ::-1])

        return scenes.make([slope(1), slope(-1), box(scenes, [-1, -1, 1], [1, 1, 1.2])], [0, 1], friction=friction)

    assert verdict_of(grooved(0.0)) is Verdict.TIPS
    assert verdict_of(grooved(0.6)) is Verdict.STABLE


@pytest.mark.parametrize("first", [True, False])
def test_a_prism_on_two_rails_tips_without_friction(scenes: Any, first: bool) -> None:
    """Its lower faces slide over the rails: its edge below runs on a circle at twice the angle, by which it falls.

    So its centre of mass, `l` above that edge, is highest where it is upright if `l > 4 d` with rails `2 d` apart.
    """
    apart = 0.9 * np.sqrt(0.5) / 4.0
    prism = on_edge(scenes, lift=-apart)
    rails = [box(scenes, [-1, -1, -1], [-apart, 1, 0]), box(scenes, [apart, -1, -1], [1, 1, 0])]
    meshes = [prism, *rails] if first else [*rails, prism]
    fixed = [1, 2] if first else [0, 1]
    assert verdict_of(scenes.make(meshes, fixed, friction=0.0)) is Verdict.TIPS
    assert verdict_of(scenes.make(meshes, fixed, friction=1.2)) is Verdict.STABLE


def rocking_stone(scenes: Any, *, beside: float) -> Assembly:
    """A stone on a block, with its centre of mass `beside` beyond the edge of the block."""
    block = box(scenes, [0, 0, 0], [1, 1, 1])
    stone = box(scenes, [0.5 + beside, 0, 1], [1.5 + beside, 1, 2])
    return scenes.make([block, stone], [0])


def test_a_stone_that_balances_on_the_edge_of_another_tips(scenes: Any) -> None:
    """Half of it overhangs, so that forces balance it and nothing brings it back; a little less rests."""
    assert verdict_of(rocking_stone(scenes, beside=-0.01)) is Verdict.STABLE
    assert verdict_of(rocking_stone(scenes, beside=0.0)) is Verdict.TIPS
    assert verdict_of(rocking_stone(scenes, beside=0.01)) is Verdict.UNSTABLE


def test_a_stone_above_the_joint_of_two_others_rests(scenes: Any) -> None:
    """One of the two may settle more, so that the other bears all with its edge; then a small motion closes the gap."""
    boxes = [scenes.box([0, 0, 0], [1, 1, 1]), scenes.box([1, 0, 0], [2, 1, 1]), scenes.box([0.5, 0, 1], [1.5, 1, 2])]
    for extra in ([], [scenes.box([1.6, 0, 1], [2, 1, 4])]):
        assembly = scenes.make([*boxes, *extra, scenes.box([-1, -1, -1], [3, 2, 0])], [3 + len(extra)])
        assert verdict_of(assembly) is Verdict.STABLE


def test_holding_a_part_keeps_it_from_tipping(scenes: Any) -> None:
    assembly = rocking_stone(scenes, beside=0.0)
    assert verdict_of(assembly, [2, 2]) is Verdict.STABLE


def test_the_checker_refuses_other_motions(scenes: Any) -> None:
    assembly = rocking_stone(scenes, beside=0.0)
    states = complete_state(assembly.boundary)[None]
    verdicts = checked(assembly)
    assert verdicts.velocity is not None
    assert verdicts.displacement is not None
    good = verdicts.velocity.copy()
    for wrong in (np.zeros(6), [0, 0, 1.0, 0, 0, 0], [0, 1.0, 0, 0, 0, 0], [1.0, 0, 0, 0, 0, 0], np.full(6, np.nan)):
        verdicts.velocity[0, 1] = wrong
        assert not verify_certificates(assembly, states, verdicts)[0]
    verdicts.velocity[:] = good
    verdicts.displacement[0, 1, 2] *= 1.01
    assert not verify_certificates(assembly, states, verdicts)[0]


def test_no_motion_of_a_cube_on_its_face_grows(scenes: Any) -> None:
    assembly = on_ground(scenes, box(scenes, [0, 0, 0], [1, 1, 1]))
    verdicts = checked(assembly)
    assert verdicts.displacement is not None
    states = np.repeat(complete_state(assembly.boundary)[None], 500, axis=0)
    motions = np.random.default_rng(0).standard_normal((500, 2, 6))
    rest = np.repeat(verdicts.displacement, 500, axis=0)
    assert (growth_of_motion(assembly, states, rest, motions, StabilitySettings().claim) <= NEUTRAL).all()


def test_turned_and_shifted_structures_tip_alike(scenes: Any) -> None:
    turn = scenes.about_z(0.7)
    for beside in (-0.01, 0.0):
        plain = rocking_stone(scenes, beside=beside)
        meshes = [
            TriangleMesh.from_arrays(mesh.name, mesh.vertices @ turn.T + [7.0, -3.0, 2.0], mesh.faces)
            for mesh in plain.meshes
        ]
        assert verdict_of(scenes.make(meshes, [0])) == verdict_of(plain)


@pytest.mark.parametrize("tips", [True, False])
def test_motions_grow_alike_whatever_stands_elsewhere(scenes: Any, tips: bool) -> None:
    """Parts of other blocks, held or free, change nothing for a cube on its edge, or on its face."""
    cube = on_edge(scenes) if tips else box(scenes, [-0.5, -0.5, 0], [0.5, 0.5, 1])
    towers = [box(scenes, [x, 3, 0.5 * k], [x + 0.5, 3.5, 0.5 * k + 0.5]) for x in (-3, 0, 3) for k in range(4)]
    alone, among = on_ground(scenes, cube), on_ground(scenes, *towers[:6], cube, *towers[6:])
    motion = motion_of(alone, checked(alone), 0)
    for free in (1, 2):
        state = np.full(among.part_count, free, dtype=np.uint8)
        state[0], state[7] = 2, 1
        other = motion_of(among, checked(among, state), 0)
        assert (other is not None) == (motion is not None) == tips
        if other is not None and motion is not None:
            np.testing.assert_allclose(np.abs(other[7]), np.abs(motion[1]), atol=1e-4)


def test_plans_leave_out_states_that_tip() -> None:
    """In a wall in running bond the last brick of a course may balance on half a brick, as it is reached."""
    assembly = library.build("wall:bricks=3,courses=4")
    replayer = Replayer(assembly)
    planning = find_plans(assembly, robots=2, settings=PlannerSettings(alternatives=3))
    assert len(planning.plans) == 3
    for plan in planning.plans:
        replay = replayer.replay(plan.states, presses=plan.presses_before)
        assert replayer.first_tipping(plan.states, replay.histories) is None
        assert validate_plan(plan, assembly).good


@pytest.mark.parametrize("deadline", [None, 60.0])
def test_a_structure_that_tips_or_slides_has_no_plan(scenes: Any, deadline: float | None) -> None:
    """What tips is refused before the search begins; what slides from rest is tried as it is built."""
    for assembly, words, reached in (
        (on_ground(scenes, on_edge(scenes)), "the complete structure tips, as its equilibrium is unstable", 0),
        (scenes.clamp(friction=0.55), "from rest the complete structure slides", 1),
    ):
        planning = find_plans(assembly, robots=1, deadline=deadline)
        assert not planning.plans
        assert planning.result.outcome is Outcome.NOT_FOUND
        assert planning.result.limit == words
        assert planning.result.reached == reached
