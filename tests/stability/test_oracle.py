"""Stability oracle: batches, counters, warm starts, threads, and invalid input."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict, load_structure, verify_certificates
from falsework.assembly import complete_state, library
from falsework.errors import InputError, StateError
from falsework.stability import ExactSolver, NumericalSettings, Proof, Verdicts
from falsework.stability.certificate import CONTACT
from falsework.stability.cpu.solver import CpuSolver
from falsework.stability.problem import build_problem
from falsework.stability.verdict import Criterion, Solver


@pytest.fixture(scope="module")
def arch() -> Assembly:
    return library.build("arch:blocks=9,thickness=0.25")


@pytest.fixture(scope="module")
def states(scenes: Any, arch: Assembly) -> NDArray[np.uint8]:
    """States of both verdicts; some come twice."""
    return scenes.few_changes(arch, 80, seed=21, most=3)


@pytest.fixture(scope="module")
def expected(arch: Assembly, states: NDArray[np.uint8]) -> NDArray[np.int8]:
    verdict = ExactSolver(arch, StabilitySettings(criterion="equilibrium")).check(states).verdict
    assert {-1, 1} == set(verdict.tolist())
    return verdict


def children(assembly: Assembly, parent: NDArray[np.uint8]) -> NDArray[np.uint8]:
    """A parent with each of its free parts held, and with each removed."""
    rows = []
    for part in np.flatnonzero(parent == 1):
        for value in (0, 2):
            rows.append(parent.copy())
            rows[-1][part] = value
    return np.array(rows)


def balanced(stability: StabilityOracle) -> bool:
    """Whether every state that was asked is accounted for."""
    counters = stability.counters.to_dict()
    answered = sum(count for name, count in counters.items() if name not in ("asked", "rejected", "warm"))
    return counters["asked"] == answered


def test_verdicts_are_verified_under_their_own_criterion(arch: Assembly, states: NDArray) -> None:
    stability = StabilityOracle(arch)
    verdicts = stability.verdicts(states, require_certificate=True)
    assert stability.settings.claim == CONTACT
    stable = verdicts.stable
    assert stable.any()
    assert verify_certificates(arch, states, verdicts).all()
    assert verdicts.displacement is not None
    moved = replace(verdicts, displacement=0.5 * verdicts.displacement)
    assert not verify_certificates(arch, states, moved)[stable].any(), "forces alone prove nothing under `contact`"


def test_check_returns_proofs_that_hold(arch: Assembly, states: NDArray, expected: NDArray) -> None:
    stability = StabilityOracle(arch, StabilitySettings(criterion="equilibrium"))
    verdicts = stability.verdicts(states, require_certificate=True)
    np.testing.assert_array_equal(verdicts.verdict, expected)
    assert verify_certificates(arch, states, verdicts).all()
    np.testing.assert_array_equal(verdicts.proof, np.where(expected == 1, Proof.FORCES, Proof.VELOCITY))
    assert (verdicts.residual[verdicts.stable] <= 1e-4).all()
    assert (verdicts.residual[verdicts.unstable] > 1e-4).all()
    assert verdicts.forces is not None
    assert verdicts.velocity is not None
    assert verdicts.forces.shape == (len(states), stability.problem.points, 3)
    assert verdicts.velocity.shape == (*states.shape, 6)
    assert balanced(stability)


def test_judge_agrees_and_carries_no_proofs(arch: Assembly, states: NDArray, expected: NDArray) -> None:
    verdicts = StabilityOracle(arch, StabilitySettings(criterion="equilibrium")).verdicts(states)
    np.testing.assert_array_equal(verdicts.verdict, expected)
    assert verdicts.forces is None
    assert verdicts.velocity is None
    np.testing.assert_array_equal(
        StabilityOracle(arch, StabilitySettings(criterion="equilibrium")).verdicts(states).stable, expected == 1
    )


def test_verdicts_have_words(arch: Assembly, states: NDArray, expected: NDArray) -> None:
    verdicts = StabilityOracle(arch).verdicts(states)
    assert np.array_equal([int(kind) for kind in verdicts.kinds], verdicts.verdict)
    assert {str(kind) for kind in verdicts.kinds} <= {"stable", "unstable", "slides", "tips", "undecided"}
    assert np.array_equal([str(kind) == "stable" for kind in verdicts.kinds], expected == 1)


def test_asking_again_costs_nothing(arch: Assembly, states: NDArray, expected: NDArray) -> None:
    stability = StabilityOracle(arch, StabilitySettings(criterion="equilibrium"))
    unique = len(np.unique(states, axis=0))
    first = stability.verdicts(states)
    solved = stability.counters.cpu + stability.counters.exact
    assert solved == unique
    assert stability.counters.cached == len(states) - unique
    again = stability.verdicts(states)
    np.testing.assert_array_equal(again.verdict, expected)
    np.testing.assert_array_equal(again.residual, first.residual)
    assert stability.counters.cpu + stability.counters.exact == solved
    assert (again.decided_by == Solver.RULE).all()
    assert stability.counters.asked == 2 * len(states)
    assert balanced(stability)


def test_the_rules_answer_without_solving(arch: Assembly) -> None:
    stability = StabilityOracle(arch, StabilitySettings(criterion="equilibrium"))
    complete = complete_state(arch.boundary)
    assert stability.verdicts(complete).stable[0]
    held = children(arch, complete)[1::2]
    verdicts = stability.verdicts(held)
    assert verdicts.stable.all()
    assert (verdicts.proof == Proof.FORCES).all()
    assert stability.counters.by_monotonicity == len(held)
    assert stability.counters.cpu + stability.counters.exact == 1
    gap = complete.copy()
    gap[[4, 0]] = 0, 2  # without its keystone, its first block held
    assert stability.verdicts(gap).unstable[0]
    gap[0] = 1
    verdicts = stability.verdicts(gap)
    assert verdicts.unstable[0]
    assert verdicts.proof[0] == Proof.VELOCITY
    assert stability.counters.cpu + stability.counters.exact == 2
    assert balanced(stability)


def test_what_was_checked_is_known_to_judge(arch: Assembly, states: NDArray) -> None:
    stability = StabilityOracle(arch, StabilitySettings(criterion="equilibrium"))
    stability.verdicts(states, require_certificate=True)
    before = stability.counters.cpu + stability.counters.exact
    stability.verdicts(states)
    assert stability.counters.cpu + stability.counters.exact == before


def judged(arch: Assembly) -> tuple[StabilityOracle, NDArray[np.uint8]]:
    """An oracle of a complete arch and of it with one part held, each judged from the state before."""
    stability = StabilityOracle(arch)
    whole = complete_state(arch.boundary)
    held = whole.copy()
    held[4] = 2
    assert stability.verdicts(np.stack([whole, held]), near=np.stack([whole, whole])).stable.all()
    return stability, np.stack([whole, held])


def test_what_was_judged_is_proven_from_memory(arch: Assembly) -> None:
    stability, states = judged(arch)
    again = stability.verdicts(states, near=states, require_certificate=True)
    cold = StabilityOracle(arch).verdicts(states, require_certificate=True)
    assert again.stable.all()
    assert cold.stable.all()
    assert (again.proof == Proof.DISPLACEMENT).all()
    assert verify_certificates(arch, states, again, stability.settings.claim).all()
    assert (again.iterations < cold.iterations).all()
    assert balanced(stability)


def test_each_state_serves_those_that_are_near_to_it(arch: Assembly) -> None:
    """Only the first of a chain begins from rest, wherever it is in the batch."""
    states = [complete_state(arch.boundary)]
    for part in np.flatnonzero(states[0] == 1)[:5]:
        states.append(np.where(np.arange(arch.part_count) == part, 2, states[-1]).astype(np.uint8))
    chain, before = np.stack(states), np.stack([states[0], *states[:-1]])
    for order in (np.arange(6), np.arange(6)[::-1]):
        for settings in (StabilitySettings(), StabilitySettings(criterion="equilibrium")):
            stability = StabilityOracle(arch, settings)
            found = stability.verdicts(chain[order], near=before[order], require_certificate=True)
            assert found.stable.all()
            assert verify_certificates(arch, chain[order], found, settings.claim).all()
            assert stability.counters.warm == 5
            assert balanced(stability)


def test_states_that_are_near_to_each_other_alone_begin_from_rest(arch: Assembly) -> None:
    _, states = judged(arch)
    stability = StabilityOracle(arch)
    assert stability.verdicts(states, near=states[::-1].copy(), require_certificate=True).stable.all()
    assert stability.counters.warm == 0
    assert balanced(stability)


def test_forces_are_proven_from_memory_too(arch: Assembly) -> None:
    _, states = judged(arch)
    settings = StabilitySettings(criterion="equilibrium")
    stability = StabilityOracle(arch, settings)
    stability.verdicts(states, near=states)
    again = stability.verdicts(states, near=states, require_certificate=True)
    assert (again.proof == Proof.FORCES).all()
    assert (again.iterations == 0).all()
    assert verify_certificates(arch, states, again, settings.claim).all()


def test_a_displacement_that_proves_nothing_is_not_passed_on(arch: Assembly) -> None:
    stability, states = judged(arch)
    fallen = states[0].copy()
    fallen[3] = 0
    found = stability.verdicts(np.stack([fallen, fallen]), near=states, require_certificate=True)
    assert found.unstable.all()
    assert verify_certificates(arch, np.stack([fallen, fallen]), found, stability.settings.claim).all()


def test_the_next_state_is_checked_from_the_one_before(arch: Assembly) -> None:
    stability = StabilityOracle(arch)
    whole = complete_state(arch.boundary)
    held, fallen = whole.copy(), whole.copy()
    held[4], fallen[4] = 2, 0
    stability.verdicts(whole, require_certificate=True)
    asked = stability.counters.asked
    found = stability.verdicts(np.stack([held, fallen]), near=np.stack([whole, whole]), require_certificate=True)
    assert found.stable.tolist() == [True, False]
    assert found.unstable.tolist() == [False, True]
    assert verify_certificates(arch, np.stack([held, fallen]), found, stability.settings.claim).all()
    assert stability.counters.asked == asked + 2
    assert balanced(stability)


def test_the_next_state_is_checked_from_rest_where_nothing_is_known_of_the_one_before(arch: Assembly) -> None:
    stability = StabilityOracle(arch)
    whole = complete_state(arch.boundary)
    held = whole.copy()
    held[4] = 2
    found = stability.verdicts(held, near=whole, require_certificate=True)
    assert found.stable[0]
    cold = StabilityOracle(arch).verdicts(held, require_certificate=True)
    np.testing.assert_array_equal(found.displacement, cold.displacement)


def test_each_state_needs_a_near_one(arch: Assembly) -> None:
    states = np.stack([complete_state(arch.boundary)] * 3)
    with pytest.raises(StateError, match="1 near states do not fit 3 states; give one for each"):
        StabilityOracle(arch).verdicts(states, near=states[:1])


@pytest.mark.parametrize("structure", ["arch:blocks=9,thickness=0.25", "wall:bricks=4,courses=4", "dome"])
def test_warm_starts_change_no_verdict(structure: str) -> None:
    """Children that start from their parent's forces get the verdicts that they get on their own."""
    assembly = library.build(structure)
    warm, cold = (
        StabilityOracle(assembly, StabilitySettings(criterion="equilibrium")),
        StabilityOracle(assembly, StabilitySettings(criterion="equilibrium")),
    )
    parent = complete_state(assembly.boundary)
    assert warm.verdicts(parent, near=parent).stable[0]
    random = np.random.default_rng(0)
    for _ in range(3):
        asked = children(assembly, parent)
        asked = asked[random.permutation(len(asked))[:60]]
        parents = np.broadcast_to(parent, asked.shape)
        verdict = warm.verdicts(asked, near=parents).verdict
        np.testing.assert_array_equal(verdict, cold.verdicts(asked, require_certificate=True).verdict)
        stable = asked[(verdict == 1) & (asked == 0).any(axis=1)]
        if not len(stable):
            break
        parent = stable[0]
    assert warm.counters.warm > 0
    assert balanced(warm)


