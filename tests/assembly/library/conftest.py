"""Fixtures of the tests of built-in structures."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest
from numpy.typing import ArrayLike

from falsework import Assembly, StabilityOracle, StabilitySettings, Verdict
from falsework.assembly import complete_state


@pytest.fixture(scope="session")
def stands() -> Callable[..., bool]:
    """Whether one state stands, the complete one if none is given; fails where neither verdict is proven."""

    def judge(
        assembly: Assembly, state: ArrayLike | None = None, settings: StabilitySettings = StabilitySettings()
    ) -> bool:
        if state is None:
            state = complete_state(assembly.boundary)
        verdict = StabilityOracle(assembly, settings).verdicts(np.asarray(state), require_certificate=True).verdict[0]
        assert verdict != Verdict.UNDECIDED
        return bool(verdict == Verdict.STABLE)

    return judge


@pytest.fixture(scope="session")
def touching() -> Callable[[Assembly], set[tuple[int, int]]]:
    """Pairs of parts that touch."""
    return lambda assembly: {(int(a), int(b)) for a, b in assembly.contacts.parts}
