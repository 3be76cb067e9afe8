"""Projection onto the friction cones, against its characterisation and an independent quadratic program."""

from __future__ import annotations

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray
from scipy.optimize import nnls

from falsework.stability.cpu.cones import OCTAGON, QUADRATIC, project, project_joint, support
from falsework.stability.second_order.springs import into_cone
from falsework.stability.strength import Strength

BOTH = pytest.mark.parametrize("cone", [OCTAGON, QUADRATIC])
NUMBER = st.floats(-10, 10, allow_nan=False, allow_subnormal=False)
POINT = st.tuples(NUMBER, NUMBER, NUMBER)
FRICTION = st.floats(0, 3, allow_subnormal=False)
BOUNDED = settings(max_examples=150, deadline=None, derandomize=True)


def nearest(cone: int, point: tuple[float, ...], friction: float) -> NDArray[np.float64]:
    n, x, y = (float(value) for value in point)
    return np.array(project(cone, n, x, y, float(friction)))


def rays(cone: int, friction: float) -> NDArray[np.float64]:
    """Edges of the octagon, or very many of the quadratic cone, shape (rays, 3)."""
    angle = np.arange(8 if cone == OCTAGON else 720) * 2 * np.pi / (8 if cone == OCTAGON else 720)
    return np.column_stack([np.ones_like(angle), friction * np.cos(angle), friction * np.sin(angle)])


def outside(cone: int, point: NDArray, friction: float) -> float:
    """How far a point stands outside the cone; the octagon's sides face 22.5 degrees past its corners."""
    n, x, y = point
    if cone == QUADRATIC:
        return max(math.hypot(x, y) - friction * n, -n)
    angle = (np.arange(8) + 0.5) * np.pi / 4
    return max((x * np.cos(angle) + y * np.sin(angle)).max() - friction * np.cos(np.pi / 8) * n, -n)


@BOTH
@BOUNDED
@given(point=POINT, friction=FRICTION)
def test_projection_is_the_nearest_point(cone: int, point: tuple[float, ...], friction: float) -> None:
    """Moreau: the projection is in the cone, and what it leaves is normal to it and in the polar cone."""
    projected = nearest(cone, point, friction)
    left = np.array(point) - projected
    scale = 1 + np.abs(point).max()
    assert outside(cone, projected, friction) <= 1e-12 * scale
    assert abs(left @ projected) <= 1e-12 * scale**2
    assert (rays(cone, friction) @ left).max() <= 1e-12 * scale * (1 + friction)


@BOTH
@BOUNDED
@given(point=POINT, friction=FRICTION)
def test_projection_is_idempotent(cone: int, point: tuple[float, ...], friction: float) -> None:
    once = nearest(cone, point, friction)
    np.testing.assert_allclose(nearest(cone, tuple(once), friction), once, atol=1e-12 * (1 + np.abs(point).max()))


@BOUNDED
@given(point=POINT, friction=FRICTION)
def test_the_octagon_agrees_with_least_squares_over_its_edges(point: tuple[float, ...], friction: float) -> None:
    """The paper's nine variables a contact point are the octagon's edges: project by a quadratic program on those."""
    edges = rays(OCTAGON, friction)
    weights, _ = nnls(edges.T, np.array(point))
    np.testing.assert_allclose(nearest(OCTAGON, point, friction), edges.T @ weights, atol=1e-8)


@BOTH
@BOUNDED
@given(point=POINT, friction=st.floats(0.0, 2.0), stick=st.floats(0.01, 5.0))
def test_the_nearest_point_of_a_cut_cone(cone: int, point: tuple[float, ...], friction: float, stick: float) -> None:
    """It is admissible, and no admissible corner lies on the near side of the plane through it."""
    found = np.array(project_joint(cone, *point, friction, stick))
    corners = rays(cone, 1.0) * [0.0, 1.0, 1.0] * stick  # of the cut; the cone goes on along its rays from there
    away = np.array(point) - found
    slack = 1e-9 * (1 + np.abs(point).max()) ** 2
    assert found[0] >= 0
    assert outside(cone, found + [stick, 0.0, 0.0], 1.0) <= 1e-9 * (1 + abs(found[0])) or friction > 0
    assert (corners - found).dot(away).max() <= slack + (0 if cone == OCTAGON else 1e-4 * np.abs(away).max() * stick)
    assert (rays(cone, friction) @ away).max() <= slack + (0 if cone == OCTAGON else 1e-4 * np.abs(away).max())


@pytest.mark.parametrize("cone", [OCTAGON, QUADRATIC])
@pytest.mark.parametrize("normal", [-1.0, 0.0, 2.0])
@pytest.mark.parametrize("tangent", [(0.0, 0.0), (0.3, -0.2)])
def test_without_friction_only_pressure_is_left(cone: int, normal: float, tangent: tuple[float, float]) -> None:
    np.testing.assert_array_equal(nearest(cone, (normal, *tangent), 0.0), [max(normal, 0.0), 0.0, 0.0])


@BOTH
@BOUNDED
@given(direction=POINT, friction=FRICTION)
def test_support_is_the_best_ray(cone: int, direction: tuple[float, ...], friction: float) -> None:
    best = (rays(cone, friction) @ np.array(direction)).max()
    # 720 rays miss the best direction by up to a quarter of a degree.
    slack = 1e-12 if cone == OCTAGON else 1e-5
    n, x, y = direction
    assert support(cone, n, x, y, friction) == pytest.approx(best, abs=slack * 50)


@pytest.mark.parametrize("name", ["octagon", "quadratic"])
@BOUNDED
@given(point=POINT, friction=FRICTION)
def test_shrinking_into_the_cone_keeps_what_is_inside(name: str, point: tuple[float, ...], friction: float) -> None:
    cone = {"octagon": OCTAGON, "quadratic": QUADRATIC}[name]
    shrunk = into_cone(
        np.array([point]),
        Strength(np.array(friction), np.zeros(()), np.zeros(()), np.array(True), np.array(False)),
        name,
    )[0][0]
    assert outside(cone, shrunk, friction) <= 1e-12 * (1 + max(map(abs, point)))
    if outside(cone, np.array(point), friction) < -1e-9:
        np.testing.assert_array_equal(shrunk, point)
