"""Orders of elimination, and factors in panels, against dense linear algebra."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.typing import NDArray

from falsework import load_structure
from falsework.stability.cpu import ordering
from falsework.stability.cpu.elimination import lay_out_panels
from falsework.stability.cpu.layout import KernelArrays, build_structure, make_scratch
from falsework.stability.cpu.ordering import Graph, elimination_order
from falsework.stability.cpu.panels import factor_panels, solve_panels
from falsework.stability.problem import build_problem


def sheet(width: int, height: int, shear: bool = False) -> Graph:
    """Return staggered courses of cells in contact with six others each; with `shear` all are shifted the same way."""
    neighbours: Graph = {i: set() for i in range(width * height)}
    for i in neighbours:
        x, y = i % width, i // width
        left = 0 if shear else y % 2 - 1
        for dx, dy in ((1, 0), (left, 1), (left + 1, 1)):
            if 0 <= x + dx < width and y + dy < height:
                neighbours[i].add(i + dx + dy * width)
                neighbours[i + dx + dy * width].add(i)
    return neighbours


def fill(neighbours: Graph, order: list[int]) -> NDArray[np.int64]:
    """Return the number of blocks below the diagonal of each column of the factor."""
    left, sizes = {part: set(others) for part, others in neighbours.items()}, []
    for part in order:
        clique = left.pop(part)
        sizes.append(len(clique))
        for other in clique:
            left[other] |= clique
            left[other] -= {part, other}
    return np.array(sizes)


@pytest.mark.parametrize(("width", "height"), [(5, 4), (40, 30)])
def test_an_order_takes_every_part_once(width: int, height: int) -> None:
    neighbours = sheet(width, height)
    before = {part: set(others) for part, others in neighbours.items()}
    assert sorted(elimination_order(neighbours)) == list(range(width * height))
    assert neighbours == before


def test_dissection_is_taken_where_it_fills_less() -> None:
    staggered, sheared = sheet(50, 40), sheet(50, 40, shear=True)
    orders = elimination_order(staggered), elimination_order(sheared)
    plain = elimination_order(staggered, leaf=10**6)
    assert (fill(staggered, orders[0]) ** 2).sum() < 0.7 * (fill(staggered, plain) ** 2).sum()
    assert orders[1] == elimination_order(sheared, leaf=10**6)


def test_structures_in_pieces_are_dissected_too() -> None:
    one, many = sheet(30, 15), sheet(30, 15)
    neighbours = one | {part + 1000: {other + 1000 for other in others} for part, others in many.items()}
    neighbours[5000] = set()
    assert sorted(elimination_order(neighbours)) == sorted(neighbours)


def test_separators_separate() -> None:
    neighbours = sheet(30, 20)
    one, other, between = ordering.separate(neighbours, set(neighbours))
    assert one | other | between == set(neighbours)
    assert len(one) + len(other) + len(between) == len(neighbours)
    assert not any(neighbours[part] & other for part in one)
    assert len(between) <= 21
    assert max(len(one), len(other)) < 0.7 * len(neighbours)


@pytest.fixture(scope="module", params=["vault:parts=62", "wall:bricks=3,courses=3", "stack"])
def structure(request: pytest.FixtureRequest) -> KernelArrays:
    assembly = load_structure(request.param)
    return build_structure(build_problem(assembly))


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
    assert factor_panels(elimination.supernode, panels, symmetric)
    x = np.zeros((len(free), 6))
    x[slots] = random.standard_normal((len(slots), 6))
    right = x[slots].ravel()
    solve_panels(panels, x, False)
    np.testing.assert_allclose(dense @ x[slots].ravel(), right, atol=1e-10)
    assert (x[~free] == 0.0).all()
    if symmetric:
        again = np.zeros_like(x)
        again[slots] = right.reshape(-1, 6)
        panels.lower[:] = np.nan
        solve_panels(panels, again, True)
        np.testing.assert_allclose(again, x, atol=1e-12)
