"""Discrete-element method: closed forms, contact history, and equilibrium of states at rest."""

from __future__ import annotations

import ast
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from curved_pairs import pair_on
from numpy.typing import NDArray
from settling import replay_by_discrete_elements, settle

import falsework.stability.judges
from falsework import Assembly, Plan, StabilityOracle, StabilitySettings, Verdict, find_plans, load_structure
from falsework.assembly import Loads, complete_state, library
from falsework.errors import InputError, StateError
from falsework.geometry import TriangleMesh
from falsework.stability import HoldSettings
from falsework.stability.contact.replay import Replayer
from falsework.stability.holds import HoldMode, Press
from falsework.stability.judges import discrete_elements
from falsework.stability.judges.discrete_elements import Build, BuildJudge, DiscreteElementSettings
from falsework.stability.judges.judgement import Judgement
from falsework.stability.stiffness import normal_stiffness

STANDS, OPEN, FALLS = 1, 0, -1
RIGID = HoldSettings(mode=HoldMode.FORCE)
GIVES_WAY = StabilitySettings(reserve=1.1, holds=HoldSettings(stiffness=5e6, mode=HoldMode.FORCE))
STIFF_CONTACTS = DiscreteElementSettings(stiffness=5.0)
SOFT_CONTACTS = DiscreteElementSettings(stiffness=0.05)  # on which states come to rest, or collapse, in few steps


@pytest.fixture(scope="module")
def pressed_plan() -> tuple[Assembly, Plan]:
    """A vault, and a plan of it in which robots press."""
    vault = library.build("vault:parts=30")
    plan = find_plans(vault, stability=GIVES_WAY, forces=False).plans[0]
    assert any(plan.presses)
    return vault, plan


def answer_of(assembly: Assembly, **settings: Any) -> int:
    """What becomes of the complete structure."""
    return int(settle(assembly, complete_state(assembly.boundary), replace(SOFT_CONTACTS, **settings)).stands[0])


@pytest.mark.parametrize("friction", [0.1, 0.55, 1.2])
@pytest.mark.parametrize(("azimuth", "scale"), [(0.0, 1.0), (0.7, 0.01), (2.1, 30.0)])
def test_a_block_slips_past_the_angle_of_friction(scenes: Any, friction: float, azimuth: float, scale: float) -> None:
    """Coulomb: it rests if and only if `tan(slope) <= mu`, whatever its size and the direction of the slope."""
    angle = np.arctan(friction)
    for offset, expected in ((-3e-3, STANDS), (3e-3, FALLS)):
        assert answer_of(scenes.slope(angle + offset, friction=friction, azimuth=azimuth, scale=scale)) == expected


@pytest.mark.parametrize("blocks", [1, 2, 5])
def test_a_stack_leans_as_far_as_the_harmonic_series(blocks: int) -> None:
    """Each centre of mass over the edge of the block below; one hundredth more and it tips."""
    assert answer_of(library.build(f"stack:blocks={blocks},overhang=0.99")) == STANDS
    assert answer_of(library.build(f"stack:blocks={blocks},overhang=1.01")) == FALLS


def test_an_arch_stands_above_the_critical_thickness() -> None:
    """Milankovitch: a semicircular arch of fine voussoirs needs a thickness of 0.1075 of its radius."""
    assert answer_of(library.build("arch:blocks=25,thickness=0.13")) == STANDS
    assert answer_of(library.build("arch:blocks=25,thickness=0.09")) == FALLS


def test_nothing_makes_two_walls_press_a_block(scenes: Any) -> None:
    """Forces in balance exist, since the walls may press as hard as they like; from nothing, they do not press."""
    clamp = scenes.clamp(friction=0.55)
    state = complete_state(clamp.boundary)
    assert (
        StabilityOracle(clamp, StabilitySettings(criterion="equilibrium"))
        .verdicts(state, require_certificate=True)
        .verdict[0]
        == Verdict.STABLE
    )
    assert answer_of(clamp) == FALLS


