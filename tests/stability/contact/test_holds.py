"""Robots that hold: springs with limits, presses that let a part rest, and the proof of a build that contains both."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from msgspec import structs
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, StabilitySettings, find_plans
from falsework.assembly import Joints, Loads, complete_state
from falsework.errors import InputError
from falsework.stability import HoldSettings
from falsework.stability.contact.build_verifier import BuildVerifier, StepCertificate, StepProof
from falsework.stability.contact.newton import MOVES_AWAY, OVERLOADS, RESTS
from falsework.stability.contact.press_kernel import press_responses
from falsework.stability.contact.replay import Replayer
from falsework.stability.holds import HoldMode, Press, inexact_presses, limits_of
from falsework.stability.stiffness import normal_stiffness

SOFT = HoldSettings(stiffness=1e4)
FORCE, HYBRID = HoldSettings(mode=HoldMode.FORCE), HoldSettings(mode=HoldMode.HYBRID)
"""Holds that give way so much that what they take over from contacts is less than a thousandth."""
ON_HELD = np.array([[0, 2, 0, 2], [0, 2, 2, 2], [0, 2, 1, 2]], np.uint8)
"""A tower of three in mid-air: a robot holds the second block, and the third is placed on it and let go."""
BESIDE = np.array([[2, 0, 2], [2, 2, 2], [1, 2, 2]], np.uint8)
"""A plate at a wall is let go while a robot holds another plate beside it."""
PLATE, PRESSER = 0, 1
THICK = 0.2
"""Thickness of the plates, m; they are 1 m high and wide."""


def settings(holds: HoldSettings, reserve: float = 1.0) -> StabilitySettings:
    return StabilitySettings(holds=holds, reserve=reserve)


def weight_of(assembly: Assembly, part: int) -> float:
    return float(9.81 * assembly.mass.mass[part])


def beside_wall(scenes: Any, friction: float = 0.5) -> Assembly:
    """Two plates beside a wall in the plane of y and z, with nothing below them; the second touches only the first."""
    plates = [scenes.box([k * THICK, 0, 0], [(k + 1) * THICK, 1, 1], f"plate-{k}") for k in (0, 1)]
    return scenes.make([*plates, scenes.box([-1, -1, -1], [0, 2, 2], "wall")], [2], friction=friction)


def push(force: float, part: int = PRESSER) -> Press:
    """Press of a force against the wall, N."""
    return Press(part, (-force, 0.0, 0.0, 0.0, 0.0, 0.0))


def proofs_of(
    assembly: Assembly, states: NDArray, presses: Any, of: StabilitySettings, claim: Any = None
) -> list[StepProof]:
    """Proofs of the certificates of a replay under some settings, by default with the claim of these."""
    verifier = BuildVerifier(assembly, claim or of.claim)
    steps = list(Replayer(assembly, of).certificates(states, presses))
    return [verifier.step(state, step) for state, step in zip(states, steps, strict=True)]


# Springs


@pytest.mark.parametrize("stiffness", [1e7, 1e8])
@pytest.mark.parametrize("beside", [0.0, 0.1])
def test_a_hold_settles_by_the_weight_that_it_takes_over(scenes: Any, stiffness: float, beside: float) -> None:
    """By `W / k`, and it turns by the moment `W e` over `k r^2`, with the square of the gyration `r^2 = 1/6`."""
    boxes = [scenes.box([0, 0, k], [1, 1, k + 1]) for k in (0, 1)]
    boxes += [scenes.box([beside, 0, 2], [1 + beside, 1, 3]), scenes.box([-1, -1, -1], [2, 2, 0])]
    tower, holds = scenes.make(boxes, [3]), HoldSettings(stiffness=stiffness)
    replay = Replayer(tower, settings(holds)).replay(ON_HELD)
    assert replay.good
    weight = weight_of(tower, 2)
    moved = replay.histories[-1].displacement[1]
    np.testing.assert_allclose(moved[:3], [0, 0, -weight / stiffness], rtol=1e-3, atol=1e-3 * weight / stiffness)
    turned = 6.0 * weight * beside / stiffness
    np.testing.assert_allclose(moved[3:], [0, turned, 0], rtol=1e-3, atol=1e-3 * weight / stiffness)
    # Nothing moves before the block is let go: it came with its own robot.
    assert not replay.histories[1].displacement.any()
    wrench = proofs_of(tower, ON_HELD, replay.presses, settings(holds))[-1].wrenches[1]
    np.testing.assert_allclose(wrench[2], 2 * weight, rtol=1e-3)
    np.testing.assert_allclose(wrench[4], -weight * beside, atol=1e-3 * weight)


@pytest.mark.parametrize("ratio", [0.1, 1.0, 3.0])
def test_a_hold_and_the_joint_below_share_a_weight_like_parallel_springs(scenes: Any, ratio: float) -> None:
    tower = scenes.tower(2)
    joint = tower.contacts.contact_of_point == tower.contacts.contact_of_point.max()
    stiffness = float(normal_stiffness(tower)[joint].sum())  # all joints are alike
    holds = settings(HoldSettings(stiffness=ratio * stiffness))
    states = np.array([[2, 0, 2], [2, 2, 2], [2, 1, 2]], np.uint8)
    replay = Replayer(tower, holds).replay(states)
    assert replay.good
    weight = weight_of(tower, 1)
    settled = -replay.histories[-1].displacement[0, 2]
    np.testing.assert_allclose(settled, weight / (stiffness * (1 + ratio)), rtol=1e-3)
    borne = proofs_of(tower, states, replay.presses, holds)[-1].wrenches[0, 2]
    np.testing.assert_allclose(borne, weight * (1 + ratio / (1 + ratio)), rtol=1e-3)


def test_a_rigid_hold_does_not_move(scenes: Any) -> None:
    tower, rigid = scenes.tower(3), settings(HoldSettings(stiffness=np.inf))
    replay = Replayer(tower, rigid).replay(ON_HELD)
    assert replay.good
    assert not replay.histories[-1].displacement[1].any()
    proof = proofs_of(tower, ON_HELD, replay.presses, rigid)[-1]
    np.testing.assert_allclose(proof.wrenches[1, 2], 2 * weight_of(tower, 2), rtol=1e-3)


def test_a_hold_that_takes_over_from_what_is_removed_settles_too(scenes: Any) -> None:
    """The robot took the block as it stood, without a load; what stood below it goes."""
    tower, holds = scenes.tower(2), settings(HoldSettings(stiffness=1e8))
    states = np.array([[1, 1, 2], [1, 2, 2], [0, 2, 2]], np.uint8)
    replay = Replayer(tower, holds).replay(states)
    assert replay.good
    settled = replay.histories[1].displacement[1, 2] - replay.histories[2].displacement[1, 2]
    np.testing.assert_allclose(settled, weight_of(tower, 1) / 1e8, rtol=1e-3)
    assert all(proof.residual <= 1e-4 for proof in proofs_of(tower, states, replay.presses, holds))


@pytest.mark.parametrize("sets", [False, True])
def test_a_hold_from_which_a_glued_block_is_taken_springs_back(scenes: Any, sets: bool) -> None:
    """By `W / k`, too, where the glue is of a kind that sets, and has."""
    boxes = [scenes.box([0, 0, k], [1, 1, k + 1]) for k in (1, 2)]
    boxes += [scenes.box([5, 0, k], [6, 1, k + 1]) for k in (0, 1)]  # to wait for the glue
    chain, stiffness = scenes.make([*boxes, scenes.box([-1, -1, -1], [7, 2, 0])], [4]), 1e8
    weight, setting = weight_of(chain, 0), [((0, 0), (2, 1))] if sets else []
    glue = Joints.from_arrays(chain.contacts, tension=5 * weight, cohesion=5 * weight, setting=setting)
    chain, holds = chain.replace(joints=glue), HoldSettings(stiffness=stiffness)
    route = [[0, 2, 0, 0], [2, 2, 0, 0], [2, 2, 2, 0], [2, 2, 1, 0], [2, 2, 1, 2], [1, 2, 1, 2], [0, 2, 1, 2]]
    states = np.array([[*state, 2] for state in route], np.uint8)
    replay = Replayer(chain, settings(holds)).replay(states)
    assert replay.good
    risen = replay.histories[-1].displacement[1, 2] - replay.histories[-2].displacement[1, 2]
    np.testing.assert_allclose(risen, weight / stiffness, rtol=1e-3)
    assert all(proof.residual <= 1e-4 for proof in proofs_of(chain, states, replay.presses, settings(holds)))


@pytest.mark.parametrize("holds", [HoldSettings(), HoldSettings(stiffness=1e8)])
def test_what_gives_way_comes_to_rest_anew_as_the_glue_sets(scenes: Any, holds: HoldSettings) -> None:
    """A bracket on ductile glue that is pulled to its limit, while blocks are only held elsewhere."""
    walls = [scenes.box([-1, 0, -1], [0, 1, 0.25]), scenes.box([-1, 0, 0.25], [0, 1, 2])]
    boxes = [scenes.box([0, 0, 0], [1, 1, 0.5]), scenes.box([5, 0, 0], [6, 1, 1]), scenes.box([4, -1, -1], [7, 2, 0])]
    yard = scenes.make([*boxes, *walls], [2, 3, 4])
    weight = weight_of(yard, 0)
    sets = [((0, 0), (1, 0.1), (5, 0.5), (20, 1))]
    glue = Joints.from_arrays(yard.contacts, tension=30 * weight, cohesion=20 * weight, ductile=True, setting=sets)
    yard = yard.replace(joints=glue)
    states = np.array([[*state, 2, 2, 2] for state in ([0, 0], [2, 0], [2, 0], [1, 0], [1, 2], [1, 2])], np.uint8)
    replay = Replayer(yard, settings(holds)).replay(states)
    assert replay.good
    assert all(proof.residual <= 1e-4 for proof in proofs_of(yard, states, replay.presses, settings(holds)))


# Limits


def test_a_robot_does_not_hold_a_part_whose_load_is_beyond_its_force(scenes: Any) -> None:
    """Neither a replay nor a search places it, since no proof of that would be accepted."""
    tower, load = scenes.tower(2), np.zeros((3, 6))
    load[1, 2] = -60 * weight_of(tower, 1)
    loaded = tower.replace(loads=Loads.from_arrays(3, wrench=load))
    replay = Replayer(loaded).replay(np.array([[0, 0, 2], [2, 0, 2], [1, 0, 2], [1, 2, 2]], np.uint8))
    assert replay.stands.tolist() == [RESTS, RESTS, RESTS, OVERLOADS]
    assert replay.part[-1] == 1
    assert not find_plans(loaded, robots=1).found


@pytest.mark.parametrize(("weights", "stands"), [(1.9, OVERLOADS), (2.1, RESTS)])
def test_a_robot_bears_no_more_than_its_force(scenes: Any, weights: float, stands: int) -> None:
    """It bears two blocks, where the one that it holds is let another be put on."""
    tower = scenes.tower(3)
    holds = settings(HoldSettings(force=weights * weight_of(tower, 0)))
    replay = Replayer(tower, holds).replay(ON_HELD)
    assert replay.stands[-1] == stands
    if stands == OVERLOADS:
        assert replay.part[-1] == 1
        assert replay.falls_at == 2


@pytest.mark.parametrize(("share", "stands"), [(0.95, OVERLOADS), (1.05, RESTS)])
def test_a_robot_bears_no_more_than_its_moment(scenes: Any, share: float, stands: int) -> None:
    beside = 0.2
    boxes = [scenes.box([0, 0, k], [1, 1, k + 1]) for k in (0, 1)]
    boxes += [scenes.box([beside, 0, 2], [1 + beside, 1, 3]), scenes.box([-1, -1, -1], [2, 2, 0])]
    tower = scenes.make(boxes, [3])
    holds = HoldSettings(stiffness=1e8, moment=share * beside * weight_of(tower, 2))
    assert Replayer(tower, settings(holds)).replay(ON_HELD).stands[-1] == stands


def test_limits_are_those_of_the_heaviest_part_that_moves(scenes: Any) -> None:
    tower = scenes.tower(2)
    weight = weight_of(tower, 0)
    limits = 50 * weight, 100 * weight * np.sqrt(1 / 6)
    np.testing.assert_allclose(limits_of(tower, HoldSettings()), limits)
    assert np.isinf(limits_of(tower, HoldSettings(force=0.0))).all()
    with pytest.raises(InputError, match=r"cannot carry part block-0, which weighs .* raise the largest force"):
        limits_of(tower, HoldSettings(force=0.9 * weight))


@pytest.mark.parametrize(
    ("wrong", "message"),
    [
        ({"stiffness": 0.0}, "the stiffness of holds is 0 N/m; give 1e-09 or more, inf for rigid"),
        ({"stiffness": np.nan}, "the stiffness of holds is nan N/m"),
        ({"force": -1.0}, "the largest force of holds is -1 N; give 0 or more"),
        ({"moment": np.nan}, "the largest moment of holds is nan N m; give more than 0"),
        ({"moment": 0.0}, "the largest moment of holds is 0 N m; give more than 0"),
    ],
)
def test_wrong_holds_are_named(wrong: dict[str, float], message: str) -> None:
    with pytest.raises(InputError) as caught:
        HoldSettings(**wrong)  # type: ignore[arg-type]
    assert message in str(caught.value)


# Presses


@pytest.mark.parametrize("friction", [0.3, 0.8])
@pytest.mark.parametrize("reserve", [1.0, 1.25])
def test_a_pressed_plate_rests_if_and_only_if_friction_at_the_wall_bears_it(
    scenes: Any, friction: float, reserve: float
) -> None:
    """`mu F >= W` at the wall, with friction divided by the reserve; the soft robot bears nothing of the plate."""
    assembly = beside_wall(scenes, friction)
    needed = reserve * weight_of(assembly, PLATE) / friction
    replayer = Replayer(assembly, settings(SOFT, reserve))
    for factor, stands in ((0.98, MOVES_AWAY), (1.02, RESTS)):
        given = push(factor * needed)
        replay = replayer.replay(BESIDE, presses=[(), (), (given,)])
        assert replay.stands[-1] == stands
        if stands == RESTS:
            assert replay.presses == ((), (), (given,))
            assert replay.histories[-1].presses == (given,)


@pytest.mark.parametrize("mode", [HoldMode.FORCE, HoldMode.HYBRID])
@pytest.mark.parametrize("stiffness", [1e4, 1e7, np.inf])
def test_robots_choose_presses_that_keep_the_plate(scenes: Any, stiffness: float, mode: HoldMode) -> None:
    assembly, holds = beside_wall(scenes), HoldSettings(stiffness=stiffness, mode=mode)
    replayer = Replayer(assembly, settings(holds))
    assert replayer.replay(BESIDE, presses=[()] * 3).falls_at == 2
    replay = replayer.replay(BESIDE)
    assert replay.good
    assert replay.presses[:2] == ((), ())
    (press,) = replay.presses[2]
    assert press.part == PRESSER
    assert press.force <= limits_of(assembly, holds)[0] * (1 + 1e-9)
    assert -press.wrench[0] > 0  # against the wall
    again = replayer.replay(BESIDE, presses=replay.presses)
    np.testing.assert_array_equal(again.histories[-1].springs, replay.histories[-1].springs)
    for inexact in inexact_presses(replay.presses[2]):
        assert replayer.replay(BESIDE, presses=[(), (), inexact]).good
    assert all(proof.residual <= 1e-4 for proof in proofs_of(assembly, BESIDE, replay.presses, settings(holds)))
    if mode is HoldMode.HYBRID:
        assert not any(press.wrench[3:])


@pytest.mark.parametrize("holds", [HoldSettings(mode=HoldMode.LOCKED), HoldSettings(force=0.0)])
def test_robots_that_may_not_press_do_not(scenes: Any, holds: HoldSettings) -> None:
    assembly = beside_wall(scenes)
    replay = Replayer(assembly, settings(holds)).replay(BESIDE)
    assert replay.stands[-1] == MOVES_AWAY
    assert replay.presses == ((), ())
    assert not holds.presses


@pytest.mark.parametrize("mode", [HoldMode.FORCE, HoldMode.HYBRID])
def test_robots_press_what_glue_does_not_hold_yet(scenes: Any, mode: HoldMode) -> None:
    """With as much force as on a dry joint."""
    dry, states = beside_wall(scenes), np.array([[0, 0, 2], [2, 0, 2], [2, 2, 2], [1, 2, 2]], np.uint8)
    strong = 50 * weight_of(dry, PLATE)
    glue = Joints.from_arrays(dry.contacts, tension=strong, cohesion=strong, setting=[((0, 0), (5, 0), (6, 1))])
    of = settings(HoldSettings(mode=mode))
    found = [Replayer(assembly, of).replay(states) for assembly in (dry, dry.replace(joints=glue))]
    assert all(replay.good for replay in found)
    (one,), (other,) = (replay.presses[-1] for replay in found)
    np.testing.assert_allclose(other.wrench, one.wrench, rtol=1e-6, atol=1e-6 * one.force)


def test_robots_that_are_too_weak_do_not_find_a_press(scenes: Any) -> None:
    assembly = beside_wall(scenes, friction=0.5)
    weak = settings(HoldSettings(stiffness=1e4, force=1.9 * weight_of(assembly, PLATE)))  # two weights are needed
    assert not Replayer(assembly, weak).replay(BESIDE).good


def test_robots_press_no_more_than_they_must(scenes: Any) -> None:
    """Where a release comes to rest without, none presses."""
    tower = scenes.tower(3)
    states = np.array([[1, 2, 0, 2], [1, 2, 2, 2], [1, 2, 1, 2], [1, 1, 1, 2]], np.uint8)
    replay = Replayer(tower).replay(states)
    assert replay.good
    assert replay.presses == ((), (), (), ())


@pytest.mark.parametrize("reserve", [1.0, 1.1, 1.5])
def test_a_reserve_divides_friction(scenes: Any, reserve: float) -> None:
    """Of verdicts and of replays: a block rests if and only if `tan(slope) <= mu / reserve`."""
    for offset, rests in ((-3e-3, True), (3e-3, False)):
        slope = scenes.slope(np.arctan(0.55 / reserve) + offset, friction=0.55)
        of, last = settings(HoldSettings(), reserve), complete_state(slope.boundary)
        assert StabilityOracle(slope, of).verdicts(last, require_certificate=True).stable[0] == rests
        states = np.stack([np.where(last == 1, k, last) for k in (0, 2, 1)])
        assert Replayer(slope, of).replay(states).good == rests


def test_forces_respond_to_presses_as_in_the_replay(scenes: Any) -> None:
    """Where all contacts stick and stay closed: the forces themselves, and finite differences of them."""
    assembly = beside_wall(scenes, friction=3.0)
    replayer = Replayer(assembly, settings(FORCE))
    before = replayer.replay(BESIDE[:2]).histories[-1]
    problem = replayer.problem
    index, forces = np.zeros(problem.points, np.int64), np.zeros((7, problem.points, 3))
    moves = np.zeros((7, 6))
    count = press_responses(
        replayer.law,
        BESIDE[1],
        BESIDE[2],
        np.array([PRESSER]),
        before.springs,
        before.torn,
        np.zeros(0),
        index,
        forces,
        moves,
    )
    assert count == problem.points

    def rest(wrench: NDArray) -> tuple[NDArray, NDArray]:
        press = Press(PRESSER, tuple(wrench.tolist()))
        replay = replayer.replay(BESIDE[1:], before, [(), (press,)])
        assert replay.good
        last = replay.histories[-1]
        assert (last.springs[:, 0] > 0).all()
        return last.springs[index], last.displacement[PRESSER]

    weight = weight_of(assembly, PLATE)
    base = np.array([-4 * weight, 0, 0, 0, 0, 0])
    springs, moved = rest(base)
    scale = np.abs(springs).max()
    linear = forces[0] + np.tensordot(problem.whitening[PRESSER] @ base, forces[1:], 1)
    np.testing.assert_allclose(linear, springs, atol=1e-3 * scale)
    for axis in range(6):
        step = 0.05 * weight * np.eye(6)[axis] * (1.0 if axis < 3 else 0.3)
        found, there = rest(base + step)
        expected = np.tensordot(problem.whitening[PRESSER] @ step, forces[1:], 1)
        np.testing.assert_allclose(found - springs, expected, atol=1e-2 * np.abs(expected).max())
        assert np.abs(there - moved).max() > 0


# Proofs of builds


@pytest.fixture(scope="module")
def pressed(scenes: Any) -> tuple[Assembly, StabilitySettings, list[StepCertificate]]:
    """The plate that rests under a press, with the certificates of its steps."""
    assembly, of = beside_wall(scenes), settings(FORCE)
    given = push(3 * weight_of(assembly, PLATE))
    steps = list(Replayer(assembly, of).certificates(BESIDE, [(), (), (given,)]))
    assert len(steps) == 3
    return assembly, of, steps


def last_proof(assembly: Assembly, claim: Any, states: NDArray, steps: list[StepCertificate]) -> StepProof:
    """Proof of the last state; those before it must be proven."""
    verifier = BuildVerifier(assembly, claim)
    proofs = [verifier.step(state, step) for state, step in zip(states, steps, strict=True)]
    assert all(proof.residual <= claim.tolerance for proof in proofs[:-1])
    return proofs[-1]


def test_a_build_with_a_press_is_proven(pressed: Any) -> None:
    assembly, of, steps = pressed
    proof = last_proof(assembly, of.claim, BESIDE, steps)
    assert proof.residual <= of.tolerance
    assert proof.reason == ""
    weight = weight_of(assembly, PLATE)
    # The robot bears its own plate and its press, less what little its spring of 1 MN/m loses.
    np.testing.assert_allclose(proof.wrenches[PRESSER, :3], [-3 * weight, 0, weight], atol=0.02 * weight)
    assert not proof.wrenches[PLATE].any()


@pytest.mark.parametrize("factor", [0.0, 0.9, 1.1, -1.0, 1e3, np.nan, np.inf])
def test_scaled_displacements_of_a_build_are_refused(pressed: Any, factor: float) -> None:
    assembly, of, steps = pressed
    with np.errstate(invalid="ignore"):
        forged = [*steps[:-1], steps[-1]._replace(displacement=steps[-1].displacement * factor)]
        assert not last_proof(assembly, of.claim, BESIDE, forged).residual <= of.tolerance


@pytest.mark.parametrize(
    ("presses", "reason"),
    [
        ((), "the certificate moves plate-1, which a rigid hold fixes"),
        ((push(1.0),), "the robot that holds plate-1 does not bear what its stiffness and its presses give"),
        ((push(1.0, PLATE),), "a robot presses plate-0, which it does not hold"),
        ((push(1.0), push(1.0)), "a part is pressed twice in one step"),
    ],
)
def test_other_presses_are_refused(pressed: Any, presses: tuple[Press, ...], reason: str) -> None:
    assembly, of, steps = pressed
    proof = last_proof(assembly, of.claim, BESIDE, [*steps[:-1], steps[-1]._replace(presses=presses)])
    assert proof.reason == reason
    assert proof.residual == np.inf


@pytest.mark.parametrize("factor", [0.99, 1.01, -1.0])
def test_presses_of_another_size_are_refused(pressed: Any, factor: float) -> None:
    assembly, of, steps = pressed
    (press,) = steps[-1].presses
    other = structs.replace(press, wrench=tuple(factor * value for value in press.wrench))
    proof = last_proof(assembly, of.claim, BESIDE, [*steps[:-1], steps[-1]._replace(presses=(other,))])
    assert "does not bear what its stiffness and its presses give" in proof.reason


@pytest.mark.parametrize(
    ("holds", "reason"),
    [
        ({"stiffness": 2e7}, "the robot that holds block-1 does not bear what its stiffness and its presses give"),
        ({"stiffness": 5e6}, "the robot that holds block-1 does not bear what its stiffness and its presses give"),
        ({"stiffness": np.inf}, "the certificate moves block-1, which a rigid hold fixes"),
        ({"force": 1.9}, "the robot that holds block-1 bears"),
    ],
)
def test_a_build_by_other_robots_is_refused(scenes: Any, holds: dict[str, float], reason: str) -> None:
    tower = scenes.tower(3)
    of = settings(HoldSettings(stiffness=1e7))
    steps = list(Replayer(tower, of).certificates(ON_HELD, [()] * 3))
    assert last_proof(tower, of.claim, ON_HELD, steps).residual <= of.tolerance
    other = {name: value * (weight_of(tower, 0) if name == "force" else 1.0) for name, value in holds.items()}
    proof = last_proof(tower, replace(of.claim, holds=HoldSettings(**other)), ON_HELD, steps)  # type: ignore[arg-type]
    assert proof.reason.startswith(reason)
    assert proof.residual == np.inf


@pytest.mark.parametrize("stiffness", [1e8, np.inf])
@pytest.mark.parametrize("before", [0, 1])
def test_a_certificate_may_not_push_a_part_as_a_robot_takes_it(scenes: Any, stiffness: float, before: int) -> None:
    """Neither one that it places, nor one that stands; nor may it lift the ground."""
    tower, of = scenes.tower(2), settings(HoldSettings(stiffness=stiffness))
    states = np.array([[1, before, 2], [1, 2, 2]], np.uint8)
    steps = list(Replayer(tower, of).certificates(states, [(), ()]))
    assert last_proof(tower, of.claim, states, steps).residual <= of.tolerance
    pushed, lifted = (steps[1].displacement.copy() for _ in range(2))
    pushed[0, :2, 2] -= 1e-6, 2e-6  # both joints are alike, so that the lower block stays in equilibrium
    lifted[0, 2, 2] += 1e-6
    last = last_proof(tower, of.claim, states, [steps[0], steps[1]._replace(displacement=pushed)])
    assert last.residual == np.inf
    assert "block-1" in last.reason
    last = last_proof(tower, of.claim, states, [steps[0], steps[1]._replace(displacement=lifted)])
    assert last.forces == pytest.approx(last_proof(tower, of.claim, states, steps).forces)


def test_a_moment_beyond_the_limit_is_refused(pressed: Any) -> None:
    assembly, of, steps = pressed
    borne = np.linalg.norm(last_proof(assembly, of.claim, BESIDE, steps).wrenches[PRESSER, 3:])
    for factor, good in ((0.99, False), (1.01, True)):
        weak = replace(of.claim, holds=replace(FORCE, moment=factor * float(borne)))
        proof = last_proof(assembly, weak, BESIDE, steps)
        assert (proof.residual <= of.tolerance) is good
        assert ("more than it can" in proof.reason) is not good


def test_less_friction_is_refused(scenes: Any) -> None:
    """A build whose friction is nearly used up is no proof for a reserve."""
    assembly, of = beside_wall(scenes), settings(SOFT)
    given = push(2.05 * weight_of(assembly, PLATE))
    steps = list(Replayer(assembly, of).certificates(BESIDE, [(), (), (given,)]))
    assert last_proof(assembly, of.claim, BESIDE, steps).residual <= of.tolerance
    assert not last_proof(assembly, replace(of.claim, reserve=1.1), BESIDE, steps).residual <= of.tolerance


def test_a_friction_history_that_was_changed_is_refused(scenes: Any) -> None:
    """What slid keeps its force, so the same movements in another order, or without those before, prove nothing."""
    assembly, of = beside_wall(scenes), settings(SOFT)
    given = push(2.05 * weight_of(assembly, PLATE))
    steps = list(Replayer(assembly, of).certificates(BESIDE, [(), (), (given,)]))
    assert last_proof(assembly, of.claim, BESIDE, steps).residual <= of.tolerance
    moves = steps[-1].displacement
    slipped = moves.copy()
    slipped[0, PLATE, 2] -= 1e-4  # slips down and up again: friction points the wrong way
    slipped[-1, PLATE, 2] += 1e-4
    for other in (slipped, moves[1:], np.concatenate([moves, moves[-1:]])):
        forged = [*steps[:-1], steps[-1]._replace(displacement=other)]
        assert not last_proof(assembly, of.claim, BESIDE, forged).residual <= of.tolerance
    # The step alone, without those before it: the robot comes with its part then, and nothing presses.
    assert not last_proof(assembly, of.claim, BESIDE[2:], steps[2:]).residual <= of.tolerance


@pytest.mark.parametrize("stiffness", [np.inf, 1e8])
def test_under_hybrid_control_a_part_moves_along_the_force_only(scenes: Any, stiffness: float) -> None:
    """A rigid robot keeps the pose across it; a soft one bears what its spring gives."""
    assembly = beside_wall(scenes, friction=0.8)
    of = settings(replace(HYBRID, stiffness=stiffness))
    weight = weight_of(assembly, PLATE)
    line = np.array([-1.0, 0.1, 0.2]) / np.linalg.norm([-1.0, 0.1, 0.2])
    given = Press(PRESSER, (*(4 * weight * line).tolist(), 0.0, 0.0, 0.0))
    (step,) = list(Replayer(assembly, of).certificates(BESIDE, [(), (), (given,)]))[-1:]
    moved = step.displacement[:, PRESSER].sum(axis=0)
    across = moved[:3] - (moved[:3] @ line) * line
    assert moved[:3] @ line > 0
    if np.isinf(stiffness):
        np.testing.assert_allclose(across, 0, atol=1e-12 * abs(moved[:3] @ line))
        assert not moved[3:].any()
    else:
        assert 0 < np.abs(across).max() < 0.1 * (moved[:3] @ line)
    proofs = proofs_of(assembly, BESIDE, ((), (), (given,)), of)
    assert all(proof.residual <= of.tolerance for proof in proofs)
    # Along the line the robot adds the press, less what its spring of 1 MN/m loses; it bore its own plate before.
    along = (proofs[-1].wrenches[PRESSER, :3] - [0, 0, weight]) @ line
    np.testing.assert_allclose(along, 4 * weight - 1e6 * (moved[:3] @ line), rtol=1e-3)


@pytest.mark.parametrize(
    ("wrench", "reason"),
    [
        (
            [-3.0, 0.0, 0.0, 0.0, 0.0, 0.1],
            "the robot that presses plate-1 adds a moment, which hybrid control does not",
        ),
        ([-3.0, 0.0, 0.6, 0.0, 0.0, 0.0], "the certificate moves plate-1, which a rigid hold fixes"),
        (
            [-3.6, 0.0, 0.0, 0.0, 0.0, 0.0],
            "the robot that holds plate-1 does not bear what its stiffness and its presses give",
        ),
    ],
)
def test_other_presses_under_hybrid_control_are_refused(scenes: Any, wrench: list[float], reason: str) -> None:
    assembly, of = beside_wall(scenes), settings(HYBRID)
    weight = weight_of(assembly, PLATE)
    given = push(3 * weight)
    steps = list(Replayer(assembly, of).certificates(BESIDE, [(), (), (given,)]))
    assert last_proof(assembly, of.claim, BESIDE, steps).reason == ""
    other = Press(PRESSER, tuple((weight * np.array(wrench)).tolist()))
    proof = last_proof(assembly, of.claim, BESIDE, [*steps[:-1], steps[-1]._replace(presses=(other,))])
    assert proof.reason == reason


def test_a_press_without_a_force_lets_nothing_move_under_hybrid_control(scenes: Any) -> None:
    tower = scenes.tower(3)
    states = np.array([[1, 2, 2, 2], [1, 2, 1, 2]], np.uint8)
    nothing = Press(1, (0.0,) * 6)
    replay = Replayer(tower, settings(HYBRID)).replay(states, presses=[(), (nothing,)])
    assert replay.good
    assert not replay.histories[-1].displacement[nothing.part].any()


@pytest.mark.parametrize("seed", range(8))
def test_what_comes_to_rest_under_a_press_in_any_direction_is_proven(scenes: Any, seed: int) -> None:
    """Solver and verifier measure what is left along the line of the press alike, whatever its direction."""
    rng = np.random.default_rng(seed)
    assembly = beside_wall(scenes, friction=0.8)
    line = np.array([-1.0, *rng.uniform(-0.5, 0.5, 2)])
    force = rng.uniform(3.0, 6.0) * weight_of(assembly, PLATE) * line / np.linalg.norm(line)
    given = Press(PRESSER, (*force.tolist(), 0.0, 0.0, 0.0))
    # A solver that is hardly better than what the verifier allows.
    loose = replace(settings(HYBRID), tolerance=1e-2)
    replay = Replayer(assembly, loose).replay(BESIDE, presses=[(), (), (given,)])
    assert replay.good
    assert all(proof.residual <= loose.tolerance for proof in proofs_of(assembly, BESIDE, replay.presses, loose))