def test_parents_may_be_anything(arch: Assembly, states: NDArray, expected: NDArray) -> None:
    """A parent only says where to look first: even a wrong one, never judged or unstable, changes no verdict."""
    random = np.random.default_rng(5)
    for parents in (states[::-1], states[random.permutation(len(states))], np.where(arch.boundary, 2, 0 * states)):
        stability = StabilityOracle(arch, StabilitySettings(criterion="equilibrium"))
        np.testing.assert_array_equal(stability.verdicts(states, near=parents).verdict, expected)


@pytest.mark.parametrize("structure", ["vault", "wall:bricks=8,courses=8"])
def test_a_proof_found_near_a_change_proves_the_whole(structure: str) -> None:
    """What falls near the change falls in the whole state, and the same velocity proves it to the checker."""
    assembly = library.build(structure)
    settings = StabilitySettings(criterion="equilibrium")
    solver = CpuSolver(build_problem(assembly), settings)
    parent = complete_state(assembly.boundary)
    states = children(assembly, parent)[::2]
    parents = np.ascontiguousarray(np.broadcast_to(parent, states.shape))
    near, whole = solver.check(states, parents=parents), solver.check(states)
    np.testing.assert_array_equal(near.verdict, whole.verdict)
    assert near.unstable.any()
    assert verify_certificates(assembly, states, near, settings.claim).all()
    assert near.velocity is not None
    assert whole.velocity is not None
    moving = [np.abs(velocity[near.unstable]).any(axis=2).sum() for velocity in (near.velocity, whole.velocity)]
    assert moving[0] < moving[1], "most parts are still in the velocities that were found near the change"