@pytest.mark.parametrize("tangential", [0.3, 0.7, 1.5])
def test_published_counterexamples_slide(public_structure: Callable[[str], Path], tangential: float) -> None:
    """Models A and H of Kao et al. (2022): a wedge and a block between two supports, in equilibrium on paper."""
    for name in ("cra-A", "cra-H"):
        assert answer_of(load_structure(public_structure(name)), tangential=tangential) == FALLS


def test_what_nothing_carries_falls(scenes: Any) -> None:
    """A block in the air falls at once; two that carry nothing but each other fall too."""
    tower = scenes.tower(3)
    settling = settle(tower, [[0, 1, 0, 2], [0, 1, 1, 2], [1, 0, 0, 2], [0, 0, 0, 2], [0, 1, 2, 2]], SOFT_CONTACTS)
    assert settling.stands.tolist() == [FALLS, FALLS, STANDS, STANDS, FALLS]
    assert np.isinf(settling.moved[0])
    assert settling.part[0] == 1
    assert settling.moved[3] == 0.0
    assert settling.part[3] == -1


def test_held_parts_carry(scenes: Any) -> None:
    """A block on a held one stands, though below the held one is nothing."""
    settling = settle(scenes.tower(3), [[0, 2, 1, 2]], SOFT_CONTACTS)
    assert settling.stands.tolist() == [STANDS]
    assert settling.part.tolist() == [2]


@pytest.mark.parametrize("scale", [0.01, 1.0, 30.0])
def test_springs_are_as_stiff_as_those_of_the_criterion(scenes: Any, scale: float) -> None:
    """A cube under its own weight goes down by what the springs of the criterion give."""
    cube = scenes.box([0, 0, 0], [scale] * 3, "cube")
    ground = scenes.box([0, 0, -scale], [scale, scale, 0], "ground")
    assembly = scenes.make([cube, ground], [1])
    weight = 9.81 * assembly.mass.mass[0]
    for stiffness in (0.05, 1.0):
        moved = settle(assembly, [1, 2], DiscreteElementSettings(stiffness=stiffness)).moved[0]
        assert moved == pytest.approx(weight / (stiffness * normal_stiffness(assembly).sum()), rel=1e-3)


def test_parts_come_in_unstressed(scenes: Any) -> None:
    """A column put under a beam that has already sunk on two others carries its own weight alone.

    Put up all at once, the three columns share the beam. Held or not, what is new moves nothing.
    """
    columns = [scenes.box([x, 0, 0], [x + 1, 1, 1], f"column-{x}") for x in (0, 2, 4)]
    beam = scenes.box([0, 0, 1], [5, 1, 2], "beam")
    assembly = scenes.make([*columns, beam, scenes.box([-1, -1, -1], [6, 2, 0], "ground")], [4])
    steps = [[1, 0, 1, 0, 2], [1, 0, 1, 2, 2], [1, 0, 1, 1, 2], [1, 2, 1, 1, 2], [1, 1, 1, 1, 2]]
    replay = replay_by_discrete_elements(assembly, steps, SOFT_CONTACTS)
    assert replay.stands.tolist() == [STANDS] * 5
    assert replay.moved[1] == replay.moved[3] == 0.0
    sinks = replay.moved[0]  # of an end column under its own weight
    assert replay.part[4] == 1
    assert replay.moved[4] == pytest.approx(sinks, rel=1e-2)
    assert settle(assembly, steps[4], SOFT_CONTACTS).moved[0] > 1.5 * sinks


