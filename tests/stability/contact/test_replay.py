"""Replays: rest with contact history, agreement with discrete elements, and independence of numerical settings."""

from __future__ import annotations

from concurrent.futures import ThreadPoolExecutor
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray
from settling import replay_by_discrete_elements

from falsework import Assembly, Plan, StabilityOracle, StabilitySettings, find_plans, make_task
from falsework.assembly import INSTALLED, complete_state, library
from falsework.errors import InputError
from falsework.search import BeamSearch, BeamSettings
from falsework.search.plans.acceptance import Acceptance
from falsework.search.problem.plan_replay import PlanReplay
from falsework.stability.certificate import residual_of_forces
from falsework.stability.contact.build_verifier import BuildVerifier
from falsework.stability.contact.history import ReplaySettings
from falsework.stability.contact.replay import Replayer
from falsework.stability.contact.varied_replay import replay_varied
from falsework.utils.interruption import PIECE


def plan_states(assembly: Assembly, robots: int = 2) -> NDArray[np.uint8]:
    """States of a plan in the order of assembly; the search has replayed it."""
    planning = find_plans(assembly, make_task(assembly, robots))
    assert planning.found
    return planning.plans[0].states


def replayed(assembly: Assembly, plan: Plan) -> PlanReplay:
    """Replay of a plan with its reserve and the robots and presses that it names."""
    settings = StabilitySettings(reserve=plan.claim.reserve, holds=plan.claim.holds)
    found = Replayer(assembly, settings).replay(plan.states, presses=plan.presses_before)
    return replace(PlanReplay.from_replay(found), varied=plan.claim.reserve > 1)


class Forgetful(StabilityOracle):
    """The criterion state by state, without history."""

    @property
    def replayer(self) -> None:  # type: ignore[override]
        return None


@pytest.fixture(scope="module")
def dome() -> Assembly:
    return library.build("dome")


@pytest.fixture(scope="module")
def dome_states(dome: Assembly) -> NDArray[np.uint8]:
    return plan_states(dome)


@pytest.mark.parametrize("friction", [0.1, 0.55])
def test_a_block_let_go_on_a_slope_slips_past_the_angle_of_friction(scenes: Any, friction: float) -> None:
    for offset, stands in ((-3e-3, True), (3e-3, False)):
        slope = scenes.slope(np.arctan(friction) + offset, friction=friction)
        last = complete_state(slope.boundary)
        held = np.where(last == 1, 2, last)
        gone = np.where(last == 1, 0, last)
        replay = Replayer(slope).replay(np.stack([gone, held, last]))
        assert replay.good is stands
        assert replay.falls_at == (None if stands else 2)


@pytest.mark.parametrize(("increments", "quarters"), [(1, [4]), (4, [1, 1, 1, 1]), (16, [0.25, 0.5, 1, 1, 1, 0.25])])
def test_a_slow_release_goes_faster_while_nothing_slides(scenes: Any, increments: int, quarters: list[float]) -> None:
    """A block that sticks on a slope sinks by its load over the stiffness, in proportion to what it takes up."""
    slope = scenes.slope(0.2, friction=0.55)
    last = complete_state(slope.boundary)
    states = np.stack([np.where(last == 1, 2, last), last])
    once = Replayer(slope, replay=ReplaySettings(1)).replay(states).histories[-1].displacement
    found = Replayer(slope, replay=ReplaySettings(increments)).replay(states)
    assert found.good
    history = found.histories[-1]
    assert history.track is not None
    np.testing.assert_allclose(history.displacement, once, rtol=0, atol=1e-2 * np.abs(once).max())
    taken = np.linalg.norm(history.track, axis=(1, 2))
    np.testing.assert_allclose(taken[: len(quarters)] / taken.sum(), np.array(quarters) / 4, rtol=0, atol=0.01)
    assert not taken[len(quarters) :].any()


def test_two_walls_do_not_press_what_a_robot_lets_go(scenes: Any) -> None:
    clamp = scenes.clamp(friction=0.55)
    last = complete_state(clamp.boundary)
    held = np.where(last == 1, 2, last)
    replay = Replayer(clamp).replay(np.stack([held, last]))
    assert replay.falls_at == 1