def test_threads_change_nothing(arch: Assembly, states: NDArray) -> None:
    one, two, again = (
        StabilityOracle(
            arch, StabilitySettings(criterion="equilibrium", numerics=NumericalSettings(threads=threads))
        ).verdicts(states, require_certificate=True)
        for threads in (1, 2, 2)
    )
    for other in (two, again):
        np.testing.assert_array_equal(one.verdict, other.verdict)
        np.testing.assert_array_equal(one.residual, other.residual)
        np.testing.assert_array_equal(one.iterations, other.iterations)
        np.testing.assert_array_equal(one.forces, other.forces)
        np.testing.assert_array_equal(one.velocity, other.velocity)


def test_order_changes_nothing(arch: Assembly, states: NDArray) -> None:
    stability = StabilityOracle(arch, StabilitySettings(criterion="equilibrium"))
    order = np.random.default_rng(1).permutation(len(states))
    straight, shuffled = (
        stability.verdicts(states, require_certificate=True),
        StabilityOracle(arch, StabilitySettings(criterion="equilibrium")).verdicts(
            states[order], require_certificate=True
        ),
    )
    np.testing.assert_array_equal(straight.verdict[order], shuffled.verdict)
    np.testing.assert_array_equal(straight.residual[order], shuffled.residual)


