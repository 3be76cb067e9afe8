"""Generated structures: what a policy for all structures is trained and tested on."""

from __future__ import annotations

import numpy as np
import pytest
from experiments.structure_generator import HELD_OUT, TRAINED, UNSEEN, generated, stands, turned

from falsework import StabilityOracle, load_structure
from falsework.errors import InputError


def test_a_number_is_always_the_same_structure() -> None:
    one, same = generated(3), generated(3)
    assert one.assembly.identity == same.assembly.identity
    assert (one.name, one.robots, one.criterion) == (same.name, same.robots, same.criterion)
    assert one.assembly.identity != generated(3 + len(TRAINED)).assembly.identity


@pytest.mark.parametrize("family", [*TRAINED, *UNSEEN, *HELD_OUT])
def test_every_family_stands_and_keeps_its_size(family: str) -> None:
    made = generated(1, (family,))
    assert made.family == family
    assert 3 <= (~made.assembly.boundary).sum() <= 150
    assert stands(made.assembly, made.criterion)


def test_families_take_turns() -> None:
    assert [generated(number, ("arch", "stack")).family for number in range(4)] == ["arch", "stack"] * 2


def test_an_unknown_family_is_refused() -> None:
    with pytest.raises(InputError, match="no family of structures is called 'bridge'; there are arch"):
        generated(0, ("bridge",))


def test_turning_a_structure_changes_nothing_that_matters() -> None:
    arch = load_structure("arch:blocks=5")
    other = turned(arch, 0.7)
    assert len(other.contacts) == len(arch.contacts)
    np.testing.assert_allclose(other.contacts.areas, arch.contacts.areas, rtol=1e-6)
    np.testing.assert_allclose(other.contacts.normals[:, 2], arch.contacts.normals[:, 2], atol=1e-9)
    states = np.random.default_rng(0).integers(0, 3, (60, arch.part_count), dtype=np.uint8)
    states[:, arch.boundary] = 2
    assert (StabilityOracle(arch).verdicts(states).verdict == StabilityOracle(other).verdicts(states).verdict).all()