@pytest.mark.parametrize("first", [0, 1])
def test_what_rests_in_a_curved_bed_stays_as_it_is(scenes: Any, first: int) -> None:
    """Two bodies in two troughs of one bed: what is done to one moves nothing of the other."""
    angle = np.radians(np.linspace(-40, 40, 41))
    edge = np.stack([np.sin(angle), 0 * angle, -np.cos(angle)], axis=1)
    across = np.stack([edge, edge + [0, 0.5, 0]], axis=1).reshape(-1, 3)
    a, b = (np.arange(40) * 2)[:, None], (np.arange(40) * 2 + 2)[:, None]
    facets = np.vstack([np.hstack([a, b, b + 1]), np.hstack([a, b + 1, a + 1])])
    pairs = [pair_on("circle", across + [3 * x, 0, 0], facets, np.array([0, 0, 0.3])) for x in range(2)]
    bodies = [TriangleMesh.from_arrays(f"body-{x}", pair.vertices[0], pair.faces) for x, pair in enumerate(pairs)]
    beds = [TriangleMesh.from_arrays(f"bed-{x}", pair.vertices[1], pair.faces) for x, pair in enumerate(pairs)]
    assembly = Assembly.from_meshes([*bodies, *beds], boundary=[2, 3], friction=0.6)
    assert assembly.contacts.curved is not None
    steps = np.array([[0, 0, 2, 2], [2, 0, 2, 2], [1, 0, 2, 2], [1, 2, 2, 2], [1, 1, 2, 2], [1, 0, 2, 2]])
    if first:
        steps[:, :2] = steps[:, 1::-1].copy()
    found = replay_by_discrete_elements(assembly, steps, SOFT_CONTACTS)
    assert found.stands.tolist() == [STANDS] * len(steps)
    assert found.part[[2, 4]].tolist() == [first, 1 - first]
    assert found.moved[[0, 1, 3, 5]].tolist() == [0.0] * 4


def test_a_part_under_hybrid_control_moves_along_the_force_alone(scenes: Any) -> None:
    """A held slab is pressed askew onto ground that is rough enough: all of its points go the way of the force.

    Its contact resists differently along every axis.
    """
    slab, block = scenes.box([0, 0, 0], [3, 1, 0.2], "slab"), scenes.box([5, 0, 0], [6, 1, 1], "block")
    assembly = scenes.make([slab, block, scenes.box([-1, -1, -1], [7, 2, 0], "ground")], [2], friction=3.0)
    force = np.array([0.5, -0.2, -1.0])
    build = Build(assembly, STIFF_CONTACTS, HoldSettings(mode=HoldMode.HYBRID))
    for state, press in (([2, 0, 2], {}), ([2, 2, 2], {}), ([2, 1, 2], {0: np.append(force, np.zeros(3)) * 1e4})):
        assert build.step(np.array(state, np.uint8), press)[0] == STANDS
    contacts = assembly.contacts
    newton = build.unstressed(np.ones((len(contacts.points), 3)))
    stiffness = -newton.friction[:, 0] / newton.gap
    for point in np.flatnonzero((contacts.parts[contacts.contact_of_point] == [0, 2]).all(axis=1)):
        normal, *_ = frame = contacts.frames[contacts.contact_of_point[point]]
        slide = -build.forces.friction[point] / (STIFF_CONTACTS.tangential * stiffness[point])
        moved = np.append(build.forces.gap[point], slide) @ frame
        assert normal @ moved != 0.0
        assert moved / np.linalg.norm(moved) == pytest.approx(-np.sign(moved[2]) * force / np.linalg.norm(force))


def test_a_part_that_is_held_again_stays_pressed(scenes: Any) -> None:
    """Taking a part and letting it go once more changes nothing; removing it and putting it back loosens it."""
    tower = scenes.tower(2)
    steps = [[1, 0, 2], [1, 2, 2], [1, 1, 2], [1, 2, 2], [1, 1, 2], [1, 2, 2], [1, 0, 2], [1, 2, 2], [1, 1, 2]]
    replay = replay_by_discrete_elements(tower, steps, SOFT_CONTACTS)
    assert replay.stands.tolist() == [STANDS] * 9
    loaded = replay.moved[2]
    assert replay.moved[[3, 4, 5]].tolist() == [0.0, 0.0, 0.0]
    assert replay.moved[8] == pytest.approx(loaded, rel=0.01)


