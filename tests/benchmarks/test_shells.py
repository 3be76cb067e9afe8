"""Random shells of the benchmark: always the same, closed blocks that touch, and as many parts as they should have."""

from __future__ import annotations

import numpy as np
import pytest
from shells import EACH, FAMILIES, NAMES, shell

from falsework import StabilityOracle
from falsework.assembly import complete_state


@pytest.mark.parametrize("family", list(FAMILIES))
def test_shells_stand_and_are_always_the_same(family: str) -> None:
    assembly = shell(f"{family}-0")
    assert assembly.identity == shell(f"{family}-0").identity != shell(f"{family}-1").identity
    assert 30 <= (~assembly.boundary).sum() <= 150
    assert StabilityOracle(assembly).verdicts(complete_state(assembly.boundary), require_certificate=True).stable[0]
    touching = np.unique(assembly.contacts.parts)
    assert len(touching) == assembly.part_count


def test_a_groin_vault_is_symmetric() -> None:
    """Four quarters of equal weight; no block reaches into another where they would overlap."""
    assembly = shell("groin-0")
    weight = assembly.mass.mass
    centre = weight @ assembly.mass.center / weight.sum()
    assert np.allclose(centre[:2], 0.0, atol=1e-9)
    assert not assembly.warnings


def test_shells_have_names() -> None:
    assert len(NAMES) == len(set(NAMES)) == EACH * len(FAMILIES) == 20
    for name in ("barrel", "barrel-x", "tower-0"):
        with pytest.raises(ValueError, match="no shell"):
            shell(name)