def test_an_empty_batch(arch: Assembly) -> None:
    stability = StabilityOracle(arch, StabilitySettings(criterion="equilibrium"))
    nothing = np.zeros((0, arch.part_count), np.uint8)
    for verdicts in (
        stability.verdicts(nothing, require_certificate=True),
        stability.verdicts(nothing),
        stability.verdicts(nothing, near=nothing),
    ):
        assert len(verdicts) == 0
    assert stability.verdicts(nothing).stable.shape == (0,)
    assert stability.counters.asked == 0


def test_one_state_is_a_batch_of_one(arch: Assembly) -> None:
    verdicts = StabilityOracle(arch, StabilitySettings(criterion="equilibrium")).verdicts(
        complete_state(arch.boundary), require_certificate=True
    )
    assert len(verdicts) == 1
    assert verdicts.stable[0]


def test_verdicts_can_be_taken_apart(arch: Assembly, states: NDArray) -> None:
    verdicts = StabilityOracle(arch, StabilitySettings(criterion="equilibrium")).verdicts(
        states, require_certificate=True
    )
    assert len(verdicts[3]) == 1
    assert verdicts[3].verdict[0] == verdicts.verdict[3]
    assert verdicts[-1].verdict[0] == verdicts.verdict[-1]
    few = verdicts[verdicts.unstable]
    assert few.unstable.all()
    assert few.velocity is not None
    assert len(few.velocity) == len(few)
    assert verdicts.without_certificates().forces is None
    blank = Verdicts.all_undecided(2)
    assert blank.undecided.all()
    assert (blank.proof == Proof.NONE).all()


def test_the_exact_solver_can_be_asked_alone(arch: Assembly, states: NDArray, expected: NDArray) -> None:
    stability = StabilityOracle(arch, StabilitySettings(criterion="equilibrium", solver="exact"))
    verdicts = stability.verdicts(states[:20], require_certificate=True)
    np.testing.assert_array_equal(verdicts.verdict, expected[:20])
    assert (verdicts.decided_by == Solver.EXACT).all()
    assert stability.counters.cpu == 0
    np.testing.assert_array_equal(stability.verdicts(states[:20]).verdict, expected[:20])
    assert balanced(stability)


def test_what_the_fast_solver_leaves_goes_to_the_exact_one(arch: Assembly, states: NDArray, expected: NDArray) -> None:
    """With next to no iterations nothing is decided fast, yet everything is decided."""
    numerics = NumericalSettings(iterations=1, interior_steps=0)
    for certificates in (True, False):
        stability = StabilityOracle(arch, StabilitySettings(criterion="equilibrium", numerics=numerics))
        verdicts = stability.verdicts(states, require_certificate=certificates)
        np.testing.assert_array_equal(verdicts.verdict, expected)
        assert stability.counters.exact > 0
        assert balanced(stability)


