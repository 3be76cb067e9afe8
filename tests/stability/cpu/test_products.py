"""Products of small matrices in vector registers, against numpy."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest

from falsework import StabilitySettings, load_structure
from falsework.stability.contact.layout import build_contact_structure
from falsework.stability.cpu.layout import build_structure
from falsework.stability.cpu.products import Operation, congruence, product, square_product
from falsework.stability.problem import build_problem
from falsework.utils.kernels import njit

_subtract, _set, _add_square = product(-1), product(1, adds=False), square_product()


@njit(cache=True)
def multiply(left, right, less, only, square, rows, point, matrices, sums):
    """Run all operations; the factors have rows of 20 and 30 numbers and begin at the second."""
    sixes, columns = len(left) // 6, less.shape[1] - 3
    _subtract(left, 1, left.shape[1], right, 1, right.shape[1], less, 2, less.shape[1], sixes, columns)
    _set(left, 1, left.shape[1], right, 1, right.shape[1], only, 0, only.shape[1], sixes, columns)
    _add_square(left, 1, left.shape[1], right, 1, right.shape[1], square, 0, 8)
    congruence(rows, point, matrices, len(matrices), sums)


@pytest.mark.parametrize("columns", [2, 6, 8, 12, 22])
@pytest.mark.parametrize("sixes", [1, 3])
def test_products_agree_with_numpy_and_write_nothing_else(columns: int, sixes: int) -> None:
    random = np.random.default_rng(columns)

    def numbers(*shape: int) -> Any:
        return random.standard_normal(shape)

    left, right, rows, matrices = numbers(6 * sixes, 20), numbers(6 * sixes, 30), numbers(7, 3, 8), numbers(sixes, 9)
    less, only, square, sums = numbers(6, columns + 3), numbers(6, columns + 3), numbers(6, 8), numbers(6, 8)
    before, old, first = less.copy(), only.copy(), square.copy()
    multiply(left, right, less, only, square, rows, 2, matrices, sums)
    expected = left[:, 1:7].T @ right[:, 1 : 1 + columns]
    before[:, 2 : 2 + columns] -= expected
    old[:, :columns] = expected
    np.testing.assert_allclose(less, before, atol=1e-12)
    np.testing.assert_allclose(only, old, atol=1e-12)
    np.testing.assert_allclose(square, first + left[:6, 1:7].T @ right[:6, 1:9], atol=1e-12)
    basis, points = rows[2 : 2 + sixes], matrices.reshape(-1, 3, 3)
    np.testing.assert_allclose(sums, np.einsum("pir,pki,pkc->rc", basis[:, :, :6], points, basis), atol=1e-12)


def test_operations_run_only_in_kernels() -> None:
    with pytest.raises(TypeError, match="load is part of kernels"):
        Operation("load", 8)(np.zeros(8), 0)


def test_rows_of_eight_numbers_lie_in_a_row_whatever_the_number_of_pairs() -> None:
    """A single transposed matrix is contiguous in both orders, and padding would keep the wrong one."""
    assembly = load_structure("stack:blocks=2")
    problem = build_problem(assembly)
    arrays = build_contact_structure(assembly, problem, build_structure(problem), StabilitySettings())
    for array in (arrays.turned_a, arrays.turned_b, arrays.rows):
        assert array.flags.c_contiguous
        assert array.shape[-1] == 8
        assert not array[..., 6:].any()
