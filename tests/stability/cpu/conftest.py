"""A vault, and the releases of its parts."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import Assembly
from falsework.assembly import HELD, INSTALLED, complete_state, library


@pytest.fixture(scope="module")
def vault() -> Assembly:
    return library.build("vault")


@pytest.fixture(scope="module")
def released(vault: Assembly) -> tuple[NDArray[np.uint8], NDArray[np.uint8]]:
    """Complete vault after the release of each part, and before."""
    complete = complete_state(vault.boundary)
    parts = np.flatnonzero(complete == INSTALLED)
    before = np.repeat(complete[None], len(parts), axis=0)
    before[np.arange(len(parts)), parts] = HELD
    return np.repeat(complete[None], len(parts), axis=0), before