def test_a_replay_ends_at_the_first_fall(scenes: Any) -> None:
    """The cube between two walls stands while a robot holds it, and what comes later is not asked."""
    steps = [[0, 2, 2], [2, 2, 2], [1, 2, 2], [0, 2, 2]]
    replay = replay_by_discrete_elements(scenes.clamp(friction=0.55), steps, SOFT_CONTACTS, holds=RIGID)
    assert replay.stands.tolist() == [STANDS, STANDS, FALLS]
    assert replay.part.tolist() == [-1, -1, 0]


@pytest.mark.parametrize("density", [1.0, 2000.0])
def test_a_held_part_settles_by_weight_over_stiffness(scenes: Any, density: float) -> None:
    """A cube put down on a held one in the air: both sink by `w / k`; the robot bears the held one from the start."""
    tower = scenes.tower(3, density=density)
    weight = 9.81 * density
    steps = [[0, 2, 0, 2], [0, 2, 2, 2], [0, 2, 1, 2]]
    found = replay_by_discrete_elements(tower, steps, STIFF_CONTACTS, holds=HoldSettings(stiffness=1e3 * weight))
    assert found.stands.tolist() == [STANDS] * 3
    assert found.moved[:2].tolist() == [0.0, 0.0]
    assert found.moved[2] == pytest.approx(1e-3, rel=2e-3)
    rigid = replay_by_discrete_elements(tower, steps, STIFF_CONTACTS, holds=RIGID)
    assert rigid.moved[2] < 1e-6


def test_a_held_part_turns_by_moment_over_stiffness(scenes: Any) -> None:
    """A cube put down on the end of a held beam: the beam turns by `w e / (k r^2)`, r^2 = (4^2 + 1^2) / 12."""
    beam, cube = scenes.box([0, 0, 2], [4, 1, 3], "beam"), scenes.box([3, 0, 3], [4, 1, 4], "cube")
    assembly = scenes.make([beam, cube, scenes.box([0, 0, 0], [1, 1, 1], "ground")], [2])
    stiffness = 1e4 * 9.81 * assembly.mass.mass[1]
    holds = HoldSettings(stiffness=stiffness)
    found = replay_by_discrete_elements(assembly, [[2, 2, 2], [2, 1, 2]], STIFF_CONTACTS, holds=holds)
    turn = 1e-4 * 1.5 / (17 / 12)
    of_cube = np.hypot(turn * 1.0, 1e-4 + turn * 1.5) + turn * np.sqrt(3) / 2
    of_beam = 1e-4 + turn * np.linalg.norm([4, 1, 1]) / 2
    assert found.stands.tolist() == [STANDS] * 2
    assert found.moved[1] == pytest.approx(max(of_cube, of_beam), rel=0.01)


def test_what_a_held_part_bears_has_a_history(scenes: Any) -> None:
    """A cube on a held one is taken away again: the robot's spring lifts the held one back by what it had sunk."""
    tower = scenes.tower(3)
    holds = HoldSettings(stiffness=1e3 * 9.81 * tower.mass.mass[0])
    steps = [[0, 2, 2, 2], [0, 2, 1, 2], [0, 2, 0, 2], [0, 2, 0, 2]]
    found = replay_by_discrete_elements(tower, steps, STIFF_CONTACTS, holds=holds)
    assert found.moved[[1, 2]] == pytest.approx(1e-3, rel=2e-3)
    assert found.moved[3] == 0.0


