"""Generated structures: what a policy for many of them is trained on."""

from __future__ import annotations

from itertools import islice

import numpy as np
import pytest
from experiments.structure_generator import KINDS, members, specifications, turned

from falsework.assembly import load_structure
from falsework.errors import InputError
from falsework.stability import Stability


def test_the_same_seed_draws_the_same_structures_and_none_twice() -> None:
    kinds = tuple(KINDS)
    one, same, other = (list(islice(specifications(kinds, seed), 100)) for seed in (1, 1, 2))
    assert one == same
    assert one != other
    assert len(set(one)) == 100
    assert {name.split(":")[0] for name in one} == set(kinds)
    avoiding = list(islice(specifications(kinds, 1, frozenset(one[:50])), 50))
    assert not set(avoiding) & set(one[:50])


def test_most_of_what_is_drawn_can_be_made() -> None:
    made = 0
    for name in islice(specifications(tuple(KINDS), 0), 2 * len(KINDS)):
        try:
            made += load_structure(name).part_count > 1
        except InputError:  # a refusal is fine, a crash is not
            continue
    assert made >= len(KINDS)


def test_an_unknown_family_is_refused() -> None:
    with pytest.raises(InputError, match="no family of structures is called 'bridge'; there are arch"):
        next(specifications(("bridge",), 0))


def test_members_are_buildable_and_their_states_stand() -> None:
    for member in members(2, kinds=("arch", "stack"), seed=3, width=8):
        states = member.solved.states.numpy()
        assert Stability(member.assembly).verdicts(states).verdict.all()
        assert (states == member.environment.rules.complete()[0].numpy()).all(axis=1).any()
        assert member.solved.valid_actions(member.environment.rules.complete()).any()


def test_turning_a_structure_changes_nothing_that_matters() -> None:
    arch = load_structure("arch:blocks=5")
    other = turned(arch, 0.7)
    assert len(other.contacts) == len(arch.contacts)
    np.testing.assert_allclose(other.contacts.areas, arch.contacts.areas, rtol=1e-6)
    np.testing.assert_allclose(other.contacts.normals[:, 2], arch.contacts.normals[:, 2], atol=1e-9)
    states = np.random.default_rng(0).integers(0, 3, (60, arch.part_count), dtype=np.uint8)
    states[:, arch.boundary] = 2
    assert (Stability(arch).verdicts(states).verdict == Stability(other).verdicts(states).verdict).all()
