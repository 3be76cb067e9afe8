"""Joints with tensile strength: closed forms, agreement of independent methods, proofs, and replay history."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any

import numpy as np
import pytest
from settling import settle

from falsework import StabilityOracle, StabilitySettings, Verdict, find_plans, verify_certificates
from falsework.assembly import Joints, complete_state, fasten, library
from falsework.errors import InputError
from falsework.search.margins.demands import Demands, MarginOracle
from falsework.stability import ExactSolver
from falsework.stability.contact.replay import Replayer
from falsework.stability.gpu.solver import GpuSolver
from falsework.stability.margins.placement import placement_curve
from falsework.stability.problem import build_problem

CRITERIA = ("equilibrium", "contact")
EQUILIBRIUM = ("octagon", "quadratic")


def stands(assembly: Any, criterion: str = "contact", **settings: Any) -> bool:
    """Whether the complete structure stands; the checker has accepted the proof of the answer."""
    oracle = StabilityOracle(assembly, StabilitySettings(criterion=criterion, **settings))  # type: ignore[arg-type]
    verdicts = oracle.verdicts(complete_state(assembly.boundary), require_certificate=True)
    assert not verdicts.undecided.any()
    return bool(verdicts.stable[0])


def joined(assembly: Any, **values: Any) -> Any:
    return assembly.replace(joints=Joints.from_arrays(assembly.contacts, **values))


def hanging(scenes: Any) -> Any:
    """Part 1 hangs below part 0, which is fixed, by a face of 1 m2."""
    return scenes.make([scenes.box([0, 0, 1], [1, 1, 2], "beam"), scenes.box([0, 0, 0], [1, 1, 1], "block")], [0])


def bracket(scenes: Any, length: float = 0.5, height: float = 1.0) -> Any:
    """Part 1 juts out from the side of part 0, which is fixed."""
    wall = scenes.box([-1, 0, -1], [0, 1, 2], "wall")
    return scenes.make([wall, scenes.box([0, 0, 0], [length, 1, height], "bracket")], [0])


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_a_block_hangs_by_tension_times_area(scenes: Any, criterion: str, share: float) -> None:
    block = hanging(scenes)
    weight = 9.81 * block.mass.mass[1]
    assert stands(joined(block, tension=share * weight / 1.0), criterion) == (share > 1)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("tension", [0.0, 200.0])
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_cohesion_holds_a_block_on_a_slope(scenes: Any, criterion: str, tension: float, share: float) -> None:
    """`c A = W (sin a - mu cos a)`, whether the cone of Mohr and Coulomb is cut off at its tension or beneath."""
    angle, friction = 0.6, 0.3
    block = scenes.slope(angle, friction=friction)
    weight, area = 9.81 * block.mass.mass[0], 1.0
    cohesion = share * weight * (np.sin(angle) - friction * np.cos(angle)) / area
    assert stands(joined(block, cohesion=cohesion, tension=tension), criterion, cone="quadratic") == (share > 1)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_cohesion_without_friction(scenes: Any, criterion: str, share: float) -> None:
    """A block on a slope without friction: `c A = W sin a`."""
    block = scenes.slope(0.3, friction=0.0)
    cohesion = share * 9.81 * block.mass.mass[0] * np.sin(0.3)
    assert stands(joined(block, cohesion=cohesion), criterion, cone="quadratic") == (share > 1)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_a_block_hangs_by_two_magnets(scenes: Any, criterion: str, share: float) -> None:
    block = hanging(scenes)
    tension = share * 9.81 * block.mass.mass[1] / 2
    magnets = [{"parts": [0, 1], "at": [x, 0.5, 1.0], "tension": tension} for x in (0.2, 0.8)]
    assert stands(fasten(block, magnets), criterion) == (share > 1)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_screws_bear_shear_where_there_is_no_friction(scenes: Any, criterion: str, share: float) -> None:
    """Two screws through a block on a slope without friction: `2 S = W sin a`."""
    block = scenes.slope(0.3, friction=0.0)
    shear = share * 9.81 * block.mass.mass[0] * np.sin(0.3) / 2
    turn = scenes.about_y(0.3)
    at = [(turn @ [0.0, y, 0.0]).tolist() for y in (-0.3, 0.3)]
    screwed = fasten(block, [{"parts": [0, 1], "at": place, "tension": 1e3, "shear": shear} for place in at])
    assert stands(screwed, criterion, cone="quadratic") == (share > 1)


@pytest.mark.parametrize("criterion", CRITERIA)
@pytest.mark.parametrize("share", [0.98, 1.02])
def test_a_bracket_bears_the_moment_of_its_weight(scenes: Any, criterion: str, share: float) -> None:
    """`W l / 2 = t A h / 2`: the upper edge pulls by half of the tension, the lower one presses."""
    length, height = 0.5, 1.0
    block = bracket(scenes, length, height)
    weight, area = 9.81 * block.mass.mass[1], height
    tension = share * weight * length / (height * area)
    assert stands(joined(block, tension=tension, cohesion=50 * tension), criterion) == (share > 1)


def test_friction_of_a_pair_is_its_own(scenes: Any) -> None:
    """Of two blocks on one slope, the one whose joint is rough stays."""
    turn = scenes.about_y(0.4)
    slab = scenes.box([-1, -2, -0.1], [1, 2, 0], "slab", turn)
    blocks = [scenes.box([-0.5, y, 0], [0.5, y + 1, 0.05], f"block-{y}", turn) for y in (-1.5, 0.5)]
    pair = scenes.make([slab, *blocks], [0], friction=0.3)
    rough = Joints.from_entries([{"parts": ["block-0.5", "slab"], "friction": 0.5}], None, pair.names, pair.contacts)
    for criterion in CRITERIA:
        oracle = StabilityOracle(pair.replace(joints=rough), StabilitySettings(criterion=criterion, cone="quadratic"))
        assert oracle.verdicts([[2, 2, 1], [2, 1, 2]], require_certificate=True).stable.tolist() == [True, False]


def random_joints(assembly: Any, seed: int) -> Any:
    """Joints of every kind: dry, cones, cut cones and cylinders."""
    random = np.random.default_rng(seed)
    count = len(assembly.contacts)
    weight = 9.81 * assembly.mass.mass[~assembly.boundary].mean()
    typical = weight / assembly.contacts.areas.mean()
    flat = assembly.contacts.dimension == 2
    return joined(
        assembly,
        friction=random.choice([0.0, 0.2, 0.6, np.nan], count),
        cohesion=np.where(flat, random.choice([0.0, 0.3, 2.0, np.nan], count) * typical, 0.0),
        tension=np.where(flat, random.choice([0.0, 0.1, 1.0], count) * typical, 0.0),
    )


@pytest.mark.parametrize("structure", ["arch:blocks=7", "wall:bricks=3,courses=2", "corbel"])
@pytest.mark.parametrize("cone", EQUILIBRIUM)
def test_fast_exact_and_simplex_agree(scenes: Any, simplex: Callable[..., float], structure: str, cone: str) -> None:
    seen = set()
    for seed in range(3):
        assembly = random_joints(library.build(structure), seed)
        states = np.concatenate([scenes.few_changes(assembly, 3, seed), scenes.random_states(assembly, 3, seed)])
        states = np.unique(states, axis=0)
        settings = StabilitySettings(criterion="equilibrium", cone=cone)  # type: ignore[arg-type]
        oracle = StabilityOracle(assembly, settings)
        verdicts = oracle.verdicts(states, require_certificate=True)
        assert not verdicts.undecided.any()
        assert oracle.counters.rejected == 0
        assert verify_certificates(assembly, states, verdicts, settings.claim).all()
        exact = ExactSolver(assembly, settings).check(states)
        np.testing.assert_array_equal(verdicts.verdict, exact.verdict)
        assert verify_certificates(assembly, states, exact, settings.claim).all()
        seen |= set(verdicts.verdict.tolist())
        if cone == "octagon":
            for state, value in zip(states, verdicts.verdict, strict=True):
                assert (simplex(assembly, state) <= settings.tolerance) == (value == Verdict.STABLE)
    assert seen == {Verdict.STABLE, Verdict.UNSTABLE}


@pytest.mark.parametrize("structure", ["arch:blocks=7", "wall:bricks=3,courses=3", "corbel"])
def test_what_stands_in_contact_is_in_equilibrium(scenes: Any, structure: str) -> None:
    stable = 0
    for seed in range(4):
        assembly = random_joints(library.build(structure), seed)
        states = np.unique(scenes.random_states(assembly, 12, seed, (0.25, 0.65, 0.1)), axis=0)
        settings = StabilitySettings()
        verdicts = StabilityOracle(assembly, settings).verdicts(states, require_certificate=True)
        assert verify_certificates(assembly, states, verdicts, settings.claim)[~verdicts.undecided].all()
        exact = ExactSolver(assembly, StabilitySettings(criterion="equilibrium", cone="quadratic")).check(states)
        assert (exact.verdict[verdicts.stable] == Verdict.STABLE).all()
        assert (exact.verdict[verdicts.unstable] == Verdict.UNSTABLE).all()
        stable += int(verdicts.stable.sum())
    assert stable >= 3


def test_the_checker_refuses_more_tension_than_there_is(scenes: Any) -> None:
    block = hanging(scenes)
    weight = 9.81 * block.mass.mass[1]
    state = complete_state(block.boundary)[None]
    for criterion in CRITERIA:
        settings = StabilitySettings(criterion=criterion)
        verdicts = StabilityOracle(joined(block, tension=1.05 * weight), settings).verdicts(
            state, require_certificate=True
        )
        assert verify_certificates(joined(block, tension=1.05 * weight), state, verdicts, settings.claim).all()
        assert not verify_certificates(joined(block, tension=0.95 * weight), state, verdicts, settings.claim).any()
        assert not verify_certificates(block, state, verdicts, settings.claim).any()
        falls = StabilityOracle(joined(block, tension=0.95 * weight), settings).verdicts(
            state, require_certificate=True
        )
        assert verify_certificates(block, state, falls, settings.claim).all()
        assert not verify_certificates(joined(block, tension=1.05 * weight), state, falls, settings.claim).any()


def test_equilibrium_refuses_joints_that_set(scenes: Any) -> None:
    with pytest.raises(InputError, match="joints that set need the criterion contact"):
        StabilityOracle(setting_bracket(scenes, 3), StabilitySettings(criterion="equilibrium"))


def test_no_forces_are_proven_beside_the_bound_of_others(scenes: Any) -> None:
    """Both certificates bound the same residual: no velocity proves more than forces leave."""
    assembly = random_joints(library.build("arch:blocks=7"), 1)
    states = scenes.random_states(assembly, 30, 5)
    settings = StabilitySettings(criterion="equilibrium")
    verdicts = StabilityOracle(assembly, settings).verdicts(states, require_certificate=True)
    other = verdicts[np.arange(len(states))]
    other.verdict[:] = -verdicts.verdict
    assert not verify_certificates(assembly, states, other, settings.claim).any()


def test_a_torn_joint_stays_torn(scenes: Any) -> None:
    """A block hangs from a joint that a second block, hung below it, tears when the robot lets go of that."""
    boxes = [scenes.box([0, 0, 2 - k], [1, 1, 3 - k], f"block-{k}") for k in range(3)]
    chain = scenes.make(boxes, [0])
    weight = 9.81 * chain.mass.mass[1]
    states = np.array([[2, 0, 0], [2, 2, 0], [2, 1, 0], [2, 1, 2], [2, 1, 1]], np.uint8)
    for strength, falls_at in ((2.05, None), (1.95, 4), (0.95, 2)):
        assert Replayer(joined(chain, tension=strength * weight)).replay(states).falls_at == falls_at


def setting_bracket(scenes: Any, steps: int) -> Any:
    """A bracket glued to a wall with glue that sets, and three blocks to stack elsewhere meanwhile.

    Bearing the moment of its weight takes five sixths of the strength.
    """
    blocks = [scenes.box([-3, -3, level - 2], [-2, -2, level - 1], f"block-{level}") for level in range(3)]
    wall = scenes.box([-1, 0, -1], [0, 1, 4], "wall")
    yard = scenes.make([wall, scenes.box([0, 0, 0], [0.5, 1, 1], "bracket"), *blocks], [0, 2])
    glued = (yard.contacts.parts == (0, 1)).all(axis=1)
    weight = 9.81 * yard.mass.mass[1]
    return joined(
        yard,
        tension=np.where(glued, 0.6 * weight, 0.0),
        cohesion=np.where(glued, 50 * weight, 0.0),
        setting=[((0, 0), (steps, 1))],
        sets=np.where(glued, 0, -1),
    )


@pytest.mark.parametrize(("steps", "falls_at"), [(4, None), (5, 5)])
def test_glue_bears_what_it_has_set_to(scenes: Any, steps: int, falls_at: int | None) -> None:
    """Four steps after the bracket was placed the robot lets go; five sixths of five steps are more than four."""
    states = [[2, 0, 2, 0, 0], [2, 2, 2, 0, 0], [2, 2, 2, 2, 0], [2, 2, 2, 1, 0], [2, 2, 2, 1, 2], [2, 1, 2, 1, 2]]
    yard = setting_bracket(scenes, steps)
    assert Replayer(yard).replay(states).falls_at == falls_at
    assert StabilityOracle(yard).verdicts(states[-1], require_certificate=True).stable.all()  # once it has set
    replayer = Replayer(yard)
    history = replayer.replay(states[:1]).histories[0]
    stood = []
    for before, after in zip(np.array(states[:-1], np.uint8), np.array(states[1:], np.uint8), strict=True):
        stands_on, history = replayer.step(history, before, after)
        stood.append(stands_on)
    assert stood == [True] * 4 + [falls_at is None]


def test_a_plan_waits_for_the_glue(scenes: Any) -> None:
    yard = setting_bracket(scenes, 2)
    found = find_plans(yard, robots=2)
    assert found.found
    states = found.plans[0].states
    placed, let_go = (int(np.argmax(states[:, 1] == value)) for value in (2, 1))
    assert let_go - placed >= 2
    assert Replayer(yard).replay(states).good


def test_an_edge_that_tears_lets_the_rest_fall(scenes: Any) -> None:
    """A beam of two brackets glued on at both ends stands by less tension than one that is glued on at one end."""
    walls = [scenes.box([-1, 0, -1], [0, 1, 2], "left"), scenes.box([4, 0, -1], [5, 1, 2], "right")]
    beam = scenes.make([*walls, scenes.box([0, 0, 0], [2, 1, 1], "a"), scenes.box([2, 0, 0], [4, 1, 1], "b")], [0, 1])
    weight = 9.81 * beam.mass.mass[2]
    glued = joined(beam, tension=2.2 * weight, cohesion=10 * weight)
    for criterion in CRITERIA:
        oracle = StabilityOracle(glued, StabilitySettings(criterion=criterion))
        assert oracle.verdicts([[2, 2, 1, 1], [2, 2, 1, 0], [2, 2, 0, 1]], require_certificate=True).stable.all()
        weak = joined(beam, tension=1.8 * weight, cohesion=10 * weight)
        oracle = StabilityOracle(weak, StabilitySettings(criterion=criterion))
        assert oracle.verdicts([[2, 2, 1, 0], [2, 2, 0, 1]], require_certificate=True).unstable.all()


def test_a_ductile_joint_bears_on_where_a_brittle_one_tears(scenes: Any) -> None:
    """Three beams side by side bear a block: the stiff one in the middle reaches its tension before the others."""
    beams = [scenes.box([x, 0, 1], [x + 1, 1, 2], f"beam-{x}") for x in (0, 1, 2)]
    block = scenes.make([*beams, scenes.box([0, 0, 0], [3, 1, 1], "block")], [0, 1, 2])
    weight = 9.81 * block.mass.mass[3]
    middle = (block.contacts.parts[:, 0] == 1) & (block.contacts.dimension == 2)
    # The outer contacts bear half of the weight each; the middle one only a tenth, where elasticity asks for a third.
    tension = np.where(middle, 0.1 * weight, 0.47 * weight)
    assert stands(joined(block, tension=tension, ductile=True), "contact")
    assert stands(joined(block, tension=tension), "equilibrium")
    assert not stands(joined(block, tension=tension), "contact")


def test_strength_beyond_all_loads_changes_nothing(scenes: Any) -> None:
    for criterion in CRITERIA:
        assert stands(joined(bracket(scenes), tension=1e12), criterion)


def test_margins_know_joints(scenes: Any) -> None:
    """The largest factor on the weight of a hanging block is its tension over its weight."""
    block = hanging(scenes)
    weight = 9.81 * block.mass.mass[1]
    for criterion in CRITERIA:
        oracle = StabilityOracle(joined(block, tension=3.0 * weight), StabilitySettings(criterion=criterion))
        (found,) = oracle.margins(complete_state(block.boundary), ["load_factor"])
        assert found.load_factor is not None
        assert found.load_factor.value == pytest.approx(3.0, rel=0.011)
    slope = scenes.slope(0.2, friction=0.5)
    rough = joined(slope, cohesion=9.81 * slope.mass.mass[0] * 0.1)
    (found,) = StabilityOracle(rough, StabilitySettings(criterion="equilibrium", cone="quadratic")).margins(
        complete_state(slope.boundary), ["friction"]
    )
    assert found.friction is not None
    assert found.friction.value == pytest.approx(np.tan(0.2) - 0.1 / np.cos(0.2), rel=0.011)


def test_judges_and_gpus_refuse_joints(scenes: Any) -> None:
    block = joined(hanging(scenes), tension=1e5)
    with pytest.raises(InputError, match="joints are not checked on a GPU"):
        GpuSolver(block, build_problem(block), StabilitySettings())
    with pytest.raises(InputError, match="does not support joints"):
        settle(block, complete_state(block.boundary))


@pytest.mark.parametrize(("share", "expected"), [(2.0, 1.0), (0.95, 0.0)])
def test_joints_keep_their_strength_per_area_where_parts_are_placed_with_an_error(
    scenes: Any, share: float, expected: float
) -> None:
    """A block that hangs by glue, off by a thousandth of its width."""
    block = hanging(scenes)
    glued = joined(block, tension=share * 9.81 * block.mass.mass[1], setting=[[[0, 0], [3, 1]]])
    curve = placement_curve(
        glued,
        complete_state(block.boundary),
        [1e-3],
        lambda moved, states: StabilityOracle(moved).verdicts(states).stable,
        draws=5,
    )
    assert curve.shares.tolist() == [[expected]]
    assert curve.refused.tolist() == [0]
    again = glued.joints.recomputed(glued.contacts, glued.contacts)
    for mine, theirs in zip(again.arrays, glued.joints.arrays, strict=True):
        np.testing.assert_allclose(mine, theirs)


def test_what_is_fastened_at_points_takes_no_placement_errors(scenes: Any) -> None:
    block = fasten(hanging(scenes), [{"parts": [0, 1], "at": [0.5, 0.5, 1.0], "tension": 1e5}])
    refused = "contacts of this structure were given, or have fasteners or studs"
    with pytest.raises(InputError, match=refused):
        placement_curve(block, complete_state(block.boundary), [1e-3], lambda moved, states: states[:, 0] > 0, draws=1)
    with pytest.raises(InputError, match=refused):
        MarginOracle(block, demands=Demands(placement=1e-3))