@pytest.fixture
def pressed(scenes: Any) -> tuple[Assembly, float, NDArray[np.float64]]:
    """Two plates on a slope steeper than friction; the press on the upper one that the lower one needs, and its normal.

    The lower plate slides on the slab and under the upper one, which a robot holds: both contacts resist. It stands if
    and only if `w sin a <= mu (w cos a + N) + mu N`.
    """
    angle, friction = 0.7, 0.5
    turn = scenes.about_y(angle)
    plates = [scenes.box([-0.5, -0.5, 0.05 * k], [0.5, 0.5, 0.05 * (k + 1)], f"plate-{k}", turn) for k in range(2)]
    assembly = scenes.make([*plates, scenes.box([-1, -1, -0.1], [1, 1, 0], "slab", turn)], [2], friction=friction)
    weight = 9.81 * assembly.mass.mass[0]
    least = weight * (np.sin(angle) - friction * np.cos(angle)) / (2 * friction)
    return assembly, least, turn @ [0.0, 0.0, 1.0]


@pytest.mark.parametrize("mode", ["force", "hybrid"])
@pytest.mark.parametrize("stiffness", [1e8, np.inf])
def test_a_press_holds_a_block_on_a_slope(
    pressed: tuple[Assembly, float, Any], stiffness: float, mode: HoldMode
) -> None:
    """Just enough force holds it, a little less does not; when the robot lets go as well, both slide."""
    assembly, least, normal = pressed
    steps = [[0, 0, 2], [2, 0, 2], [2, 2, 2], [1, 2, 2], [1, 1, 2]]
    holds = HoldSettings(stiffness=stiffness, mode=mode)
    for share, expected in ((1.03, [STANDS] * 4 + [FALLS]), (0.97, [STANDS] * 3 + [FALLS])):
        press = Press(1, (*(-share * least * normal).tolist(), 0.0, 0.0, 0.0))
        presses = [(), (), (), (press,), ()]
        found = replay_by_discrete_elements(assembly, steps, STIFF_CONTACTS, presses=presses, holds=holds)
        assert found.stands.tolist() == expected
    unpressed = replay_by_discrete_elements(assembly, steps, STIFF_CONTACTS, holds=holds)
    assert unpressed.stands.tolist() == [STANDS] * 3 + [FALLS]


@pytest.mark.parametrize(
    ("presses", "message"),
    [
        ([()], "presses are given for 1 states; expected 3"),
        ([(), (Press(1, (0.0,) * 6),), ()], "a robot presses block-1 in the step to state 1, but does not hold it"),
        ([(Press(0, (0.0,) * 6),), (), ()], "a robot presses block-0 in the step to state 0, but does not hold it"),
        ([(), (Press(2, (0.0,) * 6),), ()], "a robot presses ground in the step to state 1, but does not hold it"),
    ],
)
def test_presses_are_checked(scenes: Any, presses: list[tuple[Press, ...]], message: str) -> None:
    with pytest.raises(InputError, match=message):
        replay_by_discrete_elements(scenes.tower(2), [[2, 0, 2], [2, 2, 2], [1, 2, 2]], presses=presses)


@pytest.mark.parametrize("rigid", [False, True])
def test_a_plan_with_presses_can_be_built(pressed_plan: tuple[Assembly, Plan], rigid: bool) -> None:
    """Every state of it stands; rigid robots fix held parts again after each press."""
    vault, plan = pressed_plan
    holds = RIGID if rigid else plan.claim.holds
    found = replay_by_discrete_elements(vault, plan.states, STIFF_CONTACTS, presses=plan.presses_before, holds=holds)
    assert found.stands.tolist() == [STANDS] * len(plan.states)


def test_a_plan_for_an_arch_can_be_built() -> None:
    """Each state of a plan that robots support on the way stands."""
    arch = library.build("arch:blocks=7")
    plan = find_plans(arch).plans[0]
    replay = replay_by_discrete_elements(arch, plan.states, SOFT_CONTACTS)
    assert len(replay.stands) == len(plan.states)
    assert (replay.stands == STANDS).all()


