"""The broad phase against all pairs."""

from __future__ import annotations

import numpy as np
import pytest

from falsework.geometry.mesh import boxes


@pytest.mark.parametrize("stretch", [(1, 1, 1), (9, 0.4, 0.4), (0.4, 0.4, 9), (0.2, 3, 3)])
def test_the_same_pairs_as_comparing_all(stretch):
    random = np.random.default_rng(4)
    low = random.uniform(0, 5, (300, 3)) * stretch
    high = low + random.uniform(0, 1.5, (300, 3))
    overlap = ((low[:, None] <= high[None]) & (low[None] <= high[:, None])).all(axis=2)
    expected = np.argwhere(np.triu(overlap, 1))
    i, j = boxes.box_pairs(low, high, chunk=64)
    assert (np.stack([i, j], axis=1) == expected).all()
    assert len(i) > 20


@pytest.mark.parametrize("few", [0, 10**9])
@pytest.mark.parametrize("stretch", [(1, 1, 1), (9, 0.4, 0.4), (0.2, 3, 3)])
def test_pairs_of_groups_are_those_of_a_comparison_of_all(stretch, few):
    random = np.random.default_rng(5)
    low = random.uniform(0, 5, (300, 3)) * stretch
    inner = np.stack([low, low + random.uniform(0, 1.2, (300, 3))])
    outer = inner + random.uniform(0, 0.5, (2, 300, 3)) * np.array([-1, 1])[:, None, None]
    group = np.sort(random.integers(0, 9, 300))
    among = np.triu(random.uniform(size=(9, 9)) < 0.7)
    near = ((outer[0][:, None] <= inner[1]) & (inner[0] <= outer[1][:, None])).all(axis=2)
    expected = near & near.T & (group[:, None] < group) & among[group[:, None], group]
    found = [np.stack(pair, axis=1) for pair in boxes.pairs_of_groups(inner, outer, group, among, chunk=64, few=few)]
    assert sorted(map(tuple, np.concatenate(found).tolist())) == list(map(tuple, np.argwhere(expected).tolist()))
    assert expected.sum() > 20


def test_boxes_that_touch_count_and_none_are_no_trouble():
    i, j = boxes.box_pairs(np.array([(0, 0, 0), (1, 1, 1)], float), np.array([(1, 1, 1), (2, 2, 2)], float))
    assert (i.tolist(), j.tolist()) == ([0], [1])
    assert len(boxes.box_pairs(np.zeros((0, 3)), np.zeros((0, 3)))[0]) == 0