def test_the_weight_on_a_hand_is_taken_up_by_the_contacts(dome: Assembly, dome_states: NDArray) -> None:
    """At rest the remembered spring forces balance gravity on every free part, by the wrench maps of `Problem`."""
    replayer = Replayer(dome)
    replay = replayer.replay(dome_states)
    assert replay.good
    problem = replayer.problem
    for row in (len(dome_states) // 2, len(dome_states) - 1):
        springs = replay.histories[row].springs
        forces = np.where(springs[:, :1] > 0, springs, 0.0) * problem.force_scale[:, None]
        forces[~problem.active(dome_states[row : row + 1])[0]] = 0.0
        net = problem.gravity_wrench + (problem.geometry.wrench @ forces.ravel()).reshape(-1, 6)
        free = dome_states[row] == 1
        assert np.abs(net[free]).max() < 1e-3 * problem.weight
        slip = np.hypot(forces[:, 1], forces[:, 2]) - dome.friction * forces[:, 0]
        assert slip.max() < 1e-9 * problem.weight


def test_a_replay_goes_on_from_any_step(dome: Assembly, dome_states: NDArray) -> None:
    replayer = Replayer(dome)
    whole = replayer.replay(dome_states)
    half = len(dome_states) // 2
    rest = replayer.replay(dome_states[half:], whole.histories[half])
    np.testing.assert_array_equal(rest.stands[1:], whole.stands[half + 1 :])
    np.testing.assert_allclose(rest.moved[-1], whole.moved[-1], rtol=1e-9)


def test_steps_one_by_one_leave_the_history_of_all_together(dome: Assembly, dome_states: NDArray) -> None:
    """A step that is taken alone continues the history before it, whether it releases or holds parts."""
    replayer = Replayer(dome, replay=ReplaySettings(friction_noise=1.0))
    whole = replayer.replay(dome_states).histories
    for row in range(2, len(dome_states)):
        _, after = replayer.step(whole[row - 1], dome_states[row - 1], dome_states[row], ())
        for name in ("displacement", "springs", "torn", "age", "track", "moved", "part"):
            np.testing.assert_array_equal(getattr(after, name), getattr(whole[row], name))


def test_discrete_elements_agree_on_a_plan(dome: Assembly, dome_states: NDArray) -> None:
    assert Replayer(dome).replay(dome_states).good
    assert (replay_by_discrete_elements(dome, dome_states).stands == 1).all()


@pytest.mark.parametrize("name", ["arch:blocks=9", "wall:bricks=3,courses=4", "corbel", "bottle", "dome"])
def test_plans_are_delivered_only_where_their_replay_stands(name: str) -> None:
    assembly = library.build(name)
    planning = find_plans(assembly, make_task(assembly, 2))
    assert planning.found
    (plan,) = planning.plans
    assert plan.replay is not None
    assert plan.replay.stands
    assert plan.replay == replayed(assembly, plan)


def test_a_search_that_forgets_histories_finds_the_same_plan(dome: Assembly) -> None:
    """Only the histories of a few levels fit into memory; the others are computed anew."""
    found = []
    for room in (1 << 28, 1 << 16):
        search = BeamSearch(make_task(dome, 2), StabilityOracle(dome), BeamSettings(4, lookahead=8, history_bytes=room))
        assert search.run().found
        summary = search.replay_summary()
        assert summary is not None
        found.append((search.route().states, (summary, summary.presses)))
    assert (found[0][0] == found[1][0]).all()
    assert found[0][1] == found[1][1]


def test_history_fells_a_plan_whose_states_all_stand() -> None:
    """The vault's plan without history: every state stands from rest, and the replay falls; discrete elements agree."""
    vault = library.build("vault")
    planning = find_plans(vault, make_task(vault, 2), oracle=Forgetful(vault))
    states = planning.plans[0].states
    replay = Replayer(vault).replay(states)
    assert not replay.good
    assert replay.falls_at is not None
    judged = replay_by_discrete_elements(vault, states[: replay.falls_at + 1])
    assert judged.stands[-1] == -1


def test_the_answer_does_not_hang_on_the_numbers_of_the_method(dome: Assembly, dome_states: NDArray) -> None:
    """Stiffness of contacts and holds, speed of letting go, viscosity, and friction at the start."""
    cases = replay_varied(Replayer(dome), dome_states)
    assert len(cases) == 16
    assert [case.name for case in cases if not case.good] == []


def test_friction_at_the_start_changes_the_forces(dome: Assembly, dome_states: NDArray) -> None:
    plain = Replayer(dome).replay(dome_states)
    noisy = Replayer(dome, replay=ReplaySettings(friction_noise=1.0, seed=3)).replay(dome_states)
    assert np.abs(plain.histories[-1].springs - noisy.histories[-1].springs).max() > 0


@pytest.mark.parametrize(
    "settings", [{"increments": 0}, {"first_step": 0.0}, {"friction_noise": -1.0}, {"first_step": np.nan}]
)
def test_wrong_settings_are_named(settings: dict[str, Any]) -> None:
    with pytest.raises(InputError):
        ReplaySettings(**settings)


def test_plans_are_replayed_side_by_side(dome: Assembly, dome_states: NDArray) -> None:
    replayer = Replayer(dome)
    with ThreadPoolExecutor(2) as pool:
        first, second = pool.map(replayer.replay, [dome_states, dome_states[:10]])
    assert (first.good, second.good) == (True, True)
    np.testing.assert_array_equal(first.moved[:10], second.moved)


def test_parts_that_settle_first_near_a_change_end_where_the_whole_would(dome: Assembly, dome_states: NDArray) -> None:
    """Iterations that begin near the change come to the same rest as those of the whole from where it was."""
    replayer, plain = Replayer(dome), Replayer(dome)
    plain.options = plain.options._replace(warm_steps=0)
    near, whole = replayer.replay(dome_states), plain.replay(dome_states)
    assert near.good
    assert whole.good
    scale = whole.largest
    for one, other in zip(near.histories, whole.histories, strict=True):
        assert np.abs(one.displacement - other.displacement).max() <= 0.02 * scale


def test_certificates_are_the_same_where_all_contacts_are_evaluated(dome: Assembly, dome_states: NDArray) -> None:
    """The verifier evaluates the contacts of parts that move; here it is made to evaluate those of all."""
    replayer = Replayer(dome)
    claim = replayer.settings.claim
    near, whole = BuildVerifier(dome, claim), BuildVerifier(dome, claim)
    found = replayer.replay(dome_states)
    for state, step in zip(dome_states, replayer.certificates(dome_states, found.presses), strict=True):
        moves = 1e-300 * (state == INSTALLED)[None, :, None]
        one, other = near.step(state, step), whole.step(state, step._replace(displacement=step.displacement + moves))
        assert not one.reason
        assert not other.reason
        scale = np.abs(other.forces).max(initial=1.0)
        np.testing.assert_allclose(one.forces, other.forces, rtol=0, atol=1e-9 * scale)
        np.testing.assert_allclose(one.wrenches, other.wrenches, rtol=0, atol=1e-9 * scale)
        (residual,) = residual_of_forces(dome, state[None], one.forces[None], claim)
        np.testing.assert_allclose([one.residual, other.residual], [residual] * 2, rtol=1e-6, atol=1e-12)


@pytest.mark.parametrize("robust", [False, True])
def test_routes_are_tested_piece_by_piece(dome: Assembly, dome_states: NDArray, robust: bool) -> None:
    """A route that falls, and one that does not, tested a few states at a time: as replayed in one piece."""
    assert len(dome_states) > PIECE
    acceptance = Acceptance(Replayer(dome, StabilitySettings(reserve=1.1)), robust=robust)
    tested = acceptance.tested(dome_states, PlanReplay(True, 0.0, -1))
    true = Replayer(dome)
    assert tested.stands
    assert tested.loads == true.loads(dome_states, true.replay(dome_states).histories)
    slippery = replace(dome, friction=0.1)
    plain = Replayer(slippery).replay(dome_states, presses=[()] * len(dome_states))
    found = Acceptance(Replayer(slippery, StabilitySettings(reserve=1.1)), robust=robust).tested(
        dome_states, PlanReplay(True, 0.0, -1)
    )
    assert not found.stands
    assert found.falls_at == plain.falls_at