def test_a_proof_that_is_rejected_goes_to_the_exact_solver(
    arch: Assembly, states: NDArray, expected: NDArray, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Were the fast solver wrong, the checker would see it and the exact solver decide."""
    stability = StabilityOracle(arch, StabilitySettings(criterion="equilibrium"))
    solve = CpuSolver.check

    def lie(*arguments: Any, **options: Any) -> Verdicts:
        verdicts = solve(*arguments, **options)
        return replace(verdicts, verdict=-verdicts.verdict)

    monkeypatch.setattr(CpuSolver, "check", lie)
    verdicts = stability.verdicts(states, require_certificate=True)
    np.testing.assert_array_equal(verdicts.verdict, expected)
    unique = len(np.unique(states, axis=0))
    assert stability.counters.rejected == unique
    assert stability.counters.exact == unique


@pytest.mark.parametrize("as_near", [True, False])
@pytest.mark.parametrize(
    ("state", "message"),
    [
        ([1, 1], "one value for each part"),
        ([[[1] * 11]], "one value for each part"),
        ([3, *[1] * 8, 2, 2], "part 0"),
        ([-1, *[1] * 8, 2, 2], "part 0"),
        ([0.5, *[1] * 8, 2, 2], "part 0"),
        ([np.nan, *[1] * 8, 2, 2], "part 0"),
        ([*[1] * 9, 1, 2], "boundary part 9"),
        ([*[1] * 9, 2, 0], "boundary part 10"),
        (["a"] * 11, "numbers"),
        ([[1] * 11, [1] * 10], "different lengths"),
    ],
)
def test_bad_states_are_named(arch: Assembly, as_near: bool, state: Any, message: str) -> None:
    stability, whole = StabilityOracle(arch, StabilitySettings(criterion="equilibrium")), complete_state(arch.boundary)
    with pytest.raises(StateError, match=message) as caught:
        stability.verdicts(whole if as_near else state, near=state if as_near else None)
    assert "\n" not in str(caught.value)


def test_bad_states_do_not_reach_the_exact_solver(arch: Assembly) -> None:
    with pytest.raises(StateError, match="one value for each part"):
        ExactSolver(arch, StabilitySettings(criterion="equilibrium")).check([1, 1])


@pytest.mark.parametrize("gravity", [1e-300, 1e-10, 1e10, 1e300])
def test_gravity_is_one_of_a_body(gravity: float) -> None:
    """Squares of forces are numbers up to there."""
    with pytest.raises(InputError, match="give 1e-09 to 1e\\+09"):
        StabilitySettings(gravity=gravity)


@pytest.mark.parametrize("criterion", ["contact", "equilibrium"])
@pytest.mark.parametrize("gravity", [1e-9, 1e9])
def test_an_arch_stands_on_any_body(gravity: float, criterion: Criterion) -> None:
    arch = load_structure("arch:blocks=5")
    oracle = StabilityOracle(arch, StabilitySettings(gravity=gravity, criterion=criterion))
    assert oracle.verdicts(complete_state(arch.boundary)).stable.all()


@pytest.mark.parametrize("name", ["gravity", "tolerance", "force_bound"])
@pytest.mark.parametrize("value", [0.0, -1.0, np.nan, np.inf])
def test_bad_settings_are_named(name: str, value: float) -> None:
    with pytest.raises(InputError, match=name):
        StabilitySettings(criterion="equilibrium", **{name: value})  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("rho", 0.0),
        ("rho", np.nan),
        ("relaxation", 2.0),
        ("iterations", -1),
        ("check_every", 0),
        ("interior_steps", -1),
        ("threads", 0),
    ],
)
def test_bad_numbers_for_the_solver_are_named(name: str, value: float) -> None:
    with pytest.raises(InputError, match=name):
        NumericalSettings(**{name: value})  # type: ignore[arg-type]


def test_unknown_choices_are_named() -> None:
    with pytest.raises(InputError, match=r"unknown solver .magic.; choose .*cpu.*exact"):
        StabilitySettings(criterion="equilibrium", solver="magic")  # type: ignore[arg-type]
    with pytest.raises(InputError, match="octagon or quadratic"):
        StabilitySettings(criterion="equilibrium", cone="pyramid")  # type: ignore[arg-type]


def test_verdicts_are_written_as_words() -> None:
    assert [str(Verdict(value)) for value in (1, 0, -1)] == ["stable", "undecided", "unstable"]
    assert f"{Verdict.SLIDES} {Verdict.SLIDES:d}" == "slides -2"
