"""Orders of elimination, and factors in panels, against dense linear algebra."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import load_structure
from falsework.stability.cpu.elimination import eliminate, lay_out_panels
from falsework.stability.cpu.layout import KernelArrays, build_structure, make_scratch
from falsework.stability.cpu.panels import factor_panels, solve_panels
from falsework.stability.problem import build_problem


@pytest.mark.parametrize("name", ["vault:parts=62", "wall:bricks=3,courses=3", "stack", "dome"])
def test_rows_below_supernodes_are_the_fill(name: str) -> None:
    """What elimination of one part after another fills is what the pattern has, with few zeros in addition."""
    problem = build_problem(load_structure(name))
    pattern = build_structure(problem).elimination
    assert sorted(pattern.order) == np.flatnonzero(~problem.boundary).tolist()
    touches = [set[int]() for _ in pattern.order]
    for pair in pattern.position[problem.pair_parts].tolist():
        if min(pair) >= 0:
            touches[min(pair)].add(max(pair))
    stored = 0
    for j, rows in enumerate(touches):
        supernode = pattern.supernode[j]
        end, bounds = pattern.start[supernode + 1], pattern.row_start[supernode : supernode + 2]
        row = pattern.row[bounds[0] : bounds[1]]
        assert (np.diff(row) > 0).all()
        assert {i for i in rows if i >= end} <= set(row.tolist())
        stored += end - 1 - j + len(row)
        if rows:
            touches[min(rows)] |= rows - {min(rows)}
    assert sum(map(len, touches)) <= stored <= 1.3 * sum(map(len, touches))


@pytest.fixture(scope="module", params=["vault:parts=30", "wall:bricks=3,courses=3", "stack"])
def structure(request: pytest.FixtureRequest) -> KernelArrays:
    assembly = load_structure(request.param)
    return build_structure(build_problem(assembly))


@pytest.mark.usefixtures("interpreted")
@pytest.mark.parametrize("symmetric", [True, False])
@pytest.mark.parametrize("share", [1.0, 0.8, 0.4])
def test_factors_agree_with_dense_algebra(structure: KernelArrays, symmetric: bool, share: float) -> None:
    """Blocks of random numbers at the pairs of any subset of the parts."""
    random = np.random.default_rng(0)
    elimination, panels = structure.elimination, make_scratch(structure).panels
    free = random.random(len(elimination.order)) < share
    free[0] = True
    lay_out_panels(structure, free, panels)
    panels.upper[:], panels.lower[:] = 0.0, np.nan if symmetric else 0.0
    slots = np.flatnonzero(free)
    index = {j: 6 * k for k, j in enumerate(slots.tolist())}
    dense = np.zeros((6 * len(slots), 6 * len(slots)))

    def write(panel: NDArray[np.float64], place: int, position: int, block: NDArray[np.float64]) -> None:
        for r in range(6):
            begin = place + r * panels.width[elimination.supernode[position]]
            panel[begin : begin + 6] = block[r]

    for q, ends in enumerate(structure.pair_parts):
        i, j = sorted(elimination.position[ends].tolist())
        if i not in index or j not in index:
            continue
        above = random.standard_normal((6, 6))
        below = above.T if symmetric else random.standard_normal((6, 6))
        write(panels.upper, int(panels.block[q]), i, above)
        if not symmetric:
            write(panels.lower, int(panels.block[q]), i, below.T)
        dense[index[i] : index[i] + 6, index[j] : index[j] + 6] = above
        dense[index[j] : index[j] + 6, index[i] : index[i] + 6] = below
    for j, at in index.items():
        block = random.standard_normal((6, 6))
        block = 100.0 * np.eye(6) + (block + block.T if symmetric else block)
        write(panels.upper, int(panels.diagonal[j]), j, block)
        dense[at : at + 6, at : at + 6] = block
    assert factor_panels.dispatcher(elimination.supernode, panels, symmetric)
    x = np.zeros((len(free), 6))
    x[slots] = random.standard_normal((len(slots), 6))
    right = x[slots].ravel()
    solve_panels.dispatcher(panels, x, False)
    np.testing.assert_allclose(dense @ x[slots].ravel(), right, atol=1e-10)
    assert (x[~free] == 0.0).all()
    if symmetric:
        again = np.zeros_like(x)
        again[slots] = right.reshape(-1, 6)
        panels.lower[:] = np.nan
        solve_panels.dispatcher(panels, again, True)
        np.testing.assert_allclose(again, x, atol=1e-12)


def test_the_pattern_has_every_pair_of_ten_thousand_parts() -> None:
    """Entries of factors fall with the fill until they are no numbers any more; the pattern must not depend on them."""
    number = np.arange(10_000).reshape(100, 100)
    pairs = np.concatenate(
        [
            np.stack([some.ravel(), others.ravel()], axis=1)
            for some, others in ((number[1:], number[:-1]), (number[:, 1:], number[:, :-1]))
        ]
    )
    grid: Any = SimpleNamespace(boundary=np.zeros(number.size, dtype=bool), parts=number.size, pair_parts=pairs)
    found = eliminate(grid)
    ends = np.sort(found.position[pairs], axis=1)
    for one, other in ends.tolist():
        supernode = found.supernode[one]
        rows = found.row[found.row_start[supernode] : found.row_start[supernode + 1]]
        assert other < found.start[supernode + 1] or other in rows
