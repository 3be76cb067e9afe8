"""Sets of bits against arrays of flags."""

from __future__ import annotations

import numpy as np
import pytest

from falsework.utils.bits import intersect, pack, unpack


@pytest.mark.parametrize("members", [1, 7, 64, 65, 200])
def test_sets_are_flags(members):
    random = np.random.default_rng(members)
    one, two = random.uniform(size=(40, members)) < 0.1, random.uniform(size=(30, members)) < 0.1
    assert pack(one).shape == (40, -(-members // 64))
    assert (unpack(pack(one))[:, :members] == one).all()
    assert not unpack(pack(one))[:, members:].any()
    assert (intersect(pack(one), pack(two)) == (one[:, None] & two[None]).any(axis=2)).all()
    assert pack(np.eye(members, dtype=bool))[-1, -1] == np.uint64(1) << np.uint64((members - 1) % 64)
