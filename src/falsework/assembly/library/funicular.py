"""Form of a shell that carries its own weight by an equal thrust in every direction."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

Array = NDArray[np.float64]

_SAMPLES = 2001
"""Radii at which the form is computed."""


@dataclass(frozen=True, eq=False)
class Funicular:
    """Surface of revolution in equilibrium under its own weight at equal horizontal thrust.

    With horizontal thrust `H` (N/m, the same in all directions) and weight `w` per area of the surface, vertical
    equilibrium in plan is `H div grad z = -w sqrt(1 + |grad z|^2)`: a net of equal force densities, refined
    without end and loaded by itself. For a form that depends on the distance `r` from the axis only, the
    slope `p = dz/dr` obeys `p' = -w/H sqrt(1 + p^2) - p / r`, of which every solution is concave.
    """

    radius: Array
    """Distance from the axis, ascending, shape (samples,), metres."""
    height: Array
    """Above the rim, shape (samples,), metres."""
    slope: Array
    """dz/dr, shape (samples,)."""

    def tangent_planes(self, sites: Array) -> Array:
        """Return planes that touch the surface over given points in plan.

        Args:
            sites: shape (planes, 2), metres.

        Returns:
            Rows `(nx, ny, nz, c)` of `n . x = c` with unit normals that look up, shape (planes, 4).
        """
        distance = np.hypot(*sites.T)
        height = np.interp(distance, self.radius, self.height)
        slope = np.interp(distance, self.radius, self.slope)
        along = sites / np.maximum(distance, 1e-300)[:, None]
        normals = np.column_stack([-slope[:, None] * along, np.ones(len(sites))])
        normals /= np.linalg.norm(normals, axis=1, keepdims=True)
        offset = np.einsum("ij,ij->i", normals, np.column_stack([sites, height]))
        return np.column_stack([normals, offset])


def find_form(rim: float, rise: float) -> Funicular:
    """Find the thrust for which the form rises by `rise` above a circle of radius `rim`, both in metres."""
    radius = np.linspace(0.0, rim, _SAMPLES)

    from scipy.integrate import solve_ivp
    from scipy.optimize import root_scalar

    def solve(ratio: float) -> Array:
        """Return depth below the crown and slope at all samples for a ratio weight / thrust (1/m)."""

        def change(r: float, state: Array) -> list[float]:
            depth_slope = state[1]
            spread = ratio / 2 if r < 1e-9 * rim else depth_slope / r  # limit at the axis: both curvatures agree
            return [depth_slope, ratio * np.hypot(1.0, depth_slope) - spread]

        return solve_ivp(change, (0.0, rim), [0.0, 0.0], t_eval=radius, rtol=1e-10, atol=1e-12 * rim).y

    guess = 4.0 * rise / rim**2  # of the paraboloid, whose rise is a little less
    ratio = root_scalar(lambda value: solve(value)[0, -1] - rise, bracket=(guess / 10.0, guess), rtol=1e-12).root
    depth, slope = solve(ratio)
    return Funicular(radius, rise - depth, -slope)