@pytest.mark.parametrize("name", ["arch", "dome:rings=3", "wall"])
def test_what_rests_is_in_equilibrium(scenes: Any, name: str) -> None:
    """At rest the contact forces lie in the friction cones and balance gravity, so the solvers must find some too."""
    assembly = library.build(name)
    states = scenes.random_states(assembly, 30, seed=5, shares=(0.05, 0.85, 0.1))
    settling = settle(assembly, states, SOFT_CONTACTS)
    verdicts = StabilityOracle(assembly).verdicts(states, require_certificate=True).verdict
    assert (settling.stands != OPEN).all()
    assert (verdicts[settling.stands == STANDS] == Verdict.STABLE).all()
    assert (settling.stands == STANDS).any()
    assert (settling.stands == FALLS).any()


def test_too_few_steps_leave_a_state_open(scenes: Any) -> None:
    settling = settle(scenes.tower(2), [1, 1, 2], DiscreteElementSettings(steps=500))
    assert settling.stands.tolist() == [OPEN]


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"tangential": 0.0}, "tangential is 0.0; give a positive number"),
        ({"stiffness": np.inf}, "stiffness is inf; give a positive number"),
        ({"damping": 1.5}, "damping is 1.5; give a number from 0 to 1"),
        ({"ramp": 0}, "ramp is 0; give at least 1"),
        ({"steps": 0}, "steps is 0; give at least 1"),
        ({"slower": 0}, "slower is 0; give at least 1"),
    ],
)
def test_settings_are_checked(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        DiscreteElementSettings(**values)


def test_a_state_rests_with_the_forces_that_prove_it(shared_assembly: Callable[[str], Path]) -> None:
    """Also where gravity on the unstressed structure makes parts slide far before they stop."""
    assembly = load_structure(str(shared_assembly("dome-37")))
    states = find_plans(assembly, forces=False).plans[0].states[::9]
    verdicts = StabilityOracle(assembly).verdicts(states, require_certificate=True)
    assert verdicts.stable.all()
    found = settle(assembly, states, forces=verdicts.forces)
    assert (found.stands == 1).all()
    assert (found.moved == 0.0).all()
    with pytest.raises(InputError, match="forces have shape"):
        settle(assembly, states[:1], forces=verdicts.forces)


def test_parts_that_jam_between_nearly_parallel_joints_stand(public_structure: Callable[[str], Path]) -> None:
    """The stones of a flat vault slip before they jam; LMGC90 says that it stands."""
    vault = load_structure(str(public_structure("barrel-vault-121")))
    found = settle(vault, complete_state(vault.boundary), STIFF_CONTACTS)
    assert found.stands[0] == STANDS
    assert found.moved[0] < 1e-3


def test_states_are_checked(scenes: Any) -> None:
    for judge in (settle, replay_by_discrete_elements):
        with pytest.raises(StateError, match="boundary part 2 as 1"):
            judge(scenes.tower(2), [1, 1, 1])


def test_a_judge_builds_plans_from_where_they_differ(monkeypatch: pytest.MonkeyPatch) -> None:
    """What it says does not depend on the plans before, nor on where it was stopped."""
    arch = library.build("arch:blocks=7,thickness=0.13")
    states = find_plans(arch).plans[0].states
    other = states.copy()
    other[6:, 3] = np.where(other[6:, 3] == 2, 1, other[6:, 3])  # a part that nothing holds any more
    none: list[tuple[Press, ...]] = [()] * len(states)
    judge = BuildJudge(arch)
    for some in (states, other, states[:9], states):
        assert judge.judge(some, none[: len(some)]) == BuildJudge(arch).judge(some, none[: len(some)])
    assert judge.judge(states, none) == Judgement(len(states), len(states))
    stopped = BuildJudge(arch)
    asked = iter([False] * 5 + [True])
    assert stopped.judge(states, none, lambda: next(asked)) == Judgement(5, len(states))
    assert stopped.judge(states, none) == Judgement(len(states), len(states))
    broken, step = BuildJudge(arch), discrete_elements.Build.step

    def interrupted(self: discrete_elements.Build, state: Any, press: Any) -> Any:
        step(self, state, press)
        if (state == states[9]).all():
            raise KeyboardInterrupt
        return STANDS, 0.0, -1

    monkeypatch.setattr(discrete_elements.Build, "step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        broken.judge(states, none)
    monkeypatch.setattr(discrete_elements.Build, "step", step)
    assert broken.judge(states, none) == Judgement(len(states), len(states))


def test_a_judge_names_what_falls(scenes: Any) -> None:
    tower = scenes.tower(2)
    falls = [[0, 2, 2], [2, 2, 2], [0, 1, 2]]
    judgement = BuildJudge(tower).judge(falls, [()] * 3)
    assert judgement == Judgement(2, 3, falls_at=2, part=1)
    assert not judgement.stands
    assert judgement.to_dict() == {"built": 2, "of": 3, "falls_at": 2, "part": 1, "undecided": []}


@pytest.mark.parametrize("off", [-0.02, 0.02])
@pytest.mark.parametrize(("lean", "slope"), [(0.0, 0.3), (0.1, 0.3), (0.2, 0.1)])
def test_a_block_between_inclined_surfaces_slides_past_what_is_left_of_friction(
    scenes: Any, lean: float, slope: float, off: float
) -> None:
    """At the angle of friction less that of the surfaces, as in the criterion."""
    found = scenes.slope(slope, friction=np.tan(slope + lean + off))
    inclined = replace(found.contacts, lean=np.full(len(found.contacts.points), lean))
    found = replace(found, contacts=inclined)
    assert BuildJudge(found).judge([[2, 2], [1, 2]], [()] * 2).stands == (off > 0)
    assert Replayer(found).replay([[2, 2], [1, 2]]).good == (off > 0)


def test_what_touches_surfaces_too_inclined_to_bear_falls(scenes: Any) -> None:
    found = scenes.slope(0.0, friction=0.3)
    found = replace(found, contacts=replace(found.contacts, lean=np.full(len(found.contacts.points), 0.4)))
    judgement = BuildJudge(found).judge([[2, 2], [1, 2]], [()] * 2)
    assert judgement.falls_at == 1


@pytest.mark.parametrize(("gravity", "stands"), [(9.81, True), (1.62, False)])
def test_a_judge_knows_the_gravity(scenes: Any, gravity: float, stands: bool) -> None:
    """A force that friction bears on the earth pushes the block away on the moon."""
    tower, load = scenes.tower(1, friction=0.5), np.zeros((2, 6))
    load[0, 0] = 0.2 * 9.81 * tower.mass.mass[0]
    loaded = tower.replace(loads=Loads.from_arrays(2, wrench=load))
    assert BuildJudge(loaded, gravity=gravity).judge([[2, 2], [1, 2]], [()] * 2).stands == stands
    assert Replayer(loaded, StabilitySettings(gravity=gravity)).replay([[2, 2], [1, 2]]).good == stands


def test_the_judges_share_nothing_with_the_solvers() -> None:
    """They import what describes structures, holds and stiffness from this package, nothing that decides or proves."""
    folder = Path(falsework.stability.judges.__file__).parent
    criterion = ("falsework.stability.holds", "falsework.stability.stiffness")
    helpers = ("falsework.utils.lazy", "falsework.utils.models", "falsework.utils.quantity")
    described = ("falsework.assembly.", "falsework.geometry.", "falsework.errors", *criterion, *helpers)
    allowed = (*described, "falsework.stability.judges.")
    for path in folder.glob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = [alias.name for alias in node.names] if isinstance(node, ast.Import) else []
            if isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            for name in names:
                assert not name.startswith("falsework") or name.startswith(allowed), f"{path.name} imports {name}"
