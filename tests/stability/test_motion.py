"""Motion of states that are not stable."""

from __future__ import annotations

import numpy as np
import pytest

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict
from falsework.assembly.library.blocks import box, gather
from falsework.stability.contact.solver import ContactSolver
from falsework.stability.motion import motion_of
from falsework.stability.settings import EQUILIBRIUM


@pytest.fixture(scope="module")
def clamp() -> Assembly:
    """A cube between two fixed walls with nothing below it, and one that lies on top of the right wall."""
    made = gather(
        [
            box("cube", (0, 0, 0), (1, 1, 1)),
            box("idler", (1, 0, 2), (2, 1, 3)),
            box("left", (-1, 0, -1), (0, 1, 2), fixed=True),
            box("right", (1, 0, -1), (2, 1, 2), fixed=True),
        ]
    )
    return Assembly.from_meshes(made.meshes, boundary=made.boundary)


STATES = np.array([[1, 1, 2, 2], [2, 1, 2, 2]], dtype=np.uint8)


def test_what_slides_slides_down_and_what_settles_is_left_out(clamp: Assembly) -> None:
    verdicts = StabilityOracle(clamp).verdicts(STATES, require_certificate=True)
    assert verdicts.verdict.tolist() == [Verdict.SLIDES, Verdict.STABLE]
    assert verdicts.displacement is not None
    assert verdicts.displacement[0, 1].any()  # the other cube settles on its wall
    motion = motion_of(clamp, verdicts, 0)
    assert motion is not None
    np.testing.assert_allclose(motion[0] / np.abs(motion[0]).max(), [0, 0, -1, 0, 0, 0], atol=1e-6)
    assert not motion[1:].any()
    assert motion_of(clamp, verdicts, 1) is None


def test_an_unstable_state_moves_as_its_proof_says(clamp: Assembly) -> None:
    slippery = clamp.replace(friction=0.0)
    for settings in (StabilitySettings(), EQUILIBRIUM):
        verdicts = StabilityOracle(slippery, settings).verdicts(STATES, require_certificate=True)
        assert verdicts.verdict.tolist() == [Verdict.UNSTABLE, Verdict.STABLE]
        motion = motion_of(slippery, verdicts, 0)
        assert motion is not None
        assert verdicts.velocity is not None
        np.testing.assert_array_equal(motion, verdicts.velocity[0])
        assert motion[0, 2] < 0


def test_without_certificates_no_motion_is_known(clamp: Assembly) -> None:
    assert motion_of(clamp, StabilityOracle(clamp).verdicts(STATES), 0) is None


def test_no_guess_is_made_from_a_displacement_that_slides(clamp: Assembly) -> None:
    oracle = StabilityOracle(clamp)
    solver = ContactSolver(clamp, oracle.problem, oracle.settings)
    guess = np.full((2, clamp.part_count, 6), np.nan)
    verdicts = solver.check(STATES, certificates=False, parents=STATES[[1, 1]], guess=guess)
    assert verdicts.verdict.tolist() == [Verdict.SLIDES, Verdict.STABLE]
    assert np.isnan(guess[0]).all()
    assert np.isfinite(guess[1]).all()
